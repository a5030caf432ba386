"""`fusecap solve`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import (
    EXPORTS,
    Json,
    SessionPath,
    Unit,
    check_choice,
    console,
    err,
    finish,
    print_json,
    print_speed,
    progress,
    write_take,
)
from fusecap.errors import InputError

if TYPE_CHECKING:
    from fusecap.offline.solve import Solved, SolveReport

EXAMPLE = "Example: fusecap solve recordings/duo --export bvh --json > report.json"


def solve(
    session: SessionPath,
    out: Annotated[
        Path | None, typer.Option(help="The take to write; default SESSION/<name>.npz.")
    ] = None,
    export: Annotated[
        str | None, typer.Option(help="Other formats beside the take, e.g. bvh.")
    ] = None,
    unit: Unit = "m",
    picture: Annotated[bool, typer.Option("--picture", help="Also draw the motion.")] = False,
    as_json: Json = False,
) -> None:
    """Solve a recorded session: videos or keypoints, and IMU files, to each person's motion.

    Keypoints of videos are detected first (as `fusecap detect` does) and kept for the next time.
    """
    from fusecap.cli.detect import detect_missing, print_detection
    from fusecap.offline.solve import solve_session
    from fusecap.sinks.files import safe_name
    from fusecap.sources.session import load_session
    from fusecap.sources.session_data import open_session

    formats = _formats(export)
    check_choice("--unit", unit, ("m", "cm"))
    loaded = load_session(session)
    target = out or loaded.folder / f"{safe_name(loaded.settings.name)}.npz"
    if target.suffix != ".npz":
        raise InputError(f"--out {target}: a take is one .npz file")
    detected = detect_missing(loaded, quiet=as_json)
    if detected is not None and not as_json:
        print_detection(detected)
    if detected is not None and detected.interrupted:
        raise KeyboardInterrupt
    with progress(quiet=as_json) as show:
        data = open_session(loaded, show)
        solved = solve_session(data, progress=show)
    if not solved.take.tracked.any() and not solved.report.interrupted:
        raise InputError(_nobody(solved.report))
    files = write_take(solved.take, target, exports=formats, unit=unit, picture=picture)
    if as_json:
        detection = {} if detected is None else {"detection": detected.as_json()}
        paths = [str(path) for path in files]
        print_json(solved.report.as_json() | detection | {"files": paths})
    else:
        for note in solved.report.notes:
            err.print(f"[yellow]note[/] {note}", soft_wrap=True)
        _print_report(solved)
    finish(solved, files, as_json)


def _nobody(report: SolveReport) -> str:
    return (
        f"nobody could be followed in {report.instants} instants ({report.duration_s:.2f} s) of "
        f"{report.cameras} cameras; nothing was written. Two cameras must see a person at once, "
        "for half a second or more, with calibration and clocks that agree: fusecap doctor "
        "checks both, fusecap detect --overlay draws whom it finds"
    )


def _formats(text: str | None) -> list[str]:
    """The names of a comma-separated list, each checked."""
    formats = [part.strip() for part in (text or "").split(",") if part.strip()]
    for name in formats:
        check_choice("--export", name, EXPORTS)
    return formats


def _print_report(solved: Solved) -> None:
    from rich.table import Table

    report = solved.report
    console.print(
        f"[bold]{report.instants}[/] instants ({report.duration_s:.2f} s), "
        f"{report.cameras} cameras, {len(report.subjects)} subjects"
    )
    people = Table("subject", "tracked", "quality", "height m")
    for name, values in report.subjects.items():
        people.add_row(
            name,
            f"{100 * values['tracked_share']:.1f} %",
            f"{values['mean_quality']:.2f}",
            f"{values['height_m']:.2f}",
        )
    console.print(people)
    if report.reprojection_px:
        cameras = Table("camera", "reprojection median px", "p90 px", "keypoints")
        for name, values in report.reprojection_px.items():
            cameras.add_row(
                name,
                f"{values['median']:.1f}",
                f"{values['p90']:.1f}",
                f"{values['keypoints']:.0f}",
            )
        console.print(cameras)
    print_speed(solved)
