"""`fusecap calibrate extrinsics --points`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from fusecap.calibrate.verdict import Verdict
from fusecap.cli.calibrations import print_verdict, write_report
from fusecap.cli.common import check_choice, print_json
from fusecap.cli.terminal import console, wrote

if TYPE_CHECKING:
    from fusecap.calibrate.cameras.scene_points import PlacedCamera


def from_points(
    points: Path, *, intrinsics: Path | None, up: str, out: Path | None, as_json: bool
) -> None:
    """Cameras by marked points, written as a calibration whose world is y up."""
    from fusecap.calibrate.cameras.scene_points import place_cameras
    from fusecap.geometry.camera import Rig
    from fusecap.sources.calibration_files import check_rig, load_lenses, write_rig
    from fusecap.sources.calibration_files.loader import Y_UP_FROM
    from fusecap.sources.calibration_files.plausibility import BELOW_FLOOR_M
    from fusecap.sources.calibration_files.writer import check_rig_path
    from fusecap.sources.marked_points import read_marked_points

    check_choice("--up", up, tuple(Y_UP_FROM))
    if intrinsics is None:
        raise typer.BadParameter(
            "needs the cameras' lenses: --intrinsics, as fusecap calibrate intrinsics writes them",
            param_hint="--points",
        )
    out = out or Path("calibration.toml")
    check_rig_path(out)
    lenses = load_lenses(intrinsics).cameras
    marked = read_marked_points(points, tuple(lens.name for lens in lenses))
    placed, unseen = place_cameras(lenses, marked)
    rig = Rig(cameras=tuple(each.camera for each in placed)).in_world(Y_UP_FROM[up])
    problems = [problem for each in placed for problem in each.problems]
    below = [c.name for c in rig.cameras if c.position_in_world[1] < BELOW_FLOOR_M]
    inverted = 2 * len(below) > len(rig)
    if inverted:
        problems.append(
            f"{', '.join(below)}: below the floor. The places say that up is down, a motion would "
            "come out upside down: change the sign of one horizontal coordinate of all points, or "
            "--up"
        )
    problems += [
        f"{finding.where}: {finding.found}; {finding.remedy}"
        for finding in check_rig(rig)
        if not inverted
    ]
    if unseen:
        problems.append(f"{', '.join(unseen)}: no point is marked in it, left out")
    files = write_rig(out, rig, notes=[f"World: {len(marked.names)} marked points, y up."])
    report = {
        "cameras": [_row(each, rig[each.camera.name].position_in_world) for each in placed],
        "verdict": Verdict.POOR if problems else Verdict.GOOD,
        "problems": problems,
    }
    files.append(write_report(out, report))
    report["files"] = [str(path) for path in files]
    if as_json:
        print_json(report)
        return
    for row in report["cameras"]:
        _print(row)
    print_verdict("calibration", report["verdict"], problems)
    wrote(*files)


def _row(placed: PlacedCamera, centre_m: Any) -> dict[str, Any]:
    return {
        "name": placed.camera.name,
        "position_m": centre_m.tolist(),
        "position_sd_mm": placed.place_sd_mm,
        "rms_px_of_1920": placed.rms_px,
        "points": [
            {"name": name, "px": float(px), "used": bool(used)}
            for name, px, used in zip(placed.names, placed.miss_px, placed.used, strict=True)
        ],
    }


def _print(row: dict[str, Any]) -> None:
    x, y, z = row["position_m"]
    console.print(
        f"camera {row['name']}: {y:.3f} m above the floor, at x {x:.3f}, z {z:.3f} m, "
        f"+- {row['position_sd_mm']:.0f} mm; marks miss by {row['rms_px_of_1920']:.1f} px of a "
        "1920-pixel-wide image",
        soft_wrap=True,
    )
    for point in row["points"]:
        left_out = "" if point["used"] else ", left out"
        console.print(f"  {point['name']:<18} {point['px']:.1f} px{left_out}", soft_wrap=True)
