"""Angles of all joints of a take, each with one standard deviation.

The error of a joint's rotation is taken as that of two bones with independent errors, the same
about every axis: `bone_sigma_deg` is a root mean square over three axes, so about one axis

    sigma² = (sigma_above² + sigma_below²) / 3 + constant²

with `constants.CONSTANT_DEG` of the joint and axis. The middle angle b turns with this sigma. The
first and last turn about axes that b brings together, so theirs grow: sigma / |cos b| (Cardan),
sigma / |sin b| (globe), up to the 104 deg of an angle that may be anything. At the singular pose
itself only their sum or difference is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.angles.constants import CONSTANT_DEG
from fusecap.angles.joints import GLOBE, JOINTS, MIRROR, AnglesOfJoint, isb_axes
from fusecap.errors import TakeError, nearest
from fusecap.stored_take import StoredTake
from fusecap.take import BLOCK, Take

ANY_ANGLE_SD_DEG = 360.0 / np.sqrt(12.0)
"""Of an angle that may be anything, each as likely as the others."""
_SINGULAR = 0.1
"""Within 6 deg of the singular pose a curve is not followed: noise alone would wind it up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointAngles:
    """Angles of S subjects over T frames; NaN where a subject is not tracked."""

    time_s: Float[np.ndarray, " t"]
    subject_names: tuple[str, ...]
    names: tuple[str, ...]
    """Such as left_knee_flexion."""
    deg: Float[np.ndarray, "s t a"]
    sd_deg: Float[np.ndarray, "s t a"]

    def curve(
        self, subject: str, angle: str
    ) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
        """One angle and its standard deviation [deg]; raises `TakeError` for unknown names."""
        for name, known in ((subject, self.subject_names), (angle, self.names)):
            if name not in known:
                raise TakeError(f"no '{name}' among the angles{nearest(name, known)}")
        at = self.subject_names.index(subject), slice(None), self.names.index(angle)
        return self.deg[at], self.sd_deg[at]


def joint_angles(
    take: Take | StoredTake, *, constants: Mapping[str, tuple[float, float, float]] = CONSTANT_DEG
) -> JointAngles:
    """All angles of `JOINTS` whose bones the take has; docs/angles.md has their signs.

    `constants`: per joint, one standard deviation [deg] of what is wrong through a whole take.

    Every curve is continuous over the frames in which its subject is tracked and the joint is away
    from its singular pose, and lies within half a turn of 0 in the median. Raises `TakeError` where
    the skeleton has none of the bones.
    """
    joints = [
        (side, joint)
        for joint in JOINTS
        for side in (("left", "right") if joint.sided else ("",))
        if {_bone(side, joint.above), _bone(side, joint.below)} <= {*take.bone_names}
    ]
    if not joints:
        raise TakeError(f"skeleton '{take.skeleton.name}' has no two bones that make a known joint")
    people, frames = take.tracked.shape
    deg = np.full((people, frames, len(joints), 3), np.nan)
    # Of two hours of two people, in double precision these were 0.4 GB.
    sd_deg = np.full(deg.shape, np.nan, dtype=np.float32)
    slack = np.full(deg.shape[:3], np.nan, dtype=np.float32)
    for first in range(0, frames, BLOCK):
        block = take.of_frames(first, first + BLOCK)
        for subject, tracked in enumerate(block.tracked):
            at = first + np.flatnonzero(tracked)
            rotation = block.bone_rotation_in_world(subject)[tracked]
            sigma_deg = block.bone_sigma_deg[subject, tracked]
            for column, (side, joint) in enumerate(joints):
                bones = [take.bone_names.index(_bone(side, b)) for b in (joint.above, joint.below)]
                above, below = (rotation[:, bone] for bone in bones)
                relative = _below_in_above(joint, above, below, mirrored=side == "left")
                turns, apart = _turns(relative, joint.order)
                constant = np.square(constants.get(joint.name, (0.0, 0.0, 0.0)))
                sigma = np.sqrt(np.square(sigma_deg[:, bones]).sum(axis=1)[:, None] / 3 + constant)
                deg[subject, at, column] = np.degrees(turns) * joint.signs
                slack[subject, at, column] = apart
                each = np.stack([apart, np.ones_like(apart), apart], axis=1)
                sd_deg[subject, at, column] = np.minimum(
                    sigma / np.maximum(each, 1e-9), [ANY_ANGLE_SD_DEG, np.inf, ANY_ANGLE_SD_DEG]
                )
    for subject, tracked in enumerate(take.tracked):
        at = np.flatnonzero(tracked)
        for column in range(len(joints)):
            deg[subject, at, column] = _followed(
                deg[subject, at, column], at, slack[subject, at, column]
            )
    return JointAngles(
        time_s=take.time_s,
        subject_names=take.subject_names,
        names=tuple(
            _bone(side, f"{joint.name}_{angle}") for side, joint in joints for angle in joint.angles
        ),
        deg=deg.reshape(people, frames, 3 * len(joints)),
        sd_deg=sd_deg.reshape(people, frames, 3 * len(joints)),
    )


def _bone(side: str, name: str) -> str:
    return f"{side}_{name}" if side and name not in ("hips", "spine3") else name


def _below_in_above(
    joint: AnglesOfJoint,
    above: Float[np.ndarray, "t 3 3"],
    below: Float[np.ndarray, "t 3 3"],
    *,
    mirrored: bool,
) -> Float[np.ndarray, "t 3 3"]:
    """The axes of the bone below in those of the bone above, as of a right joint."""
    seen = MIRROR if mirrored else 1.0
    first = (above * seen) @ isb_axes(joint.above)
    return first.transpose(0, 2, 1) @ (below * seen) @ isb_axes(joint.below)


def _turns(
    rotation: Float[np.ndarray, "t 3 3"], order: str
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, " t"]]:
    """Turns about moving axes [rad], and how far apart the first and last axis are, 0-1.

    The last angle goes with the first also where that is arbitrary, in the singular pose.
    """
    if order == GLOBE:
        # Elevation turns about -X: its turn lies between -180 deg and 0.
        sine = np.hypot(rotation[:, 0, 1], rotation[:, 2, 1])
        first = np.arctan2(-rotation[:, 0, 1], -rotation[:, 2, 1])
        middle = -np.arctan2(sine, rotation[:, 1, 1])
        slack, other, sign = sine, rotation[:, 2], -1.0
    else:
        cosine = np.hypot(rotation[:, 0, 1], rotation[:, 1, 1])
        first = np.arctan2(-rotation[:, 0, 1], rotation[:, 1, 1])
        middle = np.arctan2(rotation[:, 2, 1], cosine)
        slack, other, sign = cosine, rotation[:, 1], 1.0
    first = np.where(slack < 1e-9, 0.0, first)
    row = np.cos(first)[:, None] * rotation[:, 0] + sign * np.sin(first)[:, None] * other
    return np.stack([first, middle, np.arctan2(row[:, 2], row[:, 0])], axis=1), slack


def _followed(
    deg: Float[np.ndarray, "n 3"], frames: Int[np.ndarray, " n"], slack: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Without jumps of full turns where frames follow one another away from the singular pose."""
    followed = deg.copy()
    singular = slack < _SINGULAR
    breaks = (np.diff(frames) > 1) | singular[1:] | singular[:-1]
    for piece in np.split(np.arange(len(deg)), np.flatnonzero(breaks) + 1):
        if len(piece):
            curve = np.unwrap(deg[piece], period=360.0, axis=0)
            followed[piece] = curve - 360.0 * np.round(np.median(curve, axis=0) / 360.0)
    return followed
