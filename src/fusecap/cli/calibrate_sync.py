"""`fusecap calibrate sync`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, SessionPath, print_json
from fusecap.cli.terminal import console, note, progress, remark, table_of, wrote
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.calibrate.sync.clock_rows import ClockRow
    from fusecap.calibrate.sync.session import Synchronisation

EXAMPLE = "Example: fusecap calibrate sync recordings/duo --write --picture recordings/duo/sync.png"


def sync(
    session: SessionPath,
    out: Annotated[
        Path | None, typer.Option(help="Write the clocks to this file.", show_default=False)
    ] = None,
    write: Annotated[
        bool,
        typer.Option("--write", help="Write sync.toml beside the session, and name it there."),
    ] = False,
    max_offset: Annotated[
        float, typer.Option(min=0.1, max=600.0, help="Largest offset looked for, in seconds.")
    ] = 10.0,
    picture: Annotated[
        Path | None, typer.Option(help="Draw curves and offsets (.png).", show_default=False)
    ] = None,
    as_json: Json = False,
) -> None:
    """When cameras and sensors recorded, from the people they saw: offset and drift of each clock.

    Session time = own time + offset. Exit code 1 where a clock could not be told.
    """
    from dataclasses import asdict

    from fusecap.calibrate.sync.session import synchronise
    from fusecap.files import check_writable, write_whole
    from fusecap.sources.session_edit import edit_session
    from fusecap.sources.session_file import missing_files, parse_session
    from fusecap.sources.sync_files import sync_toml

    if out is not None and write:
        raise typer.BadParameter("give --out or --write, not both", param_hint="--out")
    opened = parse_session(session)
    needed = ("[session] calibration", "[session] sync")
    missing = [line for line in missing_files(opened) if not line.startswith(needed)]
    if missing:
        raise InputError("\n".join(f"{opened.path}: {line}" for line in missing))
    if write:
        out = opened.path.parent / "sync.toml"
        check_writable(opened.path)
    for file in (out, picture):
        if file is not None:
            check_writable(file)
    with progress(quiet=as_json) as show:
        found = synchronise(opened, max_offset_s=max_offset, progress=show)
    if picture is not None:
        from fusecap.calibrate.sync.plot import draw

        draw(found, picture)
    if out is not None:
        write_whole(out, sync_toml(found.clocks, origin=_origin(found)))
    named = write and edit_session(opened.path, {"sync": "sync.toml"})
    if as_json:
        print_json(
            {
                "reference": found.reference,
                "complete": found.complete,
                "clocks": [asdict(row) for row in found.rows],
                "notes": list(found.notes),
                "file": None if out is None else str(out),
            }
        )
    else:
        _print_report(found)
        if out is not None:
            wrote(out)
            if not write:
                console.print('use it: sync = "..." under [session]', soft_wrap=True)
        if write and not named:
            console.print(f"{opened.path.name} names it already", soft_wrap=True)
        if out is None and found.complete:
            console.print("nothing is changed yet: --write puts the clocks into the session")
        if picture is not None:
            wrote(picture)
    if not found.complete:
        raise typer.Exit(1)


def _origin(found: Synchronisation) -> str:
    cameras = sum(row.kind == "camera" for row in found.rows)
    imus = len(found.rows) - cameras
    return f"{cameras} cameras, {imus} IMU clocks; reference camera {found.reference}"


def _print_report(found: Synchronisation) -> None:
    import numpy as np

    table = table_of("clock", "offset ms", "error ms", "drift ms/min", "verdict")
    for column in table.columns[1:4]:
        column.justify = "right"
    for row in found.rows:
        table.add_row(_label(row), *_numbers(row), row.word)
    console.print(table)
    console.print(
        "  session time = own time + offset: a positive offset means that the clock's zero is that "
        "much later than the session's. Errors are standard errors.",
        soft_wrap=True,
    )
    if found.cameras is not None:
        before, after = found.cameras.residual_px
        gain = np.nan_to_num(before - after)
        most = int(np.argmax(gain))
        if gain[most] >= 0.1:
            console.print(
                f"  camera '{found.rows[most].name}' gains most: from the others' lines its "
                f"keypoints are {before[most]:.1f} -> {after[most]:.1f} px away (median, of an "
                "image 1920 wide)",
                soft_wrap=True,
            )
    for name, stamp in found.stamps.items():
        console.print(
            f"  {name}: foot stamp at {stamp.video_s:.2f} s in the video, {stamp.offset_s:+.3f} s "
            f"on '{stamp.bone}'",
            soft_wrap=True,
        )
    for text in found.notes:
        note(text)
    for row in found.rows:
        if row.said:
            remark((row.word, "yellow"), f"{_label(row)}: {row.said}")


def _label(row: ClockRow) -> str:
    if row.kind == "camera":
        return f"camera '{row.name}'"
    some = row.sensors[0] if len(row.sensors) == 1 else f"{len(row.sensors)} sensors"
    return f"imu '{row.name}', {some}"


def _numbers(row: ClockRow) -> tuple[str, str, str]:
    offset = "-" if row.offset_s is None else f"{1e3 * row.offset_s:+.1f}"
    error = "-" if row.error_s is None or row.state == "reference" else f"{1e3 * row.error_s:.1f}"
    if row.drift_ppm is None or row.drift_error_ppm is None:
        return offset, error, "-"
    drift = f"{0.06 * row.drift_ppm:+.2f} ± {0.06 * row.drift_error_ppm:.2f}"
    return offset, error, drift if row.drift_used else f"({drift})"
