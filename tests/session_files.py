"""Writes small sessions with known content for the tests of readers."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.geometry.camera import Camera, Rig


def camera_at(
    name: str, position_in_world_m: Sequence[float], target_m: Sequence[float] = (0.0, 1.0, 0.0)
) -> Camera:
    """A 1280 x 720 camera in a y-up world that looks at a point."""
    position = np.array(position_in_world_m)
    forward = np.array(target_m) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Camera(
        name=name,
        size_px=(1280, 720),
        matrix=np.array([[700.0, 0, 640], [0, 700.0, 360], [0, 0, 1]]),
        distortion=np.zeros(5),
        rotation=rotation,
        translation=-rotation @ position,
    )


def ring(count: int = 4) -> Rig:
    """Cameras around the origin, 4 m away and 2 m up, called cam0, cam1, ..."""
    angles = 2 * np.pi * np.arange(count) / count + 0.3
    return Rig(
        cameras=tuple(
            camera_at(f"cam{i}", [4 * np.sin(a), 2.0, 4 * np.cos(a)]) for i, a in enumerate(angles)
        )
    )


def calibration_toml(rig: Rig, *, unit_per_metre: float = 1.0, extra: str = "") -> str:
    """The rig in the aniposelib layout."""
    tables = []
    for camera in rig.cameras:
        rotation = Rotation.from_matrix(camera.rotation).as_rotvec()
        tables.append(
            f"[{camera.name}]\n"
            f"size = [{camera.size_px[0]}, {camera.size_px[1]}]\n"
            f"matrix = {camera.matrix.tolist()}\n"
            f"distortions = {camera.distortion.tolist()}\n"
            f"rotation = {rotation.tolist()}\n"
            f"translation = {(camera.translation * unit_per_metre).tolist()}\n{extra}"
        )
    return "\n".join(tables)


def walking_landmarks(landmarks: LandmarkSet, times_s: np.ndarray) -> np.ndarray:
    """(T, K, 3) a person in the rest pose who drifts through the room and turns."""
    shape = BodyShape.from_height(PAPER21, 1.75)
    theta = np.zeros((len(times_s), PAPER21.pose_size))
    theta[:, 0] = 0.8 * np.sin(1.3 * times_s)
    theta[:, 1] = shape.standing_root_height_m
    theta[:, 2] = 0.6 * np.cos(0.9 * times_s)
    theta[:, 4] = 0.4 * times_s
    position, rotation = forward_kinematics(shape, theta)
    return landmarks_in_world(
        position, rotation, landmarks.bones(PAPER21), landmarks.offsets_m(shape)
    )


def write_keypoints(folder: Path, people_per_frame: Sequence[np.ndarray], first: int = 0) -> None:
    """OpenPose JSON; NaN is written as 0, 0, 0."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame, people in enumerate(people_per_frame, start=first):
        entries = [
            {"pose_keypoints_2d": np.nan_to_num(person).ravel().tolist()} for person in people
        ]
        path = folder / f"{folder.name}_{frame:012d}_keypoints.json"
        path.write_text(json.dumps({"version": 1.3, "people": entries}))


def write_session(folder: Path, *, frames: int = 60, cameras: int = 4) -> Path:
    """A sound session at 30 Hz: one person, a ring of cameras, keypoints without noise."""
    rig = ring(cameras)
    landmarks = landmark_set_named("body25")
    points = walking_landmarks(landmarks, np.arange(frames) / 30.0)
    for camera in rig.cameras:
        pixels = [camera.project(point) for point in points]
        write_keypoints(
            folder / "keypoints" / camera.name,
            [np.concatenate([p, np.full((len(p), 1), 0.9)], axis=1)[None] for p in pixels],
        )
    (folder / "calibration.toml").write_text(calibration_toml(rig))
    text = '[session]\nname = "test"\nrate_hz = 30\ncalibration = "calibration.toml"\n'
    for camera in rig.cameras:
        text += f'\n[[camera]]\nname = "{camera.name}"\nkeypoints = "keypoints/{camera.name}"\n'
    (folder / "session.toml").write_text(text)
    return folder / "session.toml"


def imu_csv(
    times_s: np.ndarray, orientation_wxyz: np.ndarray, accel_m_s2: np.ndarray | None = None
) -> str:
    """Our CSV."""
    if accel_m_s2 is None:
        up = np.tile([0.0, 0.0, 9.80665], (len(times_s), 1))
        accel_m_s2 = Rotation.from_quat(orientation_wxyz[:, [1, 2, 3, 0]]).inv().apply(up)
    rows = np.column_stack([times_s, orientation_wxyz, accel_m_s2])
    lines = ["time_s,qw,qx,qy,qz,ax,ay,az"]
    return "\n".join(lines + [",".join(f"{v:.9g}" for v in row) for row in rows]) + "\n"


def edit(path: Path, old: str, new: str) -> None:
    """Replaces the first occurrence in a file, which must exist."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
