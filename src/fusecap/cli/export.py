"""`fusecap export`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.cli.common import Json, RigName, Unit, checked_exports, print_json
from fusecap.cli.many import (
    Again,
    OnRay,
    Workers,
    are_newer,
    is_pattern,
    is_take_file,
    matching,
    run_many,
)
from fusecap.cli.terminal import note, wrote
from fusecap.errors import InputError
from fusecap.exports.formats import FORMATS

if TYPE_CHECKING:
    from fusecap.exports.take_files import TakeFile
    from fusecap.stored_take import StoredTake

EXAMPLE = "Example: fusecap export take.npz --format bvh,glb --rig mixamo --out files"
_FORMATS_HELP = "One, or several with commas. " + "; ".join(
    f"{name}: {what}" for name, what in FORMATS.items()
)


def export(
    take: Annotated[
        list[Path],
        typer.Argument(
            help="A solved take (.npz), or the recording (.mcap) of a live run; several, or a "
            "pattern in quotes.",
            show_default=False,
        ),
    ],
    format: Annotated[str, typer.Option(help=_FORMATS_HELP)] = "bvh",
    out: Annotated[Path | None, typer.Option(help="Folder; default: beside the take.")] = None,
    unit: Unit = None,
    rig: RigName = "native",
    session: Annotated[
        Path | None,
        typer.Option(help="Of openpose: the session whose cameras see the keypoints."),
    ] = None,
    workers: Workers = None,
    ray: OnRay = None,
    again: Again = False,
    as_json: Json = False,
) -> None:
    """Write a take in other formats.

    A file's name says what is not usual: .cm, a rig. Of a recording: the poses as they were sent
    in the run; fusecap solve makes better ones.
    """
    from fusecap.exports.made_files import made_stem

    if not is_pattern(take):
        _export_one(take[0], out, format, unit, rig, session, as_json=as_json)
        return
    checked_exports("--format", format, unit, rig)
    paths = matching(take, wanted=is_take_file, what="take or recording")
    if out is not None and len({made_stem(path) for path in paths}) < len(paths):
        raise InputError(f"--out {out}: two of the takes have the same name; leave it out")
    options = {"format": format, "out": out, "unit": unit, "rig": rig, "session": session}
    run_many(
        "export",
        paths,
        options,
        columns=("files",),
        row=lambda result: [str(len(result["files"]))],
        workers=workers,
        ray=ray,
        again=again,
        as_json=as_json,
    )


def already(
    path: Path, *, format: str, out: Path | None, unit: str | None, rig: str, session: Path | None
) -> dict[str, Any] | None:
    """What was exported of a take before; None where some of it is missing, or older.

    What cameras of a session have to do with is written again: its files may have changed.
    """
    if session is not None:
        return None
    with _planned(path, out, format, unit, rig, session) as (_, planned, _):
        files = [file.path for file in planned]
    return {"files": [str(file) for file in files]} if are_newer(files, [path]) else None


@contextmanager
def _planned(
    path: Path, out: Path | None, format: str, unit: str | None, rig: str, session: Path | None
) -> Iterator[tuple[StoredTake, list[TakeFile], list[str]]]:
    """The take, what to write of it, and what a user must know about it."""
    from fusecap.batch.replay import opened_take

    exports = checked_exports("--format", format, unit, rig)
    if session is not None:
        from fusecap.exports.take_format import ExportOptions
        from fusecap.sources.session_cameras import common_landmarks, open_rig
        from fusecap.sources.session_file import load_session

        loaded = load_session(session)
        seen = ExportOptions(cameras=open_rig(loaded)[0], landmarks=common_landmarks(loaded))
        exports = replace(exports, options=seen)
    notes: list[str] = []
    with opened_take(path, notes.append) as take:
        yield take, exports.planned(take, path, out), notes


def _export_one(
    take: Path,
    out: Path | None,
    format: str,
    unit: str | None,
    rig: str,
    session: Path | None,
    *,
    as_json: bool,
) -> None:
    from fusecap.exports.made_files import list_made
    from fusecap.exports.take_files import held_poses

    files: list[Path] = []
    with _planned(take, out, format, unit, rig, session) as (opened, planned, notes):
        for file in planned:
            file.write(opened)
            files.append(file.path)
            list_made(take, files)
        notes += held_poses(opened, planned)
    if as_json:
        print_json({"files": [str(path) for path in files], "notes": notes})
        return
    for text in notes:
        note(text)
    wrote(*files)
