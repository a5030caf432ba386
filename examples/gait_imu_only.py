"""A walk from seven IMUs alone, scored against Vicon: the gait sample of gait-tech/gaittoolbox.

    uv run python examples/gait_imu_only.py DATA_FOLDER [--out FOLDER]

DATA_FOLDER holds `imu/` (Xsens, 100 Hz), `calib/` (yaw corrections of some sensors) and
`vicon_first_400.csv` (joints and segment quaternions, z up). The script writes a session with one
`[[subject.imu]]` per sensor, solves it, scores it and draws `gait.png`.

The recording has no T-pose. How each sensor sits on its bone is therefore taken from Vicon's
segment orientations over the first 0.5 s: the result is calibrated by Vicon, and only later frames
are scored. Where the walker is, and how high, no IMU observes: the root stays where it started, and
the floor term, which would lift it, is off. Bones without a sensor follow the pose prior.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from fusecap import Take, load_session, open_session, save_take, solve_session
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.sources.imu_files import read_imu

TRIAL = "S02-Trial-Walk-1"
RATE_HZ = 100.0
CALIBRATION_FRAMES = 50
SEGMENTS = {
    "hips": ("Pelvis", "qRPV"),
    "left_thigh": ("L_UpLeg", "qLTH"),
    "right_thigh": ("R_UpLeg", "qRTH"),
    "left_shank": ("L_LowLeg", "qLSK"),
    "right_shank": ("R_LowLeg", "qRSK"),
    "left_foot": ("L_Foot", "qLFT"),
    "right_foot": ("R_Foot", "qRFT"),
}
"""Bone to the sensor on it and Vicon's name of its orientation."""

SEGMENT_FROM_BONE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Vicon's segments have x forward, y left, z up; our bones x left, y up, z forward."""
SEGMENT_FROM_FLAT_FOOT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Vicon's feet have z from ankle to toe marker, y left, x down."""


@dataclass(frozen=True, kw_only=True)
class Vicon:
    """The truth, F frames, in our y-up world."""

    rotation: dict[str, Rotation]
    """world_from_bone (F,)."""
    position_m: dict[str, np.ndarray]
    """Joint centres (F, 3) by bone, the joint at the bone's root."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """Errors after the calibration interval, in degrees."""

    orientation_deg: dict[str, float]
    """Mean angle between solved and Vicon's bone."""
    long_axis_deg: dict[str, float]
    """The part of it that turns the bone's long axis; the rest is twist about that axis."""
    sensor_deg: dict[str, float]
    """What the sensor alone gives with the same calibration."""
    knee_rmse_deg: dict[str, float]
    knee_flexion_deg: dict[str, tuple[np.ndarray, np.ndarray]]
    """Solved and Vicon's flexion (F,) by side, positive when the heel comes up behind."""


def read_vicon(path: Path) -> Vicon:
    """Segment frames are turned into bone frames; the sole is level where the foot stands still."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("//")]
    rows = list(csv.DictReader(lines))

    def columns(name: str, numbers: str) -> np.ndarray:
        return np.array([[float(row[f"{name}_{i}"]) for i in numbers] for row in rows])

    joints = {
        f"{side}_{bone}": columns(f"{side[0].upper()}{name}", "123") @ Y_UP_FROM_Z_UP.T
        for side in ("left", "right")
        for bone, name in (("thigh", "FEP"), ("shank", "FEO"), ("foot", "TIO"), ("toes", "TOE"))
    }
    rotation = {}
    for bone, (_, name) in SEGMENTS.items():
        segment_from_bone = SEGMENT_FROM_BONE
        if bone.endswith("_foot"):
            ankle, toe = joints[bone], joints[bone.replace("foot", "toes")]
            standing = np.linalg.norm(np.gradient(ankle, axis=0), axis=1) * RATE_HZ < 0.2
            along = (toe - ankle)[standing]
            down = np.arctan2(-along[:, 1], np.hypot(along[:, 0], along[:, 2]))
            level = Rotation.from_euler("x", -np.median(down)).as_matrix()
            segment_from_bone = SEGMENT_FROM_FLAT_FOOT @ level
        rotation[bone] = Rotation.from_matrix(
            Y_UP_FROM_Z_UP
            @ Rotation.from_quat(columns(name, "2341")).as_matrix()
            @ segment_from_bone
        )
    return Vicon(rotation=rotation, position_m=joints)


def heading_deg(folder: Path) -> dict[str, float]:
    """Yaw correction of each sensor about world up; sensors that are not listed need none."""
    path = folder / "calib" / f"{TRIAL}-Calib-SensorYawFixWorldFrame.txt"
    with path.open() as file:
        return {
            row["name"]: float(
                np.degrees(2 * np.arctan2(float(row["q_ori_4"]), float(row["q_ori_1"])))
            )
            for row in csv.DictReader(file)
        }


def imu_file(folder: Path, sensor: str) -> Path:
    return (folder / "imu" / f"{TRIAL}-{sensor}.csv").resolve()


def world_from_imu(folder: Path, sensor: str) -> Rotation:
    """The sensor's orientation in our world, heading corrected."""
    track = read_imu(imu_file(folder, sensor), format="gaittoolbox-csv")
    heading = Rotation.from_euler("y", heading_deg(folder).get(sensor, 0.0), degrees=True)
    upright = Rotation.from_matrix(Y_UP_FROM_Z_UP)
    return heading * upright * Rotation.from_quat(track.orientation_wxyz[:, [1, 2, 3, 0]])


def bone_from_imu(folder: Path, vicon: Vicon, bone: str) -> Rotation:
    """Calibration by Vicon: the mean offset over the first half second."""
    first = slice(CALIBRATION_FRAMES)
    return (
        vicon.rotation[bone][first].inv() * world_from_imu(folder, SEGMENTS[bone][0])[first]
    ).mean()


def write_session(folder: Path, out: Path) -> Path:
    """The session file, in a folder of its own."""
    vicon = read_vicon(folder / "vicon_first_400.csv")
    heading = heading_deg(folder)
    lines = ["[session]", 'name = "gait"', f"rate_hz = {RATE_HZ}", "floor = false", ""]
    lines += ["", "[[subject]]", 'name = "walker"']
    for bone, (sensor, _) in SEGMENTS.items():
        x, y, z, w = bone_from_imu(folder, vicon, bone).as_quat()
        lines += [
            "",
            "[[subject.imu]]",
            f'bone = "{bone}"',
            f"file = '{imu_file(folder, sensor)}'",
            'format = "gaittoolbox-csv"',
            f"heading_deg = {heading.get(sensor, 0.0):.3f}",
            f"bone_from_imu_wxyz = [{w:.6f}, {x:.6f}, {y:.6f}, {z:.6f}]",
        ]
    out.mkdir(parents=True, exist_ok=True)
    path = out / "session.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def score(take: Take, folder: Path) -> Score:
    """Compare with Vicon, from the end of the calibration to Vicon's last frame."""
    vicon = read_vicon(folder / "vicon_first_400.csv")
    frames = len(vicon.rotation["hips"])
    later = slice(CALIBRATION_FRAMES, frames)
    solved = {
        bone: Rotation.from_matrix(
            take.bone_rotation_in_world(0)[:frames, take.bone_names.index(bone)]
        )
        for bone in SEGMENTS
    }
    orientation, long_axis, sensor = {}, {}, {}
    for bone, (name, _) in SEGMENTS.items():
        truth = vicon.rotation[bone]
        alone = world_from_imu(folder, name)[:frames] * bone_from_imu(folder, vicon, bone).inv()
        axis = [0.0, 0.0, 1.0] if bone.endswith("_foot") else [0.0, 1.0, 0.0]
        cosine = np.sum(solved[bone].apply(axis) * truth.apply(axis), axis=1)
        orientation[bone] = _mean_deg((truth.inv() * solved[bone]).magnitude()[later])
        long_axis[bone] = _mean_deg(np.arccos(np.clip(cosine, -1, 1))[later])
        sensor[bone] = _mean_deg((truth.inv() * alone).magnitude()[later])
    flexion = {
        side: (
            knee_flexion_deg(solved[f"{side}_thigh"], solved[f"{side}_shank"]),
            knee_flexion_deg(vicon.rotation[f"{side}_thigh"], vicon.rotation[f"{side}_shank"]),
        )
        for side in ("left", "right")
    }
    return Score(
        orientation_deg=orientation,
        long_axis_deg=long_axis,
        sensor_deg=sensor,
        knee_rmse_deg={
            side: float(np.sqrt(np.mean((ours - theirs)[later] ** 2)))
            for side, (ours, theirs) in flexion.items()
        },
        knee_flexion_deg=flexion,
    )


def _mean_deg(angle_rad: np.ndarray) -> float:
    return float(np.degrees(angle_rad).mean())


def knee_flexion_deg(thigh: Rotation, shank: Rotation) -> np.ndarray:
    """Between the long axes, in the thigh's sagittal plane; positive towards the back."""
    down = (thigh.inv() * shank).apply([0.0, -1.0, 0.0])
    return np.degrees(np.arctan2(-down[:, 2], -down[:, 1]))


def draw(take: Take, folder: Path, result: Score, path: Path) -> None:
    """Side views over one stride with Vicon's legs beneath, front views, and the knees' angles."""
    vicon = read_vicon(folder / "vicon_first_400.csv")
    figure = Figure(figsize=(15, 12), layout="constrained")
    stride = np.arange(150, 265, 14)
    for row, (title, horizontal, spacing_m) in enumerate(
        (("from its right", 2, 0.9), ("from the front", 0, 0.9))
    ):
        ax = figure.add_subplot(3, 1, row + 1)
        for place, frame in enumerate(stride):
            _draw_person(ax, take, vicon, int(frame), horizontal, place * spacing_m)
        ax.set_title(f"{title}; left thick, Vicon's legs grey, every {14 / RATE_HZ:.2f} s", size=9)
        ax.set_aspect("equal")
        ax.set_ylabel("y [m]")
        ax.set_xticks([])
        ax.axhline(0.0, color="0.5", linewidth=1)
    for column, (side, (ours, theirs)) in enumerate(result.knee_flexion_deg.items()):
        ax = figure.add_subplot(3, 2, 5 + column)
        time_s = np.arange(len(theirs)) / RATE_HZ
        ax.axvspan(0, CALIBRATION_FRAMES / RATE_HZ, color="0.9", label="calibration")
        ax.plot(time_s, theirs, color="0.4", label="Vicon")
        ax.plot(time_s, ours, color="C0", label="fusecap, IMUs only")
        ax.set_title(f"{side} knee: {result.knee_rmse_deg[side]:.1f} deg RMSE", size=9)
        ax.set_xlabel("s")
        ax.set_ylabel("flexion [deg]")
        ax.legend(fontsize=8)
    figure.savefig(path, dpi=80)


def _draw_person(ax, take: Take, vicon: Vicon, frame: int, horizontal: int, shift_m: float) -> None:
    position = take.bone_position_in_world_m[0, frame]
    root = position[0]
    middle = (vicon.position_m["left_thigh"] + vicon.position_m["right_thigh"])[frame] / 2
    thighs = [take.bone_names.index(f"{side}_thigh") for side in ("left", "right")]
    onto_ours = position[thighs].mean(axis=0) - middle
    for side in ("left", "right"):
        leg = [vicon.position_m[f"{side}_{b}"][frame] for b in ("thigh", "shank", "foot", "toes")]
        leg = np.array(leg) + onto_ours - root * [1, 0, 1]
        ax.plot(leg[:, horizontal] + shift_m, leg[:, 1], color="0.75", linewidth=5)
    for bone, parent in enumerate(take.parents):
        if parent < 0:
            continue
        ends = position[[parent, bone]] - root * [1, 0, 1]
        left = take.bone_names[bone].startswith("left")
        ax.plot(
            ends[:, horizontal] + shift_m,
            ends[:, 1],
            color="C0" if left else "C3",
            linewidth=2.4 if left else 1.2,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Solve the walk from IMUs alone.")
    parser.add_argument("folder", type=Path, metavar="DATA_FOLDER")
    parser.add_argument("--out", type=Path, help="keep session, take and picture here")
    arguments = parser.parse_args()
    out = arguments.out or Path(tempfile.mkdtemp(prefix="gait-"))
    solved = solve_session(open_session(load_session(write_session(arguments.folder, out))))
    save_take(solved.take, out / "take.npz")
    result = score(solved.take, arguments.folder)
    print("mean error [deg]   solved  long axis  sensor alone")
    for bone, error in result.orientation_deg.items():
        print(
            f"{bone:<18} {error:6.1f} {result.long_axis_deg[bone]:10.1f} "
            f"{result.sensor_deg[bone]:13.1f}"
        )
    for side, error in result.knee_rmse_deg.items():
        print(f"{side + ' knee flexion':<18} {error:6.1f} RMSE")
    print(f"{solved.report.solves} solves, median {solved.report.solve_ms_median:.2f} ms")
    draw(solved.take, arguments.folder, result, out / "gait.png")
    print(f"written to {out}")


if __name__ == "__main__":
    main()
