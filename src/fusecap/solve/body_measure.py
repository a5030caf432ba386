"""Bone lengths of a person nobody measured, from triangulated landmarks.

Each instant gives one sample of every limb length whose two ends were triangulated. The median over
instants forgets gross errors; left and right share one value, because people are symmetric to
within a centimetre and keypoints are not. Stature follows from the sum of the measured segments
against the reference proportions, and carries what no landmark measures.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import MAX_HEIGHT_M, MIN_HEIGHT_M, REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton

_SEGMENTS: dict[str, tuple[tuple[str, str], ...]] = {
    "upper_arm": (("left_shoulder", "left_elbow"), ("right_shoulder", "right_elbow")),
    "forearm": (("left_elbow", "left_wrist"), ("right_elbow", "right_wrist")),
    "thigh": (("left_hip", "left_knee"), ("right_hip", "right_knee")),
    "shank": (("left_knee", "left_ankle"), ("right_knee", "right_ankle")),
    "hips": (("left_hip", "right_hip"),),
    "shoulders": (("left_shoulder", "right_shoulder"),),
    "trunk": (("left_hip", "left_shoulder"), ("right_hip", "right_shoulder")),
}
_STATURE = ("upper_arm", "forearm", "thigh", "shank", "trunk")
_END_BONE = {"upper_arm": "forearm", "forearm": "hand", "thigh": "shank", "shank": "foot"}
_PLAUSIBLE = (0.8 * MIN_HEIGHT_M / REFERENCE_HEIGHT_M, 1.1 * MAX_HEIGHT_M / REFERENCE_HEIGHT_M)
"""A sample outside these multiples of the reference person's length is a triangulation error: it is
of nobody between the least and the greatest stature, with what limbs vary at one."""
MEASURE_SHARE = 25
"""Between two measurements as many instants as there were so far, over this."""
_SPINE = ("spine", "spine1", "spine2", "spine3", "neck")


@dataclass
class BodyMeasure:
    """Collects samples for one person; owned by that person's estimator."""

    skeleton: Skeleton
    landmarks: LandmarkSet
    max_samples: int = 600
    """Per segment; later ones replace the oldest."""
    min_samples: int = 5
    """Per segment before its median is used."""
    _samples: dict[str, list[float]] = field(default_factory=dict)
    _instants: int = 0
    _due: int = 0
    """The instant after which the body is measured again."""
    _shape: BodyShape | None = None

    def __post_init__(self) -> None:
        shape = BodyShape.from_height(self.skeleton, 1.75)
        position, rotation = forward_kinematics(shape, np.zeros((1, self.skeleton.pose_size)))
        bones = self.landmarks.bones(self.skeleton)
        rest = landmarks_in_world(position, rotation, bones, self.landmarks.offsets_m(shape))[0]
        joints = position[0, bones]
        self._pairs = {
            name: [
                (a, b)
                for near, far in pairs
                if (a := self.landmarks.index(near)) is not None
                and (b := self.landmarks.index(far)) is not None
            ]
            for name, pairs in _SEGMENTS.items()
        }
        self._reference = {
            name: _mean_length(rest, pairs) for name, pairs in self._pairs.items() if pairs
        }
        self._joints_per_landmarks = {
            name: _mean_length(joints, self._pairs[name]) / length
            for name, length in self._reference.items()
        }
        """Joint-to-joint over landmark-to-landmark length; 1 with landmarks on the joints."""

    def add(self, points_in_world_m: Float[np.ndarray, "k 3"]) -> None:
        """One instant's triangulated landmarks; NaN where missing."""
        self._instants += 1
        for name, reference in self._reference.items():
            kept = self._samples.setdefault(name, [])
            for a, b in self._pairs[name]:
                length = float(np.linalg.norm(points_in_world_m[a] - points_in_world_m[b]))
                if _PLAUSIBLE[0] * reference < length < _PLAUSIBLE[1] * reference:
                    kept.append(length)
            del kept[: -self.max_samples]

    def shape(self) -> BodyShape | None:
        """The body measured so far; None until some segment has enough samples.

        Measured anew after 4 % more instants: medians of hundreds of samples hardly move in one.
        """
        if self._shape is None or self._instants >= self._due:
            self._shape = self._measured()
            self._due = self._instants + 1 + min(self._instants, self.max_samples) // MEASURE_SHARE
        return self._shape

    def _measured(self) -> BodyShape | None:
        lengths = {
            name: float(np.median(kept))
            for name, kept in self._samples.items()
            if len(kept) >= self.min_samples
        }
        measured = [name for name in _STATURE if name in lengths]
        if not measured:
            return None
        scale = sum(lengths[n] for n in measured) / sum(self._reference[n] for n in measured)
        height_m = float(np.clip(1.75 * scale, MIN_HEIGHT_M, MAX_HEIGHT_M))
        between_joints = {name: x * self._joints_per_landmarks[name] for name, x in lengths.items()}
        return self._with(BodyShape.from_height(self.skeleton, height_m), between_joints)

    def _with(self, shape: BodyShape, lengths: dict[str, float]) -> BodyShape:
        offsets = shape.offsets_m.copy()
        bone = self.skeleton.bone
        for side in ("left", "right"):
            sign = 1.0 if side == "left" else -1.0
            for segment, end in _END_BONE.items():
                if segment in lengths:
                    index = bone(f"{side}_{end}")
                    offsets[index] *= lengths[segment] / np.linalg.norm(offsets[index])
            if "hips" in lengths:
                offsets[bone(f"{side}_thigh"), 0] = sign * lengths["hips"] / 2
            if "shoulders" in lengths:
                carried = 0.0
                if f"{side}_clavicle" in self.skeleton.bone_names:
                    carried = offsets[bone(f"{side}_clavicle"), 0]
                offsets[bone(f"{side}_upper_arm"), 0] = sign * lengths["shoulders"] / 2 - carried
        if "trunk" in lengths:
            spine = [bone(name) for name in _SPINE]
            rest = BodyShape(skeleton=self.skeleton, offsets_m=offsets, height_m=shape.height_m)
            position, _ = forward_kinematics(rest, np.zeros((1, self.skeleton.pose_size)))
            side = position[0, bone("left_upper_arm")] - position[0, bone("left_thigh")]
            # The diagonal hip-shoulder keeps its sideways part; the spine takes up the rest.
            wanted = np.sqrt(max(lengths["trunk"] ** 2 - side[0] ** 2, (0.5 * side[1]) ** 2))
            offsets[spine, 1] += (wanted - side[1]) / len(spine)
        return BodyShape(skeleton=self.skeleton, offsets_m=offsets, height_m=shape.height_m)


def _mean_length(points: Float[np.ndarray, "k 3"], pairs: list[tuple[int, int]]) -> float:
    return float(np.mean([np.linalg.norm(points[a] - points[b]) for a, b in pairs]))
