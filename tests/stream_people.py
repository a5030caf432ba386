"""Poses for the tests of streams, 2 m tall: 100 units of stature are 2 m, so joints are round."""

from __future__ import annotations

import numpy as np

from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.streams.person_pose import PersonPose, StreamFrame, pose_of_take
from motions import person, take_of


def theta_of(skeleton: Skeleton = PAPER21, root_m=(0.0, 0.0, 0.0), **angle_axis_deg) -> np.ndarray:
    """Standing at `root_m` on the floor, with the named bones turned."""
    theta = np.zeros(skeleton.pose_size)
    theta[:3] = np.add(root_m, [0, person(2.0).standing_root_height_m, 0])
    for bone, degrees in angle_axis_deg.items():
        at = 3 + 3 * skeleton.bone(bone)
        theta[at : at + 3] = np.radians(degrees)
    return theta


def pose_of(theta: np.ndarray, skeleton: Skeleton = PAPER21, name: str = "anna") -> PersonPose:
    take = take_of(theta[None, None], [person(2.0, skeleton)], names=(name,))
    pose = pose_of_take(take, 0, 0)
    assert pose is not None
    return pose


def frame_of(*poses: PersonPose, time_s: float = 1.5) -> StreamFrame:
    return StreamFrame(
        time_s=time_s, timestamp_ns=1_500_000_000, people={pose.name: pose for pose in poses}
    )


LEFT_ARM_RAISED = theta_of(left_upper_arm=(0, 0, 90))
ONE_STEP_FORWARD = theta_of(root_m=(0, 0, 0.5))
TURNED_LEFT = theta_of(hips=(0, 90, 0))
