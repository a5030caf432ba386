"""`fusecap calibrate world`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.calibrate.verdict import Verdict
from fusecap.cli.calibrations import print_verdict
from fusecap.cli.common import Json, check_choice, length_m, named, named_once, print_json
from fusecap.cli.terminal import console, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.cameras.board import Board, BoardView
    from fusecap.calibrate.cameras.resting_imu import RestingImu
    from fusecap.calibrate.cameras.world_frame import NewWorld
    from fusecap.findings import Finding
    from fusecap.geometry.camera import Rig
    from fusecap.geometry.similarity import Similarity
    from fusecap.sources.marked_points import MarkedPoints

EXAMPLE = (
    "Example: fusecap calibrate world calibration.toml --board board.toml "
    "--floor left=floor_left.png --floor right=floor_right.png --out world.toml"
)


def world(
    calibration: Annotated[Path, typer.Argument(help="Cameras in any world.", show_default=False)],
    out: Annotated[
        Path,
        typer.Option(
            help="The calibration to write: .toml, .qca.txt, .json or a folder.", show_default=False
        ),
    ],
    board: Annotated[
        Path | None, typer.Option(help="board.toml of the board on the floor.")
    ] = None,
    floor: Annotated[
        list[Path] | None,
        typer.Option(help="CAMERA=IMAGE that shows the board lying on the floor; repeat it."),
    ] = None,
    board_thickness: Annotated[
        str, typer.Option(help="How high its face lies above the floor, such as 5mm.")
    ] = "0mm",
    points: Annotated[
        Path | None, typer.Option(help="CSV of marked points whose places were measured.")
    ] = None,
    floor_points: Annotated[
        Path | None, typer.Option(help="CSV of marked points that lie on the floor.")
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option(help="CAMERA=FILE or board=FILE: an IMU at rest, fixed to it or lying on it."),
    ] = None,
    imu_axes: Annotated[
        str,
        typer.Option(
            help="Where the sensor's x and y point, in the camera's image or on the board as one "
            "looks at it: right, left, up, down, forward (away from the viewer), back."
        ),
    ] = "right,up",
    imu_format: Annotated[str, typer.Option(help="As in a session file.")] = "csv",
    imu_sensor: Annotated[str | None, typer.Option(help="Of a file that holds several.")] = None,
    imu_up: Annotated[str, typer.Option(help="Up axis of its reference world: z or y.")] = "z",
    north: Annotated[
        str | None,
        typer.Option(
            help="What a compass reads along the new x axis in degrees (0 north, 90 east), "
            "or imu: the heading of the IMU of --gravity."
        ),
    ] = None,
    reference: Annotated[
        str,
        typer.Option(
            help="The IMUs' reference world, for --north in degrees: nwu (x is north) or enu."
        ),
    ] = "nwu",
    scale_by: Annotated[
        str | None,
        typer.Option(
            help="board, points, or A,B=LENGTH: two cameras or marked points that far apart."
        ),
    ] = None,
    turned: Annotated[
        list[str] | None,
        typer.Option(
            help="CAMERA=90, 180 or 270: its pictures were turned clockwise by so much since it "
            "was calibrated; alone or with any way; repeat it."
        ),
    ] = None,
    up: Annotated[str, typer.Option(help="Up axis of the calibration as it is: y, z or -y.")] = "y",
    unit: Annotated[str, typer.Option(help="Of the calibration, where open: m, cm or mm.")] = "m",
    as_json: Json = False,
) -> None:
    """Put calibrated cameras into the world: floor at y = 0, y up, and north where IMUs have it."""
    from fusecap.calibrate.cameras import world_frame as frame
    from fusecap.geometry.similarity import Similarity
    from fusecap.sources.calibration_files import check_rig, load_rig, write_rig
    from fusecap.sources.marked_points import read_marked_points

    check_choice("--up", up, ("y", "z", "-y"))
    check_choice("--unit", unit, ("m", "cm", "mm"))
    check_choice("--imu-up", imu_up, ("z", "y"))
    check_choice("--reference", reference, tuple(frame.REFERENCES))
    thickness_m = (
        0.0 if board_thickness == "0mm" else length_m("--board-thickness", board_thickness)
    )
    _check_way(board, floor, points, floor_points, gravity, north, turned)
    bearing_deg = None if north in (None, "imu") else _degrees(north)
    rig = _turned(load_rig(calibration, up=up, unit=unit), turned or [])
    imu, body = _resting(gravity, imu_format, imu_sensor, imu_axes, imu_up, rig, board is not None)

    file = points or floor_points
    marked = read_marked_points(file, rig.names) if file else None
    change = _known_length(rig, scale_by, marked)
    placed = change.rig(rig)
    if board is not None:
        views, target = _views(placed, board, floor or [])
        placement = frame.from_board(
            placed,
            target,
            views,
            thickness_m=thickness_m,
            up_in_board=imu.up_in_body if imu else None,
            scale=scale_by == "board",
        )
    elif points is not None and marked is not None:
        placement = frame.from_points(placed, marked, scale=scale_by == "points")
    else:
        up_in_old = placed[body].rotation.T @ imu.up_in_body if imu else None
        if marked is not None:
            placement = frame.from_floor_points(placed, marked, up_in_old=up_in_old)
        elif up_in_old is not None:
            placement = frame.from_gravity(up_in_old)
        else:
            placement = frame.NewWorld(change=Similarity(), how="the calibration's own")
    change = placement.change.after(change)
    if bearing_deg is not None:
        change = frame.to_north(bearing_deg, reference).after(change)
    elif north == "imu" and imu is not None:
        attitude = placement.world_from_board
        if attitude is None:
            attitude = change.rotation @ rig[body].rotation.T
        change = frame.to_reference(imu.reference_from_body, attitude).after(change)
    result = change.rig(rig)
    findings = check_rig(result)
    note = f"world: {placement.how}" + (f", north by {north}" if north else "")
    files = write_rig(out, result, notes=[note])
    report = _report(rig, result, change, placement, imu, findings, files)
    if as_json:
        print_json(report)
    else:
        _print(report)


def _no_way() -> typer.BadParameter:
    return typer.BadParameter(
        "give one of --board with --floor, --points, --floor-points, --gravity, --turned; "
        "--gravity also goes with --board or --floor-points"
    )


def _check_way(
    board: Path | None,
    floor: list[Path] | None,
    points: Path | None,
    floor_points: Path | None,
    gravity: str | None,
    north: str | None,
    turned: list[str] | None,
) -> None:
    ways = [board, points, floor_points]
    if sum(way is not None for way in ways) > 1 or not (gravity or turned or any(ways)):
        raise _no_way()
    if (board is None) != (not floor):
        raise typer.BadParameter("--board and --floor go together: what lies there, and its images")
    if gravity is not None and points is not None:
        raise typer.BadParameter("--points say what is up already; leave out --gravity")
    if north == "imu" and gravity is None:
        raise typer.BadParameter("--north imu needs the IMU of --gravity")


def _turned(rig: Rig, turned: list[str]) -> Rig:
    """Of cameras whose pictures were turned since they were calibrated."""
    from fusecap.geometry.camera import Rig

    degrees = named_once("--turned", turned, "CAMERA=90, 180 or 270")
    for name, text in degrees.items():
        check_choice("--turned", text, ("90", "180", "270"))
        rig[name]
    return Rig(cameras=tuple(c.turned(int(degrees.get(c.name, "0"))) for c in rig.cameras))


def _degrees(text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        raise typer.BadParameter(
            f"'{text}': expected degrees, or imu", param_hint="--north"
        ) from None


def _resting(
    gravity: str | None,
    imu_format: str,
    sensor: str | None,
    axes: str,
    imu_up: str,
    rig: Rig,
    on_board: bool,
) -> tuple[RestingImu | None, str]:
    """The IMU at rest, and the camera's name it is fixed to or 'board'."""
    if gravity is None:
        return None, ""
    from fusecap.calibrate.cameras.resting_imu import resting_imu
    from fusecap.errors import InputError
    from fusecap.sources.imu_files import read_imu

    body, path = named("--gravity", gravity, "CAMERA=FILE or board=FILE")
    if on_board and body != "board":
        raise typer.BadParameter(
            "with --board the IMU lies on the board: board=FILE", param_hint="--gravity"
        )
    if not on_board:
        if body == "board":
            raise typer.BadParameter("board=FILE needs --board and --floor", param_hint="--gravity")
        rig[body]
    try:
        track = read_imu(path, format=imu_format, sensor=sensor)
        return resting_imu(track, axes=axes, imu_up=imu_up), body
    except InputError as error:
        message = str(error)
        raise InputError(message if path in message else f"{path}: {message}") from None


def _known_length(rig: Rig, scale_by: str | None, marked: MarkedPoints | None) -> Similarity:
    from fusecap.calibrate.cameras.world_frame import known_length
    from fusecap.geometry.similarity import Similarity

    if scale_by in (None, "board", "points"):
        return Similarity()
    pair, length = named("--scale-by", scale_by or "", "board, points, or A,B=LENGTH")
    first, comma, second = pair.partition(",")
    if not comma:
        raise typer.BadParameter(
            f"'{scale_by}': expected board, points, or A,B=LENGTH", param_hint="--scale-by"
        )
    return known_length(rig, first.strip(), second.strip(), length_m("--scale-by", length), marked)


def _views(rig: Rig, board_file: Path, floor: list[Path]) -> tuple[dict[str, BoardView], Board]:
    """The board in each camera's image; raises `CalibrationError` for an image without it."""
    from fusecap.calibrate.cameras.board import read_board, why_not_found
    from fusecap.calibrate.cameras.board_views import read_grey
    from fusecap.errors import CalibrationError

    board = read_board(board_file)
    views = {}
    for name, path in named_once("--floor", map(str, floor), "CAMERA=IMAGE").items():
        camera = rig[name]
        image = read_grey(path)
        if (image.shape[1], image.shape[0]) != camera.size_px:
            raise CalibrationError(
                f"{path} is {image.shape[1]} x {image.shape[0]} px, camera '{name}' was calibrated "
                f"at {camera.size_px[0]} x {camera.size_px[1]}; take the image at that resolution"
            )
        view = board.detect(image)
        if view is None:
            why = why_not_found(board, [image]) or (
                "expected it whole, unblurred and well lit, squares 15 px wide or more"
            )
            raise CalibrationError(f"{path}: the board is not found in it; {why}")
        views[name] = view
    return views, board


def _report(
    rig: Rig,
    result: Rig,
    change: Similarity,
    placement: NewWorld,
    imu: RestingImu | None,
    findings: list[Finding],
    files: list[Path],
) -> dict[str, Any]:
    from dataclasses import asdict

    problems = list(placement.problems)
    if imu is not None and imu.contradiction_deg > 3.0:
        problems.append(
            f"the sensor's accelerometer and its orientation disagree by "
            f"{imu.contradiction_deg:.1f} deg about what is up; check --imu-up"
        )
    below = [c.name for c in result.cameras if c.position_in_world[1] < 0]
    if below:
        problems.append(
            f"{', '.join(below)}: below the floor; the floor's points or board are seen from "
            "beneath, or lie above the floor"
        )
    problems += [f"{f.where}: {f.found}; {f.remedy}" for f in findings if not below]
    return {
        "how": placement.how,
        "change": {
            "turned_deg": change.angle_deg,
            "origin_of_the_old_world_m": change.translation_m.tolist(),
            "scale": change.scale,
        },
        "residuals": [asdict(residual) for residual in placement.residuals],
        "rms_mm": placement.rms_mm,
        "rms_px_of_1920": placement.rms_px,
        "tilt_sd_deg": placement.tilt_deg,
        "found_scale": placement.found_scale,
        "imu_spread_m_s2": imu.spread_m_s2 if imu else None,
        "camera_position_m": {c.name: c.position_in_world.tolist() for c in result.cameras},
        "verdict": Verdict.POOR if problems else Verdict.GOOD,
        "problems": problems,
        "files": [str(path) for path in files],
    }


def _print(report: dict[str, Any]) -> None:
    change = report["change"]
    x, y, z = change["origin_of_the_old_world_m"]
    console.print(f"World from {report['how']}", soft_wrap=True)
    console.print(
        f"  turned             {change['turned_deg']:.2f} deg; the old origin is at "
        f"{x:.3f}, {y:.3f}, {z:.3f} m",
        soft_wrap=True,
    )
    if abs(change["scale"] - 1) > 1e-12:
        console.print(f"  scaled             by {change['scale']:.5f}")
    for residual in report["residuals"]:
        _print_residual(residual)
    for key, what, unit in (
        ("rms_mm", "root mean square", "mm"),
        ("rms_px_of_1920", "root mean square", "px of a 1920-pixel-wide image"),
        ("tilt_sd_deg", "tilt of the floor", "deg standard deviation, if errors are independent"),
    ):
        if report[key] is not None:
            console.print(f"  {what:<18} {report[key]:.2f} {unit}", soft_wrap=True)
    for name, place in report["camera_position_m"].items():
        console.print(
            f"  camera {name:<11} {place[1]:.3f} m above the floor, at x {place[0]:.3f}, "
            f"z {place[2]:.3f} m",
            soft_wrap=True,
        )
    print_verdict("world", report["verdict"], report["problems"])
    wrote(*report["files"])


def _print_residual(residual: dict[str, Any]) -> None:
    if residual["mm"] is None and residual["px"] is None:
        value = "not in two cameras that agree; not used"
    elif residual["mm"] is not None:
        value = f"{residual['mm']:.1f} mm" + ("" if residual["used"] else ", left out")
    else:
        value = f"{residual['px']:.2f} px"
    console.print(f"  {residual['name']:<18} {value}", soft_wrap=True)
