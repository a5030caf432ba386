"""`fusecap calibrate extrinsics`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli import calibrate_from_people, calibrate_from_points
from fusecap.cli.calibrate_intrinsics import Every
from fusecap.cli.calibrations import (
    named_sources,
    print_verdict,
    write_report,
)
from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import console, err, progress, table_of, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.cameras.board import Board
    from fusecap.calibrate.cameras.board_views import CameraShots
    from fusecap.calibrate.cameras.report import RigCalibration
    from fusecap.geometry.camera import Camera, Rig

EXAMPLE = (
    "Example: fusecap calibrate extrinsics left=left.mp4 right=right.mp4 --board board.toml "
    "--intrinsics intrinsics.toml --out calibration.toml"
)


def extrinsics(
    sources: Annotated[
        list[str] | None,
        typer.Argument(
            help="CAMERA=SOURCE: a video, a folder of images or a quoted pattern; repeat it.",
            show_default=False,
        ),
    ] = None,
    board: Annotated[
        Path | None, typer.Option(help="board.toml: kind, columns, rows, square_m.")
    ] = None,
    intrinsics: Annotated[
        Path | None,
        typer.Option(
            help="Calibration with these cameras' lenses; without, they are estimated from the "
            "same images."
        ),
    ] = None,
    timestamps: Annotated[
        Path | None,
        typer.Option(help="CSV with sync_index, cam_id, frame_time; without, frame numbers match."),
    ] = None,
    refine_intrinsics: Annotated[
        bool,
        typer.Option(
            "--refine-intrinsics",
            help="Also adjust focal length, centre, k1 and k2; always so without --intrinsics.",
        ),
    ] = False,
    origin_frame: Annotated[
        int | None,
        typer.Option(
            help="Frame number, or sync_index, at which the board lies on the floor: the world's "
            "origin, y up. Without, the first camera is the world."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The calibration to write; calibration.toml.", show_default=False),
    ] = None,
    every: Every = None,
    seed: Annotated[int, typer.Option(help="Of the resampled instants.")] = 0,
    points: Annotated[
        Path | None,
        typer.Option(
            help="CSV of marked points whose places were measured: each camera of --intrinsics is "
            "placed by the ones it shows; without a board."
        ),
    ] = None,
    up: Annotated[str, typer.Option(help="Up axis of the places of --points: y, z or -y.")] = "y",
    from_people: Annotated[
        Path | None,
        typer.Option(
            help="Session whose cameras are refined from the people they see; without a board."
        ),
    ] = None,
    refine: Annotated[
        list[str] | None,
        typer.Option(
            help="With --from-people: focal, centre or distortion may move too, where held-out "
            "keypoints gain by it; repeat it."
        ),
    ] = None,
    write: Annotated[
        bool,
        typer.Option(
            "--write",
            help="With --from-people: write refined.toml beside the session, and use it there.",
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Where cameras stand to each other, from a board that several see at the same instants.

    Writes the calibration, a report (.json) and a picture (.png). With --points, from points of the
    scene instead. With --from-people SESSION, a rough calibration is refined, from the keypoints of
    people who walk about.
    """
    if up != "y" and points is None:
        raise typer.BadParameter("goes with --points", param_hint="--up")
    of_boards = {
        "--timestamps": timestamps is not None,
        "--refine-intrinsics": refine_intrinsics,
        "--origin-frame": origin_frame is not None,
        "--every": every is not None,
    }
    if from_people is not None:
        if sources or board is not None or points is not None:
            raise typer.BadParameter(
                "refines a session; it takes neither sources, --board nor --points",
                param_hint="--from-people",
            )
        _check_way("--from-people", of_boards | {"--intrinsics": intrinsics is not None})
        calibrate_from_people.from_people(
            from_people, out=out, write=write, refine=refine or (), as_json=as_json
        )
        return
    if refine:
        raise typer.BadParameter(
            "goes with --from-people; boards have --refine-intrinsics", param_hint="--refine"
        )
    if write:
        raise typer.BadParameter(
            "goes with --from-people; boards know no session", param_hint="--write"
        )
    if points is not None:
        if sources or board is not None:
            raise typer.BadParameter(
                "takes marks; leave out sources and --board", param_hint="--points"
            )
        _check_way("--points", of_boards)
        calibrate_from_points.from_points(
            points, intrinsics=intrinsics, up=up, out=out, as_json=as_json
        )
        return
    from fusecap.calibrate.cameras.board import read_board
    from fusecap.calibrate.cameras.report import calibrate_rig
    from fusecap.calibrate.pictures import plot_rig
    from fusecap.sources.calibration_files.writer import check_rig_path, write_rig

    if not sources or board is None:
        raise typer.BadParameter(
            "name each camera with its source, CAMERA=SOURCE, and the board with --board"
        )
    named = named_sources(sources)
    if len(named) < 2:
        raise typer.BadParameter(
            "expected two cameras or more; one camera has only intrinsics", param_hint="SOURCES"
        )
    out = out or Path("calibration.toml")
    check_rig_path(out)
    target = read_board(board)
    with progress(quiet=as_json) as show:
        lenses = None if intrinsics is None else _lenses(intrinsics, list(named))
        found = _shots(named, target, timestamps, every, show)
        moving = refine_intrinsics or lenses is None
        if lenses is None:
            from fusecap.calibrate.cameras.intrinsics import calibrate_intrinsics

            lenses = [
                calibrate_intrinsics(shots, target, seed=seed, progress=show).camera
                for shots in found
            ]
        result = calibrate_rig(
            lenses, found, target, refine_intrinsics=moving, seed=seed, progress=show
        )
    rig = _in_world(result, found, target, origin_frame)
    report = result.report
    notes = [
        f"{report.verdict}: {report.held_out_median_px:.2f} px median on held-out instants, "
        f"squares {100 * report.scale.mean:.2f} % of the stated size",
        "World: the first camera's axes."
        if origin_frame is None
        else f"World: the board on the floor at instant {origin_frame}, y up.",
    ]
    files = write_rig(out, rig, notes=notes)
    picture = out.with_suffix(".png")
    plot_rig(result, found, picture)
    from dataclasses import asdict

    as_dict = asdict(report) | {
        "board": target.words,
        "intrinsics_refined": moving,
        "centres_in_world_m": {c.name: c.position_in_world for c in rig.cameras},
    }
    files += [picture, write_report(out, as_dict)]
    if as_json:
        print_json(as_dict | {"files": [str(file) for file in files]})
        return
    _print(result, refine=moving)
    wrote(*files)
    if origin_frame is None:
        console.print(
            "the first camera is the world; place it in the room: fusecap calibrate world "
            f"{out} --board {board} --floor CAMERA=IMAGE --out world.toml",
            soft_wrap=True,
        )


def _check_way(way: str, given: Mapping[str, bool]) -> None:
    """Raises `BadParameter` for an option of boards that is given besides."""
    for option, is_given in given.items():
        if is_given:
            raise typer.BadParameter(f"goes with --board; leave it or {way} out", param_hint=option)


def _lenses(path: Path, names: list[str]) -> list[Camera]:
    from fusecap.errors import CalibrationError
    from fusecap.sources.calibration_files import load_lenses

    rig = load_lenses(path)
    strange = [name for name in names if name not in rig.names]
    if strange:
        raise CalibrationError(
            f"{path}: has no camera '{strange[0]}', only {', '.join(rig.names)}; write "
            "CAMERA=SOURCE with its names"
        )
    return [rig[name] for name in names]


def _shots(
    named: dict[str, str], board: Board, timestamps: Path | None, every: int | None, show
) -> list[CameraShots]:
    from fusecap.calibrate.cameras.board_views import (
        common_step,
        in_step,
        read_shots,
        read_timestamps,
        sync_of,
    )

    by_id = read_timestamps(timestamps) if timestamps else None
    every = every or common_step(named.values())
    return list(
        in_step(
            [
                read_shots(
                    name,
                    source,
                    board,
                    every=every,
                    sync=None if by_id is None else sync_of(name, source, by_id),
                    progress=show,
                )
                for name, source in named.items()
            ]
        )
    )


def _in_world(
    result: RigCalibration, found: list[CameraShots], board: Board, origin_frame: int | None
) -> Rig:
    from fusecap.errors import CalibrationError
    from fusecap.geometry.camera import Rig

    rig = Rig(cameras=result.solution.cameras)
    if origin_frame is None:
        return rig
    from fusecap.calibrate.cameras.world_frame import from_board

    views = {
        shots.name: shot.view
        for shots in found
        for shot in shots.shots
        if shot.instant == origin_frame
    }
    if not views:
        seen = sorted({shot.instant for shots in found for shot in shots.shots})
        raise CalibrationError(
            f"--origin-frame {origin_frame}: no camera shows the board there; it was found at "
            f"{len(seen)} instants from {seen[0]} to {seen[-1]}, such as "
            f"{min(seen, key=lambda i: abs(i - origin_frame))}"
        )
    return from_board(rig, board, views).change.rig(rig)


def _print(result: RigCalibration, *, refine: bool) -> None:

    report = result.report
    console.print(
        "errors on held-out instants; by others: predicted from the other cameras, median"
    )
    table = table_of(
        "camera",
        "views",
        "rms px",
        "median px",
        "by others",
        "covered",
        "+- mm",
        "+- deg",
    )
    for column in table.columns:
        column.no_wrap = True
    for row in report.cameras:
        table.add_row(
            row.name,
            str(row.views),
            f"{row.held_out_px:.2f}",
            f"{row.held_out_median_px:.2f}",
            f"{row.predicted_median_px:.2f}",
            f"{100 * row.coverage:.0f} %",
            f"{row.centre_spread_mm:.1f}",
            f"{row.rotation_spread_deg:.2f}",
        )
    console.print(table)
    console.print(
        f"  {report.instants} instants; intrinsics {'refined' if refine else 'as given'}; rig "
        f"{report.rig_size_m:.2f} m across; squares {100 * report.scale.mean:.2f} % of the stated "
        f"size, one edge +- {100 * report.scale.spread:.2f} %",
        soft_wrap=True,
    )
    left_out = [f"{view.camera} {view.label}" for view in report.views if view.left_out]
    if left_out:
        err.print(
            f"left out, they contradict the rest: {', '.join(left_out)}",
            soft_wrap=True,
        )
    print_verdict("calibration", report.verdict, report.advice)
