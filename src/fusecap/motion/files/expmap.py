"""CMU motion as rows of exponential maps: 117 comma-separated numbers, no header.

Root translation, then one exponential map [rad] per joint of the tree below, 120 rows a second.
The matrices act on row vectors, so a joint's rotation is exp(-v). Row 0 is a rest pose and is
dropped. The file has no bone lengths; the tree carries those of one adult of the database.

The root was converted with its angles in another order than every other joint: where the same take
exists as BVH, its rotation is Rz Ry Rx, and the exponential map is that of Rz Rx Ry with the same
three angles. They are taken out and put together again as BVH has them. Three angles have a second
reading, (z + 180, 180 - x, y + 180) degrees, which turns the other way: the take opens with the one
that has |y| <= 90 degrees and goes on with whichever continues its motion.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.motion.motion import (
    CMU_UNIT_M,
    Motion,
    chain_rotations,
    numbers,
)
from fusecap.motion.motion_format import MotionFormat

RATE_HZ = 120.0

_END = "(end)"
_TREE: tuple[tuple[str, int, tuple[float, float, float]], ...] = (
    ("Hips", -1, (0.0, 0.0, 0.0)),
    ("LHipJoint", 0, (1.62, -1.81, 0.67)),
    ("LeftUpLeg", 1, (2.50, -6.87, 0.0)),
    ("LeftLeg", 2, (2.60, -7.14, 0.0)),
    ("LeftFoot", 3, (0.20, -0.55, 2.10)),
    ("LeftToeBase", 4, (0.0, 0.0, 1.10)),
    (_END, 5, (0.0, 0.0, 0.0)),
    ("RHipJoint", 0, (-1.62, -1.81, 0.67)),
    ("RightUpLeg", 7, (-2.50, -6.87, 0.0)),
    ("RightLeg", 8, (-2.60, -7.14, 0.0)),
    ("RightFoot", 9, (-0.20, -0.55, 2.10)),
    ("RightToeBase", 10, (0.0, 0.0, 1.10)),
    (_END, 11, (0.0, 0.0, 0.0)),
    ("LowerBack", 0, (0.0, 2.03, -0.25)),
    ("Spine", 13, (0.0, 2.05, 0.0)),
    ("Spine1", 14, (0.0, 2.05, 0.0)),
    ("Neck", 15, (0.0, 1.70, 0.20)),
    ("Neck1", 16, (0.0, 1.70, -0.25)),
    ("Head", 17, (0.0, 1.75, -0.10)),
    (_END, 18, (0.0, 0.0, 0.0)),
    ("LeftShoulder", 15, (3.30, 1.00, -0.35)),
    ("LeftArm", 20, (5.15, 0.0, 0.0)),
    ("LeftForeArm", 21, (3.45, 0.0, 0.0)),
    ("LeftHand", 22, (0.0, 0.0, 0.0)),
    ("LeftFingerBase", 23, (0.70, 0.0, 0.0)),
    ("LeftHandIndex1", 24, (0.56, 0.0, 0.0)),
    (_END, 25, (0.0, 0.0, 0.0)),
    ("LThumb", 23, (0.57, 0.0, 0.57)),
    (_END, 27, (0.0, 0.0, 0.0)),
    ("RightShoulder", 15, (-3.30, 1.00, -0.35)),
    ("RightArm", 29, (-5.15, 0.0, 0.0)),
    ("RightForeArm", 30, (-3.45, 0.0, 0.0)),
    ("RightHand", 31, (0.0, 0.0, 0.0)),
    ("RightFingerBase", 32, (-0.70, 0.0, 0.0)),
    ("RightHandIndex1", 33, (-0.56, 0.0, 0.0)),
    (_END, 34, (0.0, 0.0, 0.0)),
    ("RThumb", 32, (-0.57, 0.0, 0.57)),
    (_END, 36, (0.0, 0.0, 0.0)),
)
_PARENTS = tuple(parent for _, parent, _ in _TREE)
_WIDTH = 3 + 3 * len(_TREE)


def parse_expmap(text: str, name: str) -> Motion:
    """A take of exponential maps; raises `InputError` naming the row that is broken."""
    rows = [line.split(",") for line in text.split("\n") if line.strip()]
    if len(rows) < 2:
        raise InputError(f"{name}: expected a rest pose and at least one row of motion")
    for number, row in enumerate(rows, start=1):
        if len(row) != _WIDTH:
            raise InputError(f"{name}: row {number} has {len(row)} numbers; expected {_WIDTH}")
    values = np.array([numbers(row, f"{name}, row {i}") for i, row in enumerate(rows[1:], start=2)])
    turns = -values[:, 3:].reshape(-1, 3)
    local = Rotation.from_rotvec(turns).as_matrix().reshape(len(values), len(_TREE), 3, 3)
    local[:, 0] = _root_as_in_bvh(local[:, 0])
    return Motion(
        name=name,
        joint_names=tuple(joint for joint, _, _ in _TREE),
        parents=_PARENTS,
        bone_vector_m=np.array([vector for _, _, vector in _TREE]) * CMU_UNIT_M,
        root_position_m=values[:, :3] * CMU_UNIT_M,
        rotation_in_world=chain_rotations(_PARENTS, local),
        rate_hz=RATE_HZ,
    )


def _root_as_in_bvh(rotation: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3 3"]:
    """Rz Ry Rx from Rz Rx Ry of the same angles."""
    z, x, y = Rotation.from_matrix(rotation).as_euler("ZXY").T
    readings = np.stack(
        [
            Rotation.from_euler("ZYX", np.stack(angles, axis=1)).as_quat()
            for angles in ((z, y, x), (z + np.pi, y + np.pi, np.pi - x))
        ],
        axis=1,
    )
    chosen = readings[:, 0].copy()
    if abs(y[0]) > np.pi / 2:
        chosen[0] = readings[0, 1]
    expected = chosen[0]
    for frame in range(1, len(chosen)):
        along = readings[frame] @ expected
        best = int(np.argmax(np.abs(along)))
        chosen[frame] = readings[frame, best] * (-1.0 if along[best] < 0 else 1.0)
        expected = 2 * chosen[frame] - chosen[frame - 1]
    return Rotation.from_quat(chosen).as_matrix()


FORMAT = MotionFormat(
    what="a .txt of exponential maps",
    suffix=".txt",
    parse=lambda text, path, _beside: parse_expmap(text, path),
    holds=lambda text: "," in text.partition("\n")[0],
)
