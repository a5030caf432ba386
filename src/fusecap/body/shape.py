"""Body shape: where each joint sits in its parent's frame.

Three ways to one: measured bone lengths, a stature scaled by published proportions, or (in
`fusecap.solve.body_measure`) estimated from the take itself.

The proportions are fractions of stature. Limb segments follow Drillis and Contini (1966) as
reprinted by Winter, "Biomechanics and Motor Control of Human Movement", fig. 4.1: upper arm
0.186, forearm 0.146, hip height 0.530, knee height 0.285, ankle height 0.039, shoulder height
0.818, foot length 0.152. Joint-centre distances that the figure gives only as body breadths are
narrower inside the body: hip centres 0.100 apart (Bell et al. 1990: about 0.36 of the distance
between the ASIS to either side of the midline), shoulder centres 0.195 apart (biacromial breadth
0.23 less the acromion's overhang). The spine is cut into four equal parts between hips and neck.

A 1.75 m person: thigh 0.429 m, shank 0.431 m, upper arm 0.326 m, forearm 0.256 m.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.body.skeleton import EXTENDED23, Skeleton
from fusecap.errors import InputError, nearest

REFERENCE_HEIGHT_M = 1.75
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.6, 2.6
MAX_OFFSET_M = 10.0
"""Between neighbouring joints, and of a stature."""

_HIP_HEIGHT = 0.530
_KNEE_HEIGHT = 0.285
_ANKLE_HEIGHT = 0.039
_SHOULDER_HEIGHT = 0.818
_NECK_HEIGHT = 0.835
_HEAD_HEIGHT = 0.890
_HALF_HIPS = 0.050
_HALF_SHOULDERS = 0.0975
_CLAVICLE = 0.015
_UPPER_ARM = 0.186
_FOREARM = 0.146
_TOE_BASE_FORWARD = 0.080
_TOE_BASE_HEIGHT = 0.012

_PELVIS_HEIGHT = _HIP_HEIGHT + 0.020
"""The hips frame sits above the line between the hip centres, as optical skeletons place it."""


def _reference_fractions(skeleton: Skeleton) -> dict[str, tuple[float, float, float]]:
    spine = (_NECK_HEIGHT - _PELVIS_HEIGHT) / 5
    spine3_height = _PELVIS_HEIGHT + 4 * spine
    offsets = {
        "hips": (0.0, 0.0, 0.0),
        "spine": (0.0, spine, 0.0),
        "spine1": (0.0, spine, 0.0),
        "spine2": (0.0, spine, 0.0),
        "spine3": (0.0, spine, 0.0),
        "neck": (0.0, spine, 0.0),
        "head": (0.0, _HEAD_HEIGHT - _NECK_HEIGHT, 0.010),
    }
    for side, sign in (("left", 1.0), ("right", -1.0)):
        rise = _SHOULDER_HEIGHT - spine3_height
        if f"{side}_clavicle" in skeleton.bone_names:
            offsets[f"{side}_clavicle"] = (sign * _CLAVICLE, rise, 0.0)
            offsets[f"{side}_upper_arm"] = (sign * (_HALF_SHOULDERS - _CLAVICLE), 0.0, 0.0)
        else:
            offsets[f"{side}_upper_arm"] = (sign * _HALF_SHOULDERS, rise, 0.0)
        offsets[f"{side}_forearm"] = (sign * _UPPER_ARM, 0.0, 0.0)
        offsets[f"{side}_hand"] = (sign * _FOREARM, 0.0, 0.0)
        offsets[f"{side}_thigh"] = (sign * _HALF_HIPS, _HIP_HEIGHT - _PELVIS_HEIGHT, 0.0)
        offsets[f"{side}_shank"] = (0.0, _KNEE_HEIGHT - _HIP_HEIGHT, 0.0)
        offsets[f"{side}_foot"] = (0.0, _ANKLE_HEIGHT - _KNEE_HEIGHT, 0.0)
        offsets[f"{side}_toes"] = (0.0, _TOE_BASE_HEIGHT - _ANKLE_HEIGHT, _TOE_BASE_FORWARD)
    return offsets


@dataclass(frozen=True, kw_only=True)
class BodyShape:
    """Joint positions in the parents' frames, and the landmark scale that goes with them."""

    skeleton: Skeleton
    offsets_m: Float[np.ndarray, "b 3"]
    height_m: float
    """Stature; landmarks and end sites on the surface scale with it."""

    def __post_init__(self) -> None:
        if self.offsets_m.shape != (self.skeleton.bone_count, 3):
            raise InputError(
                f"body shape: {self.offsets_m.shape} offsets for {self.skeleton.bone_count} bones"
            )
        if not (np.abs(self.offsets_m) <= MAX_OFFSET_M).all():
            raise InputError(f"body shape: an offset is not a number of at most {MAX_OFFSET_M} m")
        if not 0.0 < self.height_m <= MAX_OFFSET_M:
            raise InputError(f"body shape: the stature is {self.height_m} m")

    @classmethod
    def from_height(cls, skeleton: Skeleton, height_m: float) -> BodyShape:
        """The reference proportions scaled to `height_m`; raises `InputError` outside 0.6-2.6 m."""
        if not MIN_HEIGHT_M <= height_m <= MAX_HEIGHT_M:
            raise InputError(
                f"height {height_m:g} m is outside {MIN_HEIGHT_M}-{MAX_HEIGHT_M} m; "
                "heights are in metres"
            )
        fractions = _reference_fractions(skeleton)
        offsets = np.array([fractions[name] for name in skeleton.bone_names]) * height_m
        return cls(skeleton=skeleton, offsets_m=offsets, height_m=float(height_m))

    def with_lengths(self, lengths_m: Mapping[str, float]) -> BodyShape:
        """This shape with the offsets to the named bones scaled to the given lengths [m].

        A length is the distance from the parent's joint to the named bone's joint, so the thigh's
        own length is the one named `left_shank`. Directions stay those of the rest pose.
        """
        offsets = self.offsets_m.copy()
        for name, length_m in lengths_m.items():
            if name not in self.skeleton.bone_names[1:]:
                raise InputError(
                    f"bone length for '{name}': no such bone"
                    f"{nearest(name, self.skeleton.bone_names[1:])}"
                )
            if not (np.isfinite(length_m) and 0.005 <= length_m <= 1.2):
                raise InputError(
                    f"bone length of '{name}' is {length_m:g} m; expected 0.005-1.2 (metres)"
                )
            bone = self.skeleton.bone(name)
            offsets[bone] *= length_m / np.linalg.norm(offsets[bone])
        return BodyShape(skeleton=self.skeleton, offsets_m=offsets, height_m=self.height_m)

    @property
    def standing_root_height_m(self) -> float:
        """Height of the root joint over the soles in the rest pose."""
        position = np.zeros_like(self.offsets_m)
        for bone, parent in enumerate(self.skeleton.parents):
            if parent >= 0:
                position[bone] = position[parent] + self.offsets_m[bone]
        return float(-position[:, 1].min() + _TOE_BASE_HEIGHT * self.height_m)


def end_offsets_m(shape: BodyShape) -> dict[str, np.ndarray]:
    """Where the leaf bones end, in their own frames [m]: for drawing and for BVH end sites."""
    h = shape.height_m
    ends = {"head": np.array([0.0, 1.0 - _HEAD_HEIGHT, 0.0]) * h}
    for side, sign in (("left", 1.0), ("right", -1.0)):
        ends[f"{side}_hand"] = np.array([sign * 0.108, 0.0, 0.0]) * h
        ends[f"{side}_toes"] = np.array([0.0, 0.0, 0.045]) * h
    return ends


def bones_of_extended(skeleton: Skeleton) -> list[int]:
    """For each bone of `EXTENDED23` the one of `skeleton` that turns as it does."""
    known = skeleton.bone_names
    return [skeleton.bone(name if name in known else "spine3") for name in EXTENDED23.bone_names]


def shape_with_clavicles(shape: BodyShape) -> BodyShape:
    """The same body on `EXTENDED23`: no joint moves, the clavicles turn with the upper spine."""
    skeleton = shape.skeleton
    if "left_clavicle" in skeleton.bone_names:
        return shape
    offsets_m = shape.offsets_m[bones_of_extended(skeleton)]
    for side in ("left", "right"):
        clavicle, arm = EXTENDED23.bone(f"{side}_clavicle"), EXTENDED23.bone(f"{side}_upper_arm")
        offsets_m[clavicle] = offsets_m[arm] * [_CLAVICLE / _HALF_SHOULDERS, 1, 1]
        offsets_m[arm] -= offsets_m[clavicle]
    return BodyShape(skeleton=EXTENDED23, offsets_m=offsets_m, height_m=shape.height_m)
