"""CMU Panoptic: many people in a dome of 480 VGA and 31 HD cameras.

    FOLDER/calibration_<sequence>.json                     centimetres, x_cam = R X + t, up is -y
    FOLDER/hdPose3d_stage1_coco19/body3DScene_<frame>.json {"bodies": [{"id", "joints19"}]}, cm
    FOLDER/keypoints/<camera>/*.json                       OpenPose BODY_25 of the cameras to use

`joints19` is x, y, z, confidence 19 times; a joint without confidence is unknown. HD frames come at
29.97 Hz. Cameras are those that have a folder of keypoints, named as in the calibration (00_00).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.errors import InputError
from fusecap.evaluate.datasets.recording import (
    DatasetSequence,
    LandmarkTruth,
    last_frame,
    read_views,
)
from fusecap.geometry.camera import Rig
from fusecap.inputs import DATASET, read_json
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.calibration_files.loader import Y_UP_FROM

RATE_HZ = 29.97
_NAMES = (
    "neck nose mid_hip left_shoulder left_elbow left_wrist left_hip left_knee left_ankle "
    "right_shoulder right_elbow right_wrist right_hip right_knee right_ankle "
    "left_eye left_ear right_eye right_ear"
)
COCO19 = LandmarkSet(name="coco19", landmark_names=tuple(_NAMES.split()))
"""In the order of `joints19`."""
_POSES = "hdPose3d_stage1_coco19"


def load_panoptic(folder: Path | str) -> DatasetSequence:
    """The sequence in a folder; raises `InputError`."""
    folder = Path(folder)
    root = folder / "keypoints"
    names = sorted(path.name for path in root.iterdir() if path.is_dir()) if root.is_dir() else []
    if not names:
        raise InputError(
            f"{root}: no folder of keypoints; expected one per camera, called as in the "
            "calibration (00_00), with OpenPose BODY_25 JSON of its frames"
        )
    rig = read_rig(folder).subset(names)
    landmarks = landmark_set_named("body25")
    views = read_views({name: root / name for name in names}, landmarks, RATE_HZ)
    truth = read_poses(folder)
    return DatasetSequence(
        name=folder.name,
        rate_hz=RATE_HZ,
        frames=last_frame(views),
        rig=rig,
        landmarks=landmarks,
        views=views,
        truth=truth,
    )


def read_rig(folder: Path) -> Rig:
    """All cameras of the calibration, in our world."""
    found = sorted(folder.glob("calibration_*.json"))
    if len(found) != 1:
        raise InputError(f"{folder}: {len(found)} calibration_*.json, expected one")
    return load_rig(found[0], up="-y")


def read_poses(folder: Path) -> LandmarkTruth:
    """Everyone's 19 joints in our world [m], by id and frame number."""
    files = {
        int(match[1]): path
        for path in sorted((folder / _POSES).glob("body3DScene_*.json"))
        if (match := re.search(r"_(\d+)\.json$", path.name))
    }
    if not files:
        raise InputError(
            f"{folder / _POSES}: no body3DScene_<frame>.json; expected the truth there"
        )
    people: dict[int, dict[int, np.ndarray]] = {}
    for frame, path in files.items():
        for who, joints in _bodies(path):
            people.setdefault(who, {})[frame] = joints
    points = np.full((len(people), 1 + max(files), len(COCO19.landmark_names), 3), np.nan)
    for row, who in enumerate(sorted(people)):
        for frame, joints in people[who].items():
            known = np.where(joints[:, 3:] > 0, joints[:, :3], np.nan) / 100.0
            points[row, frame] = known @ Y_UP_FROM["-y"].T
    return LandmarkTruth(landmarks=COCO19, points_in_world_m=points)


def _bodies(path: Path) -> list[tuple[int, np.ndarray]]:
    try:
        bodies = read_json(path, DATASET)["bodies"]
        found = [
            (int(body["id"]), np.array(body["joints19"], dtype=np.float64).reshape(19, 4))
            for body in bodies
        ]
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: not a Panoptic pose file, or cut short ({type(error).__name__}: {error}); "
            'expected {"bodies": [{"id": ..., "joints19": 76 numbers}]}'
        ) from None
    return found
