"""DIP-style pickles: calibrated IMU orientations and accelerations, and SMPL poses.

    imu_ori or ori    (T, N, 3, 3) or (T, 9 N)   bone rotations in the world, y up, from 17 sensors
    imu_acc or acc    (T, N, 3) or (T, 3 N)      acceleration in the world without gravity [m/s²]
    gt or poses       (T, 72)                    SMPL: angle-axis of 24 joints, local to the parent

DIP-IMU's files and those made from Total Capture look like this; 60 Hz. Pickles run code when read
the ordinary way; these are read by `fusecap.evaluate.datasets.safe_pickle`, which admits arrays
only. SMPL's rest pose is ours (a T-pose facing +z, y up, all rotations zero), so its rotations are
our bones' where both have one; of the spine only its two ends are compared. There are no positions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.evaluate.datasets.recording import BoneTruth, DatasetSequence
from fusecap.evaluate.datasets.safe_pickle import load_pickle
from fusecap.geometry.camera import Rig
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.pose_solver import ImuSites
from fusecap.types import ImuReading

RATE_HZ = 60.0
SENSORS = (
    "head",
    "spine3",
    "hips",
    "",
    "",
    "left_upper_arm",
    "right_upper_arm",
    "left_forearm",
    "right_forearm",
    "left_thigh",
    "right_thigh",
    "left_shank",
    "right_shank",
    "left_hand",
    "right_hand",
    "left_foot",
    "right_foot",
)
"""Our bone of each of the 17 sensors; the shoulder blades (3, 4) have none."""
SMPL_PARENTS = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8),
    *(9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21),
)
SMPL_BONES = {
    "hips": 0,
    "left_thigh": 1,
    "right_thigh": 2,
    "left_shank": 4,
    "right_shank": 5,
    "left_foot": 7,
    "right_foot": 8,
    "spine3": 9,
    "left_toes": 10,
    "right_toes": 11,
    "neck": 12,
    "head": 15,
    "left_upper_arm": 16,
    "right_upper_arm": 17,
    "left_forearm": 18,
    "right_forearm": 19,
    "left_hand": 20,
    "right_hand": 21,
}
"""Our bone and the SMPL joint that turns it."""


def load_dip(path: Path | str, *, height_m: float = REFERENCE_HEIGHT_M) -> DatasetSequence:
    """One sequence, without cameras; raises `InputError`."""
    path = Path(path)
    data = load_pickle(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: holds a {type(data).__name__}, expected a dict of arrays")
    rotation = _array(path, data, ("imu_ori", "ori"), (3, 3))
    accel = _array(path, data, ("imu_acc", "acc"), (3,))
    pose = _array(path, data, ("gt", "poses"), (3,))
    if rotation.shape[1] != len(SENSORS) or accel.shape[1] != len(SENSORS):
        raise InputError(
            f"{path}: orientations of {rotation.shape[1]} and accelerations of {accel.shape[1]} "
            f"sensors, expected {len(SENSORS)}"
        )
    if pose.shape[1] != len(SMPL_PARENTS):
        raise InputError(f"{path}: poses of {pose.shape[1]} joints, expected SMPL's 24")
    frames = min(len(rotation), len(accel), len(pose))
    counts = {len(rotation), len(accel), len(pose)}
    notes = (f"lengths differ ({sorted(counts)}); the shortest counts",) if len(counts) > 1 else ()
    worn = [index for index, bone in enumerate(SENSORS) if bone]
    sites = ImuSites(
        bone=tuple(PAPER21.bone(SENSORS[index]) for index in worn),
        position_m=np.zeros((len(worn), 3)),
    )
    name = path.stem
    return DatasetSequence(
        name=name,
        rate_hz=RATE_HZ,
        frames=frames,
        rig=Rig(cameras=()),
        landmarks=landmark_set_named("body25"),
        views=(),
        subjects=(
            SubjectModel(name=name, shape=BodyShape.from_height(PAPER21, height_m), sites=sites),
        ),
        imu={
            name: [
                ImuReading(bone_rotation_in_world=r, accel_in_world_m_s2=a)
                for r, a in zip(rotation[:frames, worn], accel[:frames, worn], strict=True)
            ]
        },
        truth=smpl_truth(pose[:frames]),
        notes=notes,
    )


def smpl_truth(pose_rad: np.ndarray) -> BoneTruth:
    """World rotations of our bones from SMPL angle-axis poses (T, 24, 3); no positions."""
    frames = len(pose_rad)
    local = Rotation.from_rotvec(pose_rad.reshape(-1, 3)).as_matrix().reshape(frames, -1, 3, 3)
    world = local.copy()
    for joint, parent in enumerate(SMPL_PARENTS[1:], start=1):
        world[:, joint] = world[:, parent] @ local[:, joint]
    return BoneTruth(
        names=tuple(SMPL_BONES),
        points_in_world_m=np.full((1, frames, len(SMPL_BONES), 3), np.nan),
        rotation_in_world=world[None, :, list(SMPL_BONES.values())],
    )


def _array(
    path: Path, data: dict[Any, Any], keys: tuple[str, ...], element: tuple[int, ...]
) -> np.ndarray:
    """(T, N, *element) of the first key that is there, whether flattened or not."""
    key = next((key for key in keys if key in data), None)
    if key is None:
        known = ", ".join(sorted(str(key) for key in data))
        raise InputError(f"{path}: no {' or '.join(keys)}; it holds {known or 'nothing'}")
    try:
        array = np.asarray(data[key], dtype=np.float64)
        return array.reshape(len(array), -1, *element)
    except (TypeError, ValueError):
        raise InputError(
            f"{path}: {key} cannot be read as frames x sensors x {' x '.join(map(str, element))}"
        ) from None
