"""`fusecap overlay`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import err, note, progress, wrote
from fusecap.errors import InputError

EXAMPLE = "Example: fusecap overlay duo/duo.npz"


def overlay(
    take: Annotated[
        Path,
        typer.Argument(
            help="A solved take (.npz), or the recording (.mcap) of a live run.",
            show_default=False,
        ),
    ],
    session: Annotated[
        Path | None,
        typer.Option(
            help="The session (session.toml or its folder) whose videos are drawn on; default: the "
            "one in the take's folder."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder; default: beside the take.")] = None,
    as_json: Json = False,
) -> None:
    """Draw the solved people over the session's videos: <take>_<camera>_overlay.mp4 per camera.

    Left limbs are bold, bones that nothing measures are dashed and grey, people who were detected
    but are nobody of the take are thin and grey. Ctrl-C leaves a whole video of what was drawn.
    """
    from fusecap.batch.overlay import draw_take
    from fusecap.batch.replay import opened_take
    from fusecap.exports.made_files import list_made, made_stem
    from fusecap.files import check_writable
    from fusecap.sources.session import FILE_NAME
    from fusecap.sources.session_cameras import with_detections
    from fusecap.sources.session_file import load_session

    folder = out or take.parent
    beside = take.with_name(FILE_NAME)
    if session is None and not beside.is_file():
        raise InputError(
            f"no session stands beside {take}; name the one with the videos: --session"
        )
    check_writable(folder / "x.mp4")
    loaded = with_detections(load_session(session or beside))
    with progress(quiet=as_json) as show, opened_take(take, note, show) as opened:
        whole = opened.of_frames(0, len(opened.timestamps_ns))
        drawn = draw_take(whole, loaded, folder, made_stem(take), show)
    list_made(take, drawn.files)
    if as_json:
        files = [str(path) for path in drawn.files]
        print_json({"files": files, "interrupted": drawn.interrupted})
    else:
        wrote(*drawn.files)
    if drawn.interrupted:
        err.print("interrupted: what was drawn until then is kept")
        raise typer.Exit(130)
