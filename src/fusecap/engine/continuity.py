"""What is sent: poses that never jump and never vanish at once.

A solve may jump: a person is found again elsewhere, a camera returns and knows the depth that one
view had guessed, sensors go. What is sent then goes on from where it was: the offset between the
old pose and the new one (of the root, of each bone to its parent, of the bone lengths) is added to
the solves and taken away along a curve that starts and ends at rest, "inertialization" [Bollo,
Game Developers Conference 2018]. It delays nothing: motion shows at once, only its offset is late.
Positions come from forward kinematics, so bones keep their lengths. Between jumps an estimate goes
out as it is, to the bit.

What counts as a jump is faster than people: sprinters reach 12.4 m/s (Graubner and Nixdorf 2011, of
the 100 m final of 2009), a hand that throws or a foot that kicks about twice that, and a bone that
turns about its joint at 40 rad/s moves a wrist or ankle 0.4 m away at 16 m/s. The noise of a solve
from two views or more, ten times its standard deviation, is on top. At 60 instants per second that
is 0.25 m of the root, 0.47 m of any joint, and 0.87 rad of a bone.

Whom nothing measures holds the last pose while its error bars grow.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape
from fusecap.solve.uncertainty import Sigmas, grown
from fusecap.types import Estimate

BLEND_S = 0.3
"""In which an offset goes: a third of a second of wrong pose is hardly seen, a jump is."""
BLEND_SPEED_M_S = 6.0
"""A root with farther to go takes longer: nobody is carried faster than people run."""
ROOT_SPEED_M_S, JOINT_SPEED_M_S, PLACE_NOISE_M = 12.0, 25.0, 0.05
BONE_SPEED_RAD_S, BONE_NOISE_RAD = 40.0, 0.2
SHAPE_STEP_M = 0.005
"""By which a joint may move in its parent's frame at once, while a body is measured."""
_STEEPEST = 1.875
"""Of the curve: its largest slope."""

Footing = tuple[int, bool]
"""What a pose rests on: no view, one, or two and more; and whether on sensors."""


def remaining(share: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """What is left of an offset after this share of its time: 1 - 10 s³ + 15 s⁴ - 6 s⁵."""
    s = np.clip(share, 0.0, 1.0)
    return 1.0 - s**3 * (10.0 + s * (6.0 * s - 15.0))


class Continuity:
    """One person's poses on their way out."""

    def __init__(self, hold_s: float) -> None:
        """Whom nothing measures for `hold_s` is no longer sent."""
        self.measured_ns: int | None = None
        """When something last measured the person."""
        self._hold_s = hold_s
        self._solved: _Pose | None = None
        """The last estimate as solved."""
        self._sent: _Pose | None = None
        self._sent_before: _Pose | None = None
        """None where `_sent` was put there and shows no motion."""
        self._estimate: Estimate | None = None
        """As last sent while measured."""
        self._footing: Footing = (0, False)
        self._held = False
        self._offset: _Offset | None = None

    def update(self, estimate: Estimate | None, footing: Footing, now_ns: int) -> Estimate | None:
        """What to send at an instant; `footing` (0, False) means that nothing measured."""
        if estimate is None or footing == (0, False) or not _is_finite(estimate):
            return self._hold(now_ns)
        pose, last = _Pose(estimate), self._sent
        sent, sent_pose, even = estimate, pose, True
        if last is not None:
            if self._is_news(pose, footing):
                even = False
                self._absorb(pose, pose.all_parts, self._goes_on(last, now_ns), now_ns)
            sent, sent_pose = self._with_offset(estimate, pose, now_ns)
            parts = _too_fast(sent_pose, last)
            if parts.any():
                even = False
                self._absorb(pose, parts, last, now_ns)
                sent, sent_pose = self._with_offset(estimate, pose, now_ns)
                if _too_fast(sent_pose, last).any():
                    self._absorb(pose, pose.all_parts, last, now_ns)
                    sent, sent_pose = self._with_offset(estimate, pose, now_ns)
        self._sent_before, self._sent = (last if even else None), sent_pose
        self._solved, self._footing, self._held = pose, footing, False
        self._estimate, self.measured_ns = sent, now_ns
        return sent

    def _hold(self, now_ns: int) -> Estimate | None:
        if self._estimate is None or self.measured_ns is None:
            return None
        silent_s = (now_ns - self.measured_ns) * 1e-9
        if silent_s > self._hold_s:
            self._estimate = self._solved = self._sent = self._sent_before = self._offset = None
            return None
        self._held = True
        known = Sigmas(self._estimate.bone_sigma_deg, self._estimate.position_sigma_m)
        sigmas = grown(known, silent_s)
        return replace(
            self._estimate,
            timestamp_ns=now_ns,
            bone_sigma_deg=sigmas.bone_deg,
            position_sigma_m=sigmas.position_m,
            views=np.zeros_like(self._estimate.views),
            measured=False,
            iterations=0,
            solve_s=0.0,
        )

    def _is_news(self, pose: _Pose, footing: Footing) -> bool:
        """Whether a pose may differ from the last one for other reasons than motion."""
        solved = self._solved
        return (
            self._held
            or footing != self._footing
            or solved is None
            or pose.track_id != solved.track_id
            or pose.grown_m(solved) > SHAPE_STEP_M
        )

    def _goes_on(self, last: _Pose, now_ns: int) -> _Pose:
        """The pose last sent, moved on as it was moving."""
        before = None if self._held else self._sent_before
        if before is None:
            return last
        ahead = (now_ns - last.timestamp_ns) / (last.timestamp_ns - before.timestamp_ns)
        turned = (before.turn.inv() * last.turn).as_rotvec()
        moved = copy(last)
        moved.root_m = last.root_m + ahead * (last.root_m - before.root_m)
        moved.turn = last.turn * Rotation.from_rotvec(ahead * turned)
        return moved

    def _absorb(self, pose: _Pose, parts: np.ndarray, target: _Pose, now_ns: int) -> None:
        """Make the offset of these parts what brings the pose to the target."""
        if self._offset is None:
            self._offset = _Offset(len(pose.turn))
        self._offset.put(
            parts,
            target.root_m - pose.root_m,
            (pose.turn.inv() * target.turn).as_rotvec(),
            target.shape.offsets_m - pose.shape.offsets_m,
            now_ns,
        )

    def _with_offset(self, estimate: Estimate, pose: _Pose, now_ns: int) -> tuple[Estimate, _Pose]:
        if self._offset is None:
            return estimate, pose
        left = self._offset.left(now_ns)
        if not left.any():
            self._offset = None
            return estimate, pose
        offset = self._offset
        turn = pose.turn * Rotation.from_rotvec(left[1:, None] * offset.turn_rad)
        theta = np.concatenate(
            [pose.root_m + left[0] * offset.root_m, turn.as_rotvec().reshape(-1)]
        )
        shape = pose.shape
        grown = offset.shape_left(now_ns)
        if grown > 0.0 and offset.shape_m.any():
            shape = replace(shape, offsets_m=shape.offsets_m + grown * offset.shape_m)
        position, rotation = forward_kinematics(shape, theta[None])
        sent = replace(
            estimate,
            theta=theta,
            bone_position_in_world_m=position[0],
            bone_rotation_in_world=rotation[0],
            shape=shape,
        )
        return sent, _Pose(sent)


class _Pose:
    """An estimate as its parts."""

    __slots__ = ("joints_m", "root_m", "shape", "timestamp_ns", "track_id", "turn")

    def __init__(self, estimate: Estimate) -> None:
        self.timestamp_ns = estimate.timestamp_ns
        self.track_id = estimate.track_id
        self.root_m = estimate.theta[:3]
        self.joints_m = estimate.bone_position_in_world_m
        self.turn = Rotation.from_rotvec(estimate.theta[3:].reshape(-1, 3))
        """Of each bone in its parent's frame (B)."""
        self.shape: BodyShape = estimate.shape

    @property
    def all_parts(self) -> np.ndarray:
        """(1 + B,) the root's position and the bones' rotations."""
        return np.ones(1 + len(self.turn), dtype=bool)

    def grown_m(self, last: _Pose) -> float:
        """How far a joint has moved in its parent's frame, at most."""
        if self.shape is last.shape:
            return 0.0
        return float(np.abs(self.shape.offsets_m - last.shape.offsets_m).max())


class _Offset:
    """What is sent less what is solved, when it arose and how long it takes to go."""

    __slots__ = ("_lasts_s", "_shape_since_ns", "_since_ns", "root_m", "shape_m", "turn_rad")

    def __init__(self, bones: int) -> None:
        self.root_m = np.zeros(3)
        self.turn_rad = np.zeros((bones, 3))
        """Angle-axis in each bone's own frame."""
        self.shape_m = np.zeros((bones, 3))
        self._since_ns = np.zeros(1 + bones, dtype=np.int64)
        self._lasts_s = np.full(1 + bones, 1e-9)
        self._shape_since_ns = 0

    def put(
        self,
        parts: np.ndarray,
        root_m: np.ndarray,
        turn_rad: np.ndarray,
        shape_m: np.ndarray,
        now_ns: int,
    ) -> None:
        """Begin anew for these parts, and for the bone lengths where all are."""
        self._since_ns[parts] = now_ns
        self._lasts_s[parts] = BLEND_S
        self.turn_rad[parts[1:]] = turn_rad[parts[1:]]
        if parts[0]:
            far_s = _STEEPEST * float(np.linalg.norm(root_m)) / BLEND_SPEED_M_S
            self.root_m, self._lasts_s[0] = root_m, max(BLEND_S, far_s)
        if parts.all():
            self.shape_m, self._shape_since_ns = shape_m, now_ns

    def left(self, now_ns: int) -> np.ndarray:
        """(1 + B,) shares of the root's and the bones' offsets."""
        return remaining((now_ns - self._since_ns) * 1e-9 / self._lasts_s)

    def shape_left(self, now_ns: int) -> float:
        """Share of the lengths' offset."""
        return float(remaining(np.array((now_ns - self._shape_since_ns) * 1e-9 / BLEND_S)))


def _too_fast(pose: _Pose, last: _Pose) -> np.ndarray:
    """(1 + B,) of the root's position and the bones' rotations, which nobody moves so fast."""
    dt_s = (pose.timestamp_ns - last.timestamp_ns) * 1e-9
    moved_m = np.linalg.norm(pose.joints_m - last.joints_m, axis=1)
    if (moved_m > JOINT_SPEED_M_S * dt_s + PLACE_NOISE_M).any():
        return pose.all_parts
    turned_rad = (last.turn.inv() * pose.turn).magnitude()
    return np.concatenate(
        [
            moved_m[:1] > ROOT_SPEED_M_S * dt_s + PLACE_NOISE_M,
            turned_rad > BONE_SPEED_RAD_S * dt_s + BONE_NOISE_RAD,
        ]
    )


def _is_finite(estimate: Estimate) -> bool:
    return bool(np.isfinite(estimate.theta).all())
