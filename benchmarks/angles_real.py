"""Leg angles of real walks against Vicon: raw, and after one constant per angle.

uv run python benchmarks/angles_real.py gait DATA/gait_imu_vicon
uv run python benchmarks/angles_real.py walker SESSION

`gait`: seven sensors, no camera, the sensors calibrated by Vicon's first half second; later frames
are scored. `walker`: a session of the KAM recordings with their `truth.npz` (the folder that
`walker1.tar.xz` holds), after `fusecap calibrate imu SESSION --write`; solved from cameras, from
sensors and from both. Its segments are known up to a constant rotation, which is taken from the
solve itself, and it has no pelvis and no feet: only thighs, shanks and knees are scored, and there
is no raw difference.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap import load_session, open_session, solve_session
from fusecap.angles.joint_angles import joint_angles
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.geometry.quaternions import to_wxyz
from fusecap.take import Take

LEG = ("hip_flexion", "knee_flexion", "ankle_dorsiflexion")
SIDES = ("left", "right")


def gait(folder: Path) -> None:
    """IMUs alone; frames after the calibration, to Vicon's last."""
    example = script("gait_imu_only")
    with tempfile.TemporaryDirectory() as out:
        session = load_session(example.write_session(folder, Path(out)))
        take = solve_session(open_session(session), anyway=True).whole_take
    vicon = example.read_vicon(folder / "vicon_first_400.csv").rotation
    first, end = example.CALIBRATION_FRAMES, len(vicon["hips"])
    take = take.of_frames(first, end)
    truth = with_bones(take, {bone: turn[first:] for bone, turn in vicon.items()})
    print(f"gait, {end - first} frames at {take.rate_hz:g} Hz, sensors alone")
    table(take, truth, LEG, raw=True)


def walker(folder: Path) -> None:
    """The treadmill walker from cameras, from sensors and from both."""
    session = load_session(folder)
    bare = tuple(one.model_copy(update={"imus": ()}) for one in session.subjects)
    for name, measured in (
        ("cameras", session.model_copy(update={"subjects": bare})),
        ("sensors", session.model_copy(update={"cameras": ()})),
        ("both", session),
    ):
        score_walker(name, solve_session(open_session(measured), anyway=True).whole_take, folder)


def score_walker(name: str, take: Take, folder: Path) -> None:
    """Segments and knees, and how the right foot trembles."""
    take = take.of_subjects([int(np.argmax(take.tracked.sum(axis=1)))])
    foot = take.bone_position_in_world_m[0, :, take.bone_names.index("right_foot")]
    third = np.linalg.norm(np.diff(foot, 3, axis=0), axis=1) * take.rate_hz**3
    known = np.load(folder / "truth.npz")
    time_s = take.time_s
    nearest = np.abs(time_s[None] - known["time_s"][:, None]).argmin(axis=1)
    there = np.abs(time_s[nearest] - known["time_s"]) < 0.6 / take.rate_hz
    there &= take.tracked[0, nearest]
    bones = [f"{side}_{bone}" for side in SIDES for bone in ("thigh", "shank")]
    there &= np.all([np.isfinite(known[f"R_{bone}"]).all(axis=(1, 2)) for bone in bones], axis=0)
    frames, rows = np.unique(nearest[there], return_index=True)
    take = take.at_frames(frames)
    turns, away = {}, {}
    for bone in bones:
        segment = Rotation.from_matrix(Y_UP_FROM_Z_UP @ known[f"R_{bone}"][there][rows])
        ours = Rotation.from_matrix(take.bone_rotation_in_world(0)[:, take.bone_names.index(bone)])
        turns[bone] = segment * (segment.inv() * ours).mean()
        away[bone] = np.degrees((turns[bone].inv() * ours).magnitude()).mean()
    told = ", ".join(f"{bone} {deg:.1f}" for bone, deg in away.items())
    print(f"\n{folder.name}, {name}, {len(frames)} frames, one constant rotation per segment")
    print(f"segments deg: {told}; mean {np.mean(list(away.values())):.1f}")
    print(f"right foot's jitter: {1e-3 * np.nanmean(third):.2f} km/s³")
    table(take, with_bones(take, turns), ("knee_flexion",), raw=False)


def table(take: Take, truth: Take, kinds: tuple[str, ...], *, raw: bool) -> None:
    """Per angle and side what lies between the two takes, and the stated error bars."""
    found, true = joint_angles(take), joint_angles(truth)
    print("| angle | raw RMSE | bias | one constant removed | stated sd | range |")
    print("|---|---|---|---|---|---|")
    for kind in kinds:
        for side in SIDES:
            column = found.names.index(f"{side}_{kind}")
            apart = (found.deg - true.deg)[0, :, column]
            apart = (apart + 180.0) % 360.0 - 180.0
            rms, rest = (np.sqrt(np.square(a).mean()) for a in (apart, apart - apart.mean()))
            stated = np.sqrt(np.square(found.sd_deg[0, :, column]).mean())
            told = f"{rms:.1f} | {apart.mean():+.1f}" if raw else "- | -"
            reach = np.ptp(true.deg[0, :, column])
            print(f"| {side} {kind} | {told} | {rest:.1f} | {stated:.1f} | {reach:.0f} |")


def with_bones(take: Take, turns: Mapping[str, Rotation]) -> Take:
    """The first person with these rotations in the world; where bones are is of no matter."""
    wxyz = take.bone_rotation_in_world_wxyz.copy()
    for bone, turn in turns.items():
        wxyz[0, :, take.bone_names.index(bone)] = to_wxyz(turn)
    return replace(take, bone_rotation_in_world_wxyz=wxyz)


def script(name: str) -> ModuleType:
    path = Path(__file__).resolve().parents[1] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("gait", "walker"))
    parser.add_argument("folder", type=Path)
    arguments = parser.parse_args()
    if arguments.what == "gait":
        gait(arguments.folder)
    else:
        walker(arguments.folder)


if __name__ == "__main__":
    main()
