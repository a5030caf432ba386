"""`fusecap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, RigName, Unit, checked_exports, print_json
from fusecap.cli.terminal import note, wrote
from fusecap.exports.formats import FORMATS

EXAMPLE = "Example: fusecap export take.npz --format bvh,glb --rig mixamo --out files"
_FORMATS_HELP = "One, or several with commas. " + "; ".join(
    f"{name}: {what}" for name, what in FORMATS.items()
)


def export(
    take: Annotated[
        Path, typer.Argument(help="A solved take (.npz), or the recording (.mcap) of a live run.")
    ],
    format: Annotated[str, typer.Option(help=_FORMATS_HELP)] = "bvh",
    out: Annotated[Path | None, typer.Option(help="Folder; default: beside the take.")] = None,
    unit: Unit = None,
    rig: RigName = "native",
    session: Annotated[
        Path | None,
        typer.Option(help="Of openpose: the session whose cameras see the keypoints."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Write a take in other formats.

    A file's name says what is not usual: .cm, a rig. Of a recording: the poses as they were sent
    in the run; fusecap solve makes better ones.
    """
    from fusecap.batch.replay import open_take
    from fusecap.exports.made_files import list_made
    from fusecap.exports.take_files import held_poses, plan_files
    from fusecap.exports.take_format import ExportOptions
    from fusecap.sources.session_cameras import common_landmarks, open_rig
    from fusecap.sources.session_file import load_session

    exports = checked_exports("--format", format, unit, rig)
    options = ExportOptions()
    if session is not None:
        loaded = load_session(session)
        options = ExportOptions(cameras=open_rig(loaded)[0], landmarks=common_landmarks(loaded))
    opened = open_take(take)
    planned = plan_files(
        opened,
        out or take.parent,
        formats=exports.formats,
        stem=take.stem,
        unit=exports.unit,
        rig=exports.rig,
        options=options,
    )
    files: list[Path] = []
    for file in planned:
        file.write(opened)
        files.append(file.path)
        list_made(take, files)
    notes = held_poses(opened, planned)
    if as_json:
        print_json({"files": [str(path) for path in files], "notes": notes})
        return
    for text in notes:
        note(text)
    wrote(*files)
