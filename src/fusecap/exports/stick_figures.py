"""People as line segments: what every picture of a solved person draws.

Sticks go from a bone's joint to those of its children, and from a leaf's joint to its end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fusecap.body.shape import BodyShape, end_offsets_m
from fusecap.body.skeleton import Skeleton
from fusecap.exports.take_format import AnyTake
from fusecap.geometry.quaternions import from_wxyz

MEASURED_QUALITY = 0.25
"""Of a bone (`fusecap.types.quality_of`): at less, 26 deg, its pose is hardly more than the prior's
guess."""
PASSING_SHARE = 0.2
"""Of the frames of whoever is followed longest; people of fewer are passers-by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Sticks:
    """One person at one instant, in the world."""

    start_m: Float[np.ndarray, "n 3"]
    end_m: Float[np.ndarray, "n 3"]
    left: Bool[np.ndarray, " n"]
    right: Bool[np.ndarray, " n"]
    measured: Bool[np.ndarray, " n"]
    """Whether something tells how the bone lies."""


class StickFigure:
    """What makes sticks of a skeleton's poses."""

    def __init__(self, skeleton: Skeleton) -> None:
        bones = range(skeleton.bone_count)
        self._children = [bone for bone in bones if skeleton.parents[bone] >= 0]
        self._leaves = [bone for bone in bones if not skeleton.children(bone)]
        self._leaf_names = [skeleton.bone_names[leaf] for leaf in self._leaves]
        self._bones = [skeleton.parents[bone] for bone in self._children] + self._leaves
        names = [skeleton.bone_names[bone] for bone in (*self._children, *self._leaves)]
        self._left, self._right = (
            np.array([name.startswith(side) for name in names]) for side in ("left_", "right_")
        )

    def sticks(
        self,
        shape: BodyShape,
        position_m: Float[np.ndarray, "b 3"],
        rotation: Float[np.ndarray, "b 3 3"],
        quality: Float[np.ndarray, " b"],
    ) -> Sticks:
        """Of joints, rotations in the world and quality of all bones."""
        ends = end_offsets_m(shape)
        offsets_m = np.array([ends[name] for name in self._leaf_names])
        tips = np.einsum("lij,lj->li", rotation[self._leaves], offsets_m) + position_m[self._leaves]
        return Sticks(
            start_m=position_m[self._bones],
            end_m=np.concatenate([position_m[self._children], tips]),
            left=self._left,
            right=self._right,
            measured=quality[self._bones] >= MEASURED_QUALITY,
        )


class TakeSticks:
    """The people of a take."""

    def __init__(self, take: AnyTake) -> None:
        self.take = take
        self._figure = StickFigure(take.skeleton)
        self._shapes = [take.shape(row) for row in range(len(take.subject_names))]

    def at_frame(self, subject: int, frame: int) -> Sticks | None:
        """None where the person is not tracked."""
        if not self.take.tracked[subject, frame]:
            return None
        one = self.take.of_frames(frame, frame + 1)
        return self._figure.sticks(
            self._shapes[subject],
            one.bone_position_in_world_m[subject, 0],
            from_wxyz(one.bone_rotation_in_world_wxyz[subject, 0]).as_matrix(),
            one.bone_quality[subject, 0],
        )

    def at_time(self, subject: int, time_ns: int) -> Sticks | None:
        """Between two frames in a straight line; None where no tracked frame is near."""
        times_ns = self.take.timestamps_ns
        later = int(np.searchsorted(times_ns, time_ns))
        before = after = None
        period_ns = 1e9 / self.take.rate_hz
        if later < len(times_ns) and times_ns[later] - time_ns < period_ns:
            after = self.at_frame(subject, later)
        if later > 0 and time_ns - times_ns[later - 1] < period_ns:
            before = self.at_frame(subject, later - 1)
        if before is None or after is None:
            near = before or after
            held = later if before is None else later - 1
            is_near = near is not None and abs(times_ns[held] - time_ns) <= period_ns / 2
            return near if is_near else None
        share = (time_ns - times_ns[later - 1]) / (times_ns[later] - times_ns[later - 1])
        return Sticks(
            start_m=(1 - share) * before.start_m + share * after.start_m,
            end_m=(1 - share) * before.end_m + share * after.end_m,
            left=before.left,
            right=before.right,
            measured=before.measured & after.measured,
        )


def passing(tracked: Bool[np.ndarray, "s t"]) -> Bool[np.ndarray, " s"]:
    """Who passes by: followed in few frames beside those of whoever is followed longest."""
    frames = tracked.sum(axis=1)
    return frames < PASSING_SHARE * frames.max(initial=0)
