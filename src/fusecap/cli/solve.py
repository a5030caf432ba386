"""`fusecap solve`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
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
from fusecap.cli.many import (
    Again,
    OnRay,
    Workers,
    are_newer,
    is_pattern,
    is_session,
    matching,
    refuse_out,
    run_many,
)
from fusecap.cli.terminal import console, note, progress, styled, table_of
from fusecap.errors import InputError
from fusecap.exports.formats import FORMATS

if TYPE_CHECKING:
    from fusecap.batch.solve import Solved, SolveReport
    from fusecap.sources.session import Session

EXAMPLE = (
    "Example: fusecap solve recordings/duo --export bvh; of a live run: "
    "fusecap solve recordings/duo/duo-2026-03-01-101500.mcap"
)


def solve(
    session: Annotated[
        list[Path],
        typer.Argument(
            help="session.toml, the folder that holds it, or the recording (.mcap) of a live run; "
            "several, or a pattern in quotes.",
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
    workers: Workers = None,
    ray: OnRay = None,
    again: Again = False,
    as_json: Json = False,
) -> None:
    """Solve a recorded session, or the recording of a live run, to each person's motion.

    Keypoints of videos are detected first (as `fusecap detect` does) and kept for the next time.
    A recording is solved from all that was recorded, in two passes; with --as-live its events are
    gone through as in the run, and the poses are compared with those recorded.

    Many are solved on all cores; takes that are newer than their session's files stay as they are.
    """
    exports = checked_exports("--export", export or "", unit, rig)
    if not is_pattern(session):
        _solve_one(session[0], out, exports, picture, as_live, anyway, as_json)
        return
    refuse_out(out)
    options = {"export": export, "unit": unit, "rig": rig, "picture": picture}
    run_many(
        "solve",
        matching(session, wanted=is_session, what="session or recording"),
        options | {"as_live": as_live, "anyway": anyway},
        columns=("people", "tracked", "bones +- deg", "joints +- mm", "notes"),
        row=_row,
        workers=workers,
        ray=ray,
        again=again,
        as_json=as_json,
    )


def already(path: Path, **options: Any) -> dict[str, Any] | None:
    """The report of a take that is newer than all that its session names, with all exports."""
    from fusecap.errors import TakeError
    from fusecap.recording.layout import SUFFIX
    from fusecap.sources.session_file import input_files, load_session
    from fusecap.stored_take import StoredTake
    from fusecap.take import made_by

    if path.suffix == SUFFIX:
        target, inputs = _recording_take(path, as_live=options["as_live"]), [path]
    else:
        loaded = load_session(path)
        target, inputs = _session_take(loaded), input_files(loaded)
    wanted = [target, *([target.with_suffix(".png")] if options["picture"] else [])]
    try:
        if not are_newer(wanted, inputs):
            return None
        exports = checked_exports(
            "--export", options["export"] or "", options["unit"], options["rig"]
        )
        with StoredTake(target) as stored:
            told = stored.provenance
            planned = exports.planned(stored, target)
        if told.get("made_by") != made_by() or not isinstance(told.get("report"), dict):
            return None
        if planned and not are_newer([file.path for file in planned], [target]):
            return None
    except TakeError:
        return None
    return {**told["report"], "files": [str(target)]}


def _row(report: dict[str, Any]) -> list[str]:
    people = report["subjects"].values()

    def worst(key: str, form: str, of: Callable[[Iterable[float]], float], unit: float) -> str:
        known = [each[key] for each in people if each[key] is not None]
        return form.format(unit * of(known)) if known else "-"

    return [
        str(len(people)),
        worst("tracked_share", "{:.1f} %", min, 100.0),
        worst("bone_sigma_deg", "{:.1f}", max, 1.0),
        worst("position_sigma_m", "{:.0f}", max, 1e3),
        str(len(report["notes"])),
    ]


def _solve_one(
    session: Path,
    out: Path | None,
    exports: Exports,
    picture: bool,
    as_live: bool,
    anyway: bool,
    as_json: bool,
) -> None:
    from fusecap.batch.solve import refuse_errors, solve_session
    from fusecap.cli.detect import detect_missing, print_detection
    from fusecap.exports.take_format import ExportOptions
    from fusecap.recording.layout import SUFFIX
    from fusecap.sources.session_cameras import open_rig
    from fusecap.sources.session_data import open_session
    from fusecap.sources.session_file import load_session

    if session.suffix == SUFFIX:
        _solve_recording(
            session, out, exports, picture=picture, as_live=as_live, anyway=anyway, quiet=as_json
        )
        return
    if as_live:
        raise InputError(f"--as-live: {session} is no recording (.mcap) of a live run")
    loaded = load_session(session)
    target = _take_path(out, _session_take(loaded))
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
    if solved.is_empty:
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

    target = _take_path(out, _recording_take(path, as_live=as_live))
    recording = Recording(path)
    replay: dict[str, dict[str, int]] = {}
    with progress(quiet=quiet) as show:
        if as_live:
            solved, again = solve_as_live(recording, progress=show)
            replay = {"replay": {"poses": again.poses, "equal": again.equal}}
        else:
            solved = solve_recording(recording, progress=show, anyway=anyway)
    if solved.is_empty:
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


def _session_take(session: Session) -> Path:
    from fusecap.files import safe_name

    return session.folder / f"{safe_name(session.settings.name)}.npz"


def _recording_take(path: Path, *, as_live: bool) -> Path:
    return path.with_name(path.stem + ("-as-live.npz" if as_live else ".npz"))


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
    people = table_of("subject", "tracked", "measured", "bones +- deg", "joints +- mm", "height m")
    for name, values in report.subjects.items():
        people.add_row(
            name,
            f"{100 * values['tracked_share']:.1f} %",
            f"{100 * values['measured_share']:.1f} %",
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
