"""A balancing person from four loosely calibrated cameras: the demo clips of Pose2Sim.

    uv run python examples/pose2sim_clip.py DATA_FOLDER [--trial two-people] [--out FOLDER]

DATA_FOLDER holds `Calib.qca.txt` (Qualisys, z up) and `pose_json.tar.xz` (OpenPose, BODY_25B
order, 100 frames at 60 Hz). The script unpacks a trial, writes a session for it, solves it with
default options and draws two pictures: stick figures in the world, and the solved landmarks over
the keypoints of two cameras.

In `two-people` the second person is a computer-made figure, cross-legged in mid-air. A bystander at
the edge of two cameras is in both trials; `max_subjects` leaves him out.
"""

from __future__ import annotations

import argparse
import tarfile
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fusecap import Take, load_session, open_session, save_take, solve_session
from fusecap.body.pose import landmarks_in_world
from fusecap.exports.plot import plot_take
from fusecap.sources.session_data import SessionData

RATE_HZ = 60.0
TRIALS = {
    "balancing": ("S00_P00_SingleParticipant/S00_P00_T01_BalancingTrial", 1),
    "two-people": ("S00_P01_MultiParticipants/S00_P01_T02_Participants1-2", 2),
}
"""Name to folder in the archive and number of people to report."""
DRAWN_CAMERAS = ("cam_02", "cam_03")
LINKS = [
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("head_top", "upper_neck")),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            *(("shoulder", "elbow"), ("elbow", "wrist"), ("shoulder", "hip"), ("hip", "knee")),
            *(("knee", "ankle"), ("ankle", "big_toe"), ("ankle", "heel")),
        )
    ),
]


def write_session(folder: Path, out: Path, trial: str = "balancing") -> Path:
    """Unpack the trial's keypoints into `out` and write its session file."""
    inside, people = TRIALS[trial]
    with tarfile.open(folder / "pose_json.tar.xz") as archive:
        for member in archive:
            if member.name.startswith(inside + "/") and member.name.endswith(".json"):
                archive.extract(member, out, filter="data")
    lines = [
        "[session]",
        f'name = "{trial}"',
        f"rate_hz = {RATE_HZ}",
        f"calibration = '{(folder / 'Calib.qca.txt').resolve()}'",
        'up = "z"',
        f"max_subjects = {people}",
    ]
    for number in ("01", "02", "03", "04"):
        lines += ["", "[[camera]]", f'name = "cam_{number}"', 'format = "openpose-body25b"']
        lines += [f'keypoints = "{inside}/pose/cam{number}_json"']
    path = out / "session.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def draw_views(data: SessionData, take: Take, frames: list[int], path: Path) -> None:
    """Keypoints (black) and solved landmarks (a colour per person, left thick), in pixels."""
    assert data.landmarks is not None
    index = data.landmarks.landmark_names.index
    cameras = [data.rig[name] for name in DRAWN_CAMERAS]
    points = solved_landmarks(data, take)
    figure = Figure(figsize=(4.2 * len(frames), 14), layout="constrained")
    axes = figure.subplots(len(cameras), len(frames), squeeze=False)
    for row, camera in zip(axes, cameras, strict=True):
        for ax, frame in zip(row, frames, strict=True):
            for person in data.detections(frame).people[data.rig.names.index(camera.name)]:
                ax.scatter(person[:, 0], person[:, 1], s=9, color="black", zorder=3)
            for subject in np.flatnonzero(take.tracked[:, frame]):
                pixels = camera.project(points[subject, frame])
                for a, b in LINKS:
                    ends = pixels[[index(a), index(b)]]
                    width = 2.4 if a.startswith("left") else 1.2
                    ax.plot(ends[:, 0], ends[:, 1], color=f"C{subject}", linewidth=width)
            ax.set_title(f"{camera.name}, {take.time_s[frame]:.2f} s", size=9)
            ax.set_aspect("equal")
            ax.set_xlim(0, camera.size_px[0])
            ax.set_ylim(camera.size_px[1], 0)
    figure.savefig(path, dpi=70)


def solved_landmarks(data: SessionData, take: Take) -> np.ndarray:
    """Where the take puts the detector's landmarks (S, T, K, 3) [m]."""
    assert data.landmarks is not None
    return np.stack(
        [
            landmarks_in_world(
                take.bone_position_in_world_m[subject],
                take.bone_rotation_in_world(subject),
                data.landmarks.bones(take.skeleton),
                data.landmarks.offsets_m(take.shape(subject)),
            )
            for subject in range(len(take.subject_names))
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Solve a Pose2Sim clip.")
    parser.add_argument("folder", type=Path, metavar="DATA_FOLDER")
    parser.add_argument("--trial", choices=TRIALS, default="balancing")
    parser.add_argument("--out", type=Path, help="keep session, take and pictures here")
    arguments = parser.parse_args()
    out = arguments.out or Path(tempfile.mkdtemp(prefix="pose2sim-"))
    data = open_session(load_session(write_session(arguments.folder, out, arguments.trial)))
    solved = solve_session(data)
    save_take(solved.take, out / "take.npz")
    print("reprojection [px]  median    90 %  keypoints")
    for camera, error in solved.report.reprojection_px.items():
        print(f"{camera:<16} {error['median']:8.1f} {error['p90']:7.1f} {error['keypoints']:10.0f}")
    for name, subject in solved.report.subjects.items():
        print(
            f"{name}: tracked {100 * subject['tracked_share']:.0f} %, "
            f"height {subject['height_m']:.2f} m"
        )
    last = len(solved.take.timestamps_ns) - 1
    frames = [last * i // 3 for i in range(4)]
    plot_take(solved.take, frames, out / "stick_figures.png")
    draw_views(data, solved.take, frames, out / "views.png")
    print(f"written to {out}")


if __name__ == "__main__":
    main()
