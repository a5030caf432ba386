"""Lab Streaming Layer: the channels of one person, after XDF's meta-data for MoCap [1].

Eight channels per bone, in the world and in our axes: position [m], quaternion x y z w, and the
quality as confidence. The stream keeps its rate while a person is not tracked: all channels NaN.

[1] https://github.com/sccn/xdf/wiki/MoCap-Meta-Data
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from fusecap.body.skeleton import Skeleton
from fusecap.streams.person_pose import PersonPose

CONTENT_TYPE = "MoCap"
COORDINATES = "right-handed, y up, floor at y = 0; bones parallel to the world in the T-pose"

_OF_A_BONE = (
    ("PositionX", "PositionX", "meters"),
    ("PositionY", "PositionY", "meters"),
    ("PositionZ", "PositionZ", "meters"),
    ("OrientationX", "OrientationB", "quaternion"),
    ("OrientationY", "OrientationC", "quaternion"),
    ("OrientationZ", "OrientationD", "quaternion"),
    ("OrientationW", "OrientationA", "quaternion"),
    ("Confidence", "Confidence", "normalized"),
)
"""Label's end, XDF's type, unit; XDF calls a quaternion's real part A."""


@dataclass(frozen=True, kw_only=True)
class LslChannel:
    """What is known about one channel; the names are those of XDF."""

    label: str
    object: str
    type: str
    unit: str


def lsl_channels(skeleton: Skeleton) -> tuple[LslChannel, ...]:
    """In the order of a sample: bone by bone."""
    return tuple(
        LslChannel(label=f"{bone}_{end}", object=bone, type=kind, unit=unit)
        for bone in skeleton.bone_names
        for end, kind, unit in _OF_A_BONE
    )


def lsl_sample(pose: PersonPose | None, skeleton: Skeleton) -> Float32[np.ndarray, " c"]:
    """One instant; NaN throughout where the person is not tracked."""
    if pose is None:
        return np.full(len(_OF_A_BONE) * skeleton.bone_count, np.nan, dtype=np.float32)
    return np.concatenate(
        [
            pose.bone_position_in_world_m,
            pose.bone_rotation_in_world_xyzw,
            pose.bone_quality[:, None],
        ],
        axis=1,
        dtype=np.float32,
    ).reshape(-1)
