"""`fusecap report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import note, progress, wrote
from fusecap.errors import InputError, TakeError

EXAMPLE = "Example: fusecap report duo/duo.npz"


def report(
    take: Annotated[
        Path, typer.Argument(help="A solved take (.npz), or the recording (.mcap) of a live run.")
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
    as_json: Json = False,
) -> None:
    """One HTML page about a take: who was seen when by what, and how sure its poses are.

    It opens in any browser, without a server and without a network. Cameras and sensors are shown
    where the session is at hand.
    """
    from fusecap.batch.replay import open_take
    from fusecap.batch.report_page import report_page
    from fusecap.batch.seen import look_back
    from fusecap.batch.solved_inputs import inputs_beside, open_solved_inputs
    from fusecap.exports.made_files import list_made
    from fusecap.files import check_writable, write_whole

    target = out or take.with_name(f"{take.stem}_report.html")
    if target.suffix != ".html":
        raise InputError(f"--out {target}: a report is an .html file")
    check_writable(target)
    notes: list[str] = []
    seen, findings = None, ()
    with progress(quiet=as_json) as show:
        opened = open_take(take, show)
        if not len(opened.timestamps_ns):
            raise TakeError(f"{take}: the take has no frame: nothing to report; solve it again")
        if session is None:
            session, why = inputs_beside(take, opened)
            notes += [f"without cameras and sensors: {why}"] if session is None else []
        if session is not None:
            inputs = open_solved_inputs(session, show)
            if inputs.sha256 != opened.provenance.get("session_sha256"):
                notes.append(f"{session} is not, or no longer, what the take was solved from")
            seen = look_back(opened, inputs.setup, inputs.instants, show)
            findings = inputs.findings
    page = report_page(opened, take.stem, seen=seen, findings=findings, notes=notes)
    write_whole(target, page)
    list_made(take, [target])
    if as_json:
        result: dict[str, Any] = {"files": [str(target)], "notes": notes}
        print_json(result)
        return
    for text in notes:
        note(text)
    wrote(target)
