"""What refining cameras from people gains: the demo's scene (simulated), Pose2Sim's clips (real).

    uv run python benchmarks/people_calibration.py simulated [--seeds 5] [--deg 2] [--cm 5]
    uv run python benchmarks/people_calibration.py pose2sim \\
        DATA/pose2sim_demo/v0.8.4_openpose_body25b [--refine focal]

Simulated: every camera of the demo is believed to stand elsewhere (normal errors per axis); the
session is solved with that rig, with the refined and with the true one. Cameras' distances from the
truth are given as they stand ("world", the truth's own) and after the best similarity ("shape").

Pose2Sim: each clip is refined on its own and checked on its held-out blocks, then on all of the
other clip, split by person: one of the two in the second clip is computer-made, the other moves as
in the first clip.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fusecap import load_session, open_session
from fusecap.batch.solve import solve_session
from fusecap.calibrate.cameras.people import check_rigs, refine_from_people
from fusecap.calibrate.cameras.people_gauge import align, motions
from fusecap.calibrate.cameras.people_report import PeopleCalibration
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.rig_noise import RigNoise, believed
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_session import write_session
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files.formats import aniposelib
from fusecap.sources.session_data import SessionData

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))


def simulated(seeds: int, deg: float, cm: float, seconds: float) -> None:
    print(f"simulated; {deg:g} deg and {cm:g} cm per axis and camera, {seconds:g} s")
    print(
        "seed  held-out px        centre mm (world) before after   deg before after   "
        "shape mm deg   joints mm rough refined true   aligned mm rough refined true   "
        "floor mm deg: rough, refined   s"
    )
    for seed in range(seeds):
        scene = demo_scene(seed, seconds=seconds)
        rough = believed(
            np.random.default_rng(seed), scene.rig, RigNoise(rotation_deg=deg, position_m=cm / 100)
        )
        folder = Path(tempfile.mkdtemp(prefix="people-"))
        try:
            path = write_session(scene, folder)
            # Poses come from cameras alone: the sensors would hide what cameras get wrong.
            text = path.read_text()
            path.write_text("\n".join(b for b in text.split("\n\n") if "subject.imu" not in b))
            (folder / "calibration.toml").write_text(aniposelib.dumps(rough.cameras))
            data = open_session(load_session(path))
        finally:
            shutil.rmtree(folder)
        started = time.perf_counter()
        found = refine_from_people(data)
        elapsed_s = time.perf_counter() - started
        errors = [
            score_take(solve_session(replace(data, rig=rig)).whole_take, scene.truth)
            for rig in (rough, found.rig, scene.rig)
        ]
        before, after = _off(rough, scene.rig), _off(found.rig, scene.rig)
        shape = _off(align(found.rig, scene.rig).similarity.rig(found.rig), scene.rig)
        joints = " ".join(f"{e.position_error_mm.mean:6.1f}" for e in errors)
        aligned = " ".join(f"{e.aligned_error_mm.mean:6.1f}" for e in errors)
        print(
            f"{seed:4d}  {found.before.median_px:5.1f} -> {found.after.median_px:5.2f}   "
            f"{before[0]:6.1f} {after[0]:6.1f}   {before[1]:5.2f} {after[1]:5.2f}   "
            f"{shape[0]:5.1f} {shape[1]:5.2f}   {joints}   {aligned}   {_floor(rough, scene.rig)}, "
            f"{_floor(found.rig, scene.rig)}   {elapsed_s:4.1f}",
            flush=True,
        )


def _off(rig: Rig, truth: Rig) -> tuple[float, float]:
    shift_m, angle_rad = motions(rig, truth)
    return 1e3 * float(shift_m.mean()), float(np.degrees(angle_rad.mean()))


def _floor(rig: Rig, truth: Rig) -> str:
    """How high y = 0 is above the true floor in the middle of the room, and its tilt."""
    to_truth = align(rig, truth).similarity
    up = to_truth.rotation[:, 1]
    height_m = float(up @ to_truth.translation_m / up[1])
    return f"{1e3 * height_m:+.0f} {np.degrees(np.arccos(min(up[1], 1.0))):.2f}"


def pose2sim(folder: Path, refine: tuple[str, ...]) -> None:
    import pose2sim_clip as clip

    sessions, found = {}, {}
    for trial in clip.TRIALS:
        with tempfile.TemporaryDirectory() as out:
            path = clip.write_session(folder, Path(out), trial)
            sessions[trial] = open_session(load_session(path))
        started = time.perf_counter()
        found[trial] = refine_from_people(sessions[trial], refine=refine)
        print(f"\n{trial}: {time.perf_counter() - started:.1f} s, refined {found[trial].refined}")
        _print(found[trial])
    for fitted, result in found.items():
        for tested, data in sessions.items():
            print(f"\nfitted on {fitted}, every frame of {tested}:")
            _print_cross(data, result)


def _print(found: PeopleCalibration) -> None:
    print(
        f"  held-out median {found.before.median_px:.1f} -> {found.after.median_px:.1f} px, "
        f"90 % {found.before.p90_px:.1f} -> {found.after.p90_px:.1f}; solved skeleton "
        f"{found.skeleton_before_px:.1f} -> {found.skeleton_after_px:.1f} px"
    )
    for camera in found.cameras:
        print(
            f"  {camera.name}: median {camera.before.median_px:.1f} -> "
            f"{camera.after.median_px:.1f}, 90 % {camera.before.p90_px:.1f} -> "
            f"{camera.after.p90_px:.1f} px; skeleton {camera.skeleton_before_px:.1f} -> "
            f"{camera.skeleton_after_px:.1f} px; moved {camera.moved_mm:.0f} mm "
            f"{camera.turned_deg:.2f} deg; repeat {camera.repeat_mm:.0f} mm "
            f"{camera.repeat_deg:.2f} deg; normal eq. {camera.sigma_mm:.0f} mm "
            f"{camera.sigma_deg:.2f} deg"
        )
    for note in found.notes:
        print(f"  note: {note}")


def _print_cross(data: SessionData, result: PeopleCalibration) -> None:
    for who, fits in check_rigs(data, result.rig, (data.rig, result.rig)).items():
        before, after = fits
        print(
            f"  {who}: median {before.median_px:.1f} -> {after.median_px:.1f} px, "
            f"90 % {before.p90_px:.1f} -> {after.p90_px:.1f} px, {after.keypoints} keypoints"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    what = parser.add_subparsers(dest="what", required=True)
    one = what.add_parser("simulated")
    one.add_argument("--seeds", type=int, default=5)
    one.add_argument("--deg", type=float, default=2.0)
    one.add_argument("--cm", type=float, default=5.0)
    one.add_argument("--seconds", type=float, default=12.0)
    two = what.add_parser("pose2sim")
    two.add_argument("folder", type=Path)
    two.add_argument("--refine", default="")
    arguments = parser.parse_args()
    if arguments.what == "simulated":
        simulated(arguments.seeds, arguments.deg, arguments.cm, arguments.seconds)
    else:
        pose2sim(arguments.folder, tuple(filter(None, arguments.refine.split(","))))


if __name__ == "__main__":
    main()
