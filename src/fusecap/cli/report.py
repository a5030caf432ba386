"""`fusecap report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.many import (
    Again,
    OnRay,
    Workers,
    are_newer,
    is_pattern,
    is_take_file,
    matching,
    refuse_out,
    run_many,
)
from fusecap.cli.terminal import note, progress, wrote
from fusecap.errors import InputError, TakeError

EXAMPLE = "Example: fusecap report duo/duo.npz"


def report(
    take: Annotated[
        list[Path],
        typer.Argument(
            help="A solved take (.npz), or the recording (.mcap) of a live run; several, or a "
            "pattern in quotes.",
            show_default=False,
        ),
    ],
    session: Annotated[
        Path | None,
        typer.Option(
            help="What it was solved from: a session, or a recording (.mcap); default: what stands "
            "beside the take, if it is the same still."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="The page to write; default <take>_report.html.")
    ] = None,
    workers: Workers = None,
    ray: OnRay = None,
    again: Again = False,
    as_json: Json = False,
) -> None:
    """One HTML page about a take: who was seen when by what, and how sure its poses are.

    It opens in any browser, without a server and without a network. Cameras and sensors are shown
    where the session is at hand.
    """
    if not is_pattern(take):
        _report_of(take[0], session, out, as_json=as_json)
        return
    refuse_out(out)
    if session is not None:
        raise InputError("--session: of one take alone; of many, each has its own beside it")
    run_many(
        "report",
        matching(take, wanted=is_take_file, what="take or recording"),
        {},
        columns=("notes",),
        row=lambda result: [str(len(result["notes"]))],
        workers=workers,
        ray=ray,
        again=again,
        as_json=as_json,
    )


def already(path: Path) -> dict[str, Any] | None:
    """The page of a take, where it is newer than the take and the session beside it."""
    from fusecap.sources.session import FILE_NAME
    from fusecap.sources.session_file import input_files, load_session

    page, session = _target(path), path.with_name(FILE_NAME)
    inputs = [path]
    if session.is_file():
        inputs += input_files(load_session(session))
    return {"files": [str(page)], "notes": []} if are_newer([page], inputs) else None


def _target(take: Path) -> Path:
    from fusecap.exports.made_files import made_stem

    return take.with_name(f"{made_stem(take)}_report.html")


def _report_of(take: Path, session: Path | None, out: Path | None, *, as_json: bool) -> None:
    from fusecap.batch.replay import opened_take
    from fusecap.batch.report_page import report_page
    from fusecap.batch.seen import look_back
    from fusecap.batch.solved_inputs import inputs_beside, open_solved_inputs
    from fusecap.exports.made_files import list_made
    from fusecap.files import check_writable, write_whole

    target = out or _target(take)
    if target.suffix != ".html":
        raise InputError(f"--out {target}: a report is an .html file")
    check_writable(target)
    notes: list[str] = []
    seen, findings = None, ()
    with progress(quiet=as_json) as show, opened_take(take, notes.append, show) as opened:
        if not len(opened.timestamps_ns):
            raise TakeError(f"{take}: the take has no frame: nothing to report; solve it again")
        if session is None:
            session, why = inputs_beside(take, opened)
            notes += [f"without cameras and sensors: {why}"] if session is None else []
        if session is not None:
            inputs = open_solved_inputs(session, show)
            if session != take and inputs.sha256 != opened.provenance.get("session_sha256"):
                notes.append(f"{session} is not, or no longer, what the take was solved from")
            seen = look_back(opened, inputs.setup, inputs.instants, show)
            findings = inputs.findings
            del inputs  # before the whole take comes
        whole = opened.of_frames(0, len(opened.timestamps_ns))
    page = report_page(whole, take.stem, seen=seen, findings=findings, notes=notes)
    write_whole(target, page)
    list_made(take, [target])
    if as_json:
        result: dict[str, Any] = {"files": [str(target)], "notes": notes}
        print_json(result)
        return
    for text in notes:
        note(text)
    wrote(target)
