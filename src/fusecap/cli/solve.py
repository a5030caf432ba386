"""`fusecap solve`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from fusecap.cli.common import (
    Exports,
    Json,
    RigName,
    Unit,
    checked_exports,
    finish,
    print_json,
    print_speed,
    write_take,
)
from fusecap.cli.terminal import console, note, progress, styled, table_of
from fusecap.errors import InputError
from fusecap.exports.formats import FORMATS

if TYPE_CHECKING:
    from fusecap.batch.solve import Solved, SolveReport

EXAMPLE = (
    "Example: fusecap solve recordings/duo --export bvh; of a live run: "
    "fusecap solve recordings/duo/duo-2026-03-01-101500.mcap"
)


def solve(
    session: Annotated[
        Path,
        typer.Argument(
            help="session.toml, the folder that holds it, or the recording (.mcap) of a live run.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            help="The take to write; default SESSION/<name>.npz, of a recording beside it."
        ),
    ] = None,
    export: Annotated[
        str | None, typer.Option(help=f"Other formats beside the take: {', '.join(FORMATS)}.")
    ] = None,
    unit: Unit = None,
    rig: RigName = "native",
    picture: Annotated[bool, typer.Option("--picture", help="Also draw the motion.")] = False,
    as_live: Annotated[
        bool,
        typer.Option(
            "--as-live",
            help="Of a recording: the poses of the run again, instead of a better second solve.",
        ),
    ] = False,
    anyway: Annotated[
        bool,
        typer.Option("--anyway", help="Also a session that doctor finds errors in."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Solve a recorded session, or the recording of a live run, to each person's motion.

    Keypoints of videos are detected first (as `fusecap detect` does) and kept for the next time.
    A recording is solved from all that was recorded, in two passes; with --as-live its events are
    gone through as in the run, and the poses are compared with those recorded.
    """
    from fusecap.batch.solve import refuse_errors, solve_session
    from fusecap.cli.detect import detect_missing, print_detection
    from fusecap.exports.take_format import ExportOptions
    from fusecap.files import safe_name
    from fusecap.recording.layout import SUFFIX
    from fusecap.sources.session_cameras import open_rig
    from fusecap.sources.session_data import open_session
    from fusecap.sources.session_file import load_session

    exports = checked_exports("--export", export or "", unit, rig)
    if session.suffix == SUFFIX:
        _solve_recording(
            session, out, exports, picture=picture, as_live=as_live, anyway=anyway, quiet=as_json
        )
        return
    if as_live:
        raise InputError(f"--as-live: {session} is no recording (.mcap) of a live run")
    loaded = load_session(session)
    target = _take_path(out, loaded.folder / f"{safe_name(loaded.settings.name)}.npz")
    if not anyway:  # before hours of detection
        refuse_errors(loaded.path, open_rig(loaded)[1])
    detected = detect_missing(loaded, quiet=as_json)
    if detected is not None and not as_json:
        print_detection(detected)
    if detected is not None and detected.interrupted:
        raise KeyboardInterrupt
    with progress(quiet=as_json) as show:
        data = open_session(loaded, show)
        solved = solve_session(data, progress=show, anyway=anyway)
    if not solved.take.tracked.any():
        _stop_without_poses(solved, _nobody(solved.report))
    seen = ExportOptions(cameras=data.rig, landmarks=data.landmarks)
    files = write_take(
        solved,
        target,
        replace(exports, options=seen),
        picture=picture,
    )
    detection = {} if detected is None else {"detection": detected.as_json()}
    _print_solved(solved, files, detection, as_json)


def _solve_recording(
    path: Path,
    out: Path | None,
    exports: Exports,
    *,
    picture: bool,
    as_live: bool,
    anyway: bool,
    quiet: bool,
) -> None:
    from fusecap.batch.replay import recorded_setup, solve_as_live
    from fusecap.batch.second_solve import solve_recording
    from fusecap.exports.take_format import ExportOptions
    from fusecap.recording.reader import Recording

    ending = "-as-live.npz" if as_live else ".npz"
    target = _take_path(out, path.with_name(path.stem + ending))
    recording = Recording(path)
    replay: dict[str, dict[str, int]] = {}
    with progress(quiet=quiet) as show:
        if as_live:
            solved, again = solve_as_live(recording, progress=show)
            replay = {"replay": {"poses": again.poses, "equal": again.equal}}
        else:
            solved = solve_recording(recording, progress=show, anyway=anyway)
    if not solved.take.tracked.any():
        _stop_without_poses(
            solved,
            f"nobody could be followed in {solved.report.instants} instants of {path}; nothing "
            f"was written. What is in it: fusecap doctor {path}",
        )
    setup = recorded_setup(recording)
    seen = ExportOptions(cameras=setup.rig, landmarks=setup.landmarks)
    files = write_take(
        solved,
        target,
        replace(exports, options=seen),
        picture=picture,
    )
    _print_solved(solved, files, replay, quiet)


def _take_path(out: Path | None, usual: Path) -> Path:
    if out is not None and out.suffix != ".npz":
        raise InputError(f"--out {out}: a take is one .npz file")
    return out or usual


def _print_solved(solved: Solved, files: list[Path], more: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print_json(solved.report.as_json() | more | {"files": [str(path) for path in files]})
    else:
        for text in solved.report.notes:
            note(text)
        _print_report(solved)
    finish(solved, files, as_json)


def _stop_without_poses(solved: Solved, why: str) -> NoReturn:
    """Nothing is written: it was interrupted too early, or nobody could be followed."""
    if solved.report.interrupted:
        raise KeyboardInterrupt
    raise InputError(why)


def _nobody(report: SolveReport) -> str:
    return (
        f"nobody could be followed in {report.instants} instants ({report.duration_s:.2f} s) of "
        f"{report.cameras} cameras; nothing was written. Two cameras must see a person at once, "
        "for half a second or more, with calibration and clocks that agree: fusecap doctor "
        "checks both, fusecap detect --overlay draws whom it finds"
    )


def _print_report(solved: Solved) -> None:

    report = solved.report
    console.print(
        styled((str(report.instants), "bold"), f" instants ({report.duration_s:.2f} s), ")
        + styled(f"{report.cameras} cameras, {len(report.subjects)} subjects")
    )
    people = table_of("subject", "tracked", "bones +- deg", "joints +- mm", "height m")
    for name, values in report.subjects.items():
        people.add_row(
            name,
            f"{100 * values['tracked_share']:.1f} %",
            f"{values['bone_sigma_deg']:.1f}",
            f"{1e3 * values['position_sigma_m']:.0f}",
            f"{values['height_m']:.2f}",
        )
    console.print(people)
    if report.reprojection_px:
        cameras = table_of("camera", "reprojection median px", "p90 px", "keypoints")
        for name, values in report.reprojection_px.items():
            cameras.add_row(
                name,
                f"{values['median']:.1f}",
                f"{values['p90']:.1f}",
                f"{values['keypoints']:.0f}",
            )
        console.print(cameras)
    print_speed(solved)
