"""What a human body can measure: limbs whose length does not depend on the pose.

Lengths come from the reference proportions of `BodyShape` for people of 1.0 m to 2.2 m, widened by
40 % because a detector's joints scatter by some centimetres and trunks bend. A thigh may so measure
0.15 m to 0.75 m, an upper arm 0.11 m to 0.57 m, and a trunk from shoulder to hip 0.18 m to 0.90 m:
wide enough for everybody, narrow enough to refuse most skeletons that the rays of two different
people make.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21

_SHORTEST_M, _TALLEST_M, _TOLERANCE = 1.0, 2.2, 0.4

_RIGID_PAIRS = (
    ("left_shoulder", "right_shoulder"),
    ("left_hip", "right_hip"),
    ("neck", "mid_hip"),
    *(
        (f"{side}_{upper}", f"{side}_{lower}")
        for side in ("left", "right")
        for upper, lower in (
            ("shoulder", "elbow"),
            ("elbow", "wrist"),
            ("hip", "knee"),
            ("knee", "ankle"),
            ("shoulder", "hip"),
        )
    ),
)
_TORSO = ("left_shoulder", "right_shoulder", "left_hip", "right_hip", "neck", "mid_hip", "chest")

MIN_LIMBS = 4
"""Limbs that must be measured before a body is judged; a trunk with one arm or leg has as many."""


class Anatomy:
    """Limb lengths and the torso for one detector's landmarks."""

    def __init__(self, landmark_set: LandmarkSet) -> None:
        names = landmark_set.landmark_names
        self._limbs = np.array(
            [(names.index(a), names.index(b)) for a, b in _RIGID_PAIRS if a in names and b in names]
        )
        self._torso = np.array([names.index(name) for name in _TORSO if name in names])
        self._landmark_set = landmark_set

    @cached_property
    def _fractions(self) -> np.ndarray:
        shape = BodyShape.from_height(PAPER21, 1.0)
        position, rotation = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
        bones = self._landmark_set.bones(PAPER21)
        offsets = self._landmark_set.offsets_m(shape)
        return self.limb_lengths(landmarks_in_world(position, rotation, bones, offsets)[0])

    @property
    def limb_count(self) -> int:
        """Number of limbs that `limb_lengths` measures."""
        return len(self._limbs)

    def limb_lengths(self, landmarks: Float[np.ndarray, "*t k 3"]) -> Float[np.ndarray, "*t m"]:
        """Lengths [m]; NaN where an end is."""
        ends = landmarks[..., self._limbs, :]
        limb = ends[..., 0, :] - ends[..., 1, :]
        return np.sqrt(np.einsum("...i,...i->...", limb, limb))

    def possible(self, landmarks: Float[np.ndarray, "h k 3"]) -> np.ndarray:
        """Which skeletons (h,) have enough limbs, at least three quarters of them of human size."""
        lengths = self.limb_lengths(landmarks)
        low = self._fractions * _SHORTEST_M * (1 - _TOLERANCE)
        high = self._fractions * _TALLEST_M * (1 + _TOLERANCE)
        measured = np.isfinite(lengths).sum(axis=-1)
        human = ((lengths >= low) & (lengths <= high)).sum(axis=-1)
        return (measured >= MIN_LIMBS) & (human >= 0.75 * measured)

    def moved_m(
        self, before: Float[np.ndarray, "t k 3"], after: Float[np.ndarray, "t k 3"]
    ) -> Float[np.ndarray, " t"]:
        """How far the middles of common torso landmarks are apart; 0 without any."""
        step = after[:, self._torso] - before[:, self._torso]
        known = np.isfinite(step[:, :, :1])
        mean = np.where(known, step, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
        return np.sqrt(np.einsum("ti,ti->t", mean, mean))

    def centre(self, landmarks: Float[np.ndarray, "*t k 3"]) -> Float[np.ndarray, "*t 3"]:
        """Middle of the torso [m], of all landmarks where it was not seen; NaN without any."""
        torso = _middle(landmarks[..., self._torso, :])
        known = np.isfinite(torso)
        return torso if known.all() else np.where(known, torso, _middle(landmarks))


def _middle(points: Float[np.ndarray, "*t k 3"]) -> Float[np.ndarray, "*t 3"]:
    known = np.isfinite(points[..., :1])
    count = known.sum(axis=-2)
    return np.where(known, points, 0.0).sum(axis=-2) / np.where(count > 0, count, np.nan)


def size_misfit(a: np.ndarray, b: np.ndarray) -> float:
    """Mean relative difference of two bodies' limb lengths; 0 where too few are known."""
    relative = np.abs(a - b) / (0.5 * (a + b))
    relative = relative[np.isfinite(relative)]
    return float(relative.mean()) if len(relative) >= MIN_LIMBS else 0.0
