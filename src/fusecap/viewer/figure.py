"""A person as sticks and balls: where each lies, how big it is and what colour it has.

Sticks go from a bone's joint to those of its children, or to its end; balls sit on joints and ends.
The right side of a body is darker, and a nose shows where it looks, so that a mirrored pose is
seen; a bone fades towards grey as its quality falls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial.transform import Rotation

from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape, end_offsets_m
from fusecap.body.skeleton import Skeleton
from fusecap.body.sticks import (
    HEAD_CENTRE_M,
    HEAD_M,
    NOSE_M,
    NOSE_RADIUS_M,
    RIGHT_SHADE,
    stick_radius_m,
)
from fusecap.geometry.quaternions import to_wxyz
from fusecap.types import Estimate
from fusecap.viewer.palette import PALE_RGB, Rgb

_NAME_ABOVE_HEAD_M = 0.30
_QUALITY_STEPS = 16
"""Colours change by steps this fine, so that most frames send none."""
_LEAST_COLOUR = 0.3
"""Share of a person's own colour where quality is 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """One person at one instant, in the world."""

    shape: BodyShape
    position_m: Float[np.ndarray, "b 3"]
    rotation: Float[np.ndarray, "b 3 3"]
    quality: Float[np.ndarray, " b"]


def pose_of(estimate: Estimate) -> Pose:
    """A solved person."""
    return Pose(
        shape=estimate.shape,
        position_m=estimate.bone_position_in_world_m,
        rotation=estimate.bone_rotation_in_world,
        quality=estimate.bone_quality,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Parts:
    """Instances of one mesh in the world."""

    position_m: Float[np.ndarray, "n 3"]
    wxyz: Float[np.ndarray, "n 4"]
    scale_m: Float[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]

    @classmethod
    def hidden(cls, count: int) -> Parts:
        """Instances of no size."""
        return cls(
            position_m=np.zeros((count, 3)),
            wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            scale_m=np.zeros((count, 3)),
            rgb=np.zeros((count, 3), dtype=np.uint8),
        )


class Figure:
    """What draws a body of one skeleton."""

    def __init__(self, skeleton: Skeleton) -> None:
        names = skeleton.bone_names
        bones = range(skeleton.bone_count)
        self._head = skeleton.bone("head")
        self._leaves = [
            bone for bone in bones if bone != self._head and not skeleton.children(bone)
        ]
        self._children = [bone for bone, parent in enumerate(skeleton.parents) if parent >= 0]
        self._leaf_names = [names[leaf] for leaf in self._leaves]
        self._stick_bones = np.array(
            [skeleton.parents[bone] for bone in self._children] + self._leaves
        )
        self._ball_bones = np.array([*bones, *self._leaves, self._head, self._head])
        radius_m = np.array([stick_radius_m(name) for name in names])
        self._stick_radius_m = radius_m[self._stick_bones]
        joint_m = radius_m.copy()
        for stick, child in enumerate(self._children):
            parent = skeleton.parents[child]
            if _sided(names[child]) and not _sided(names[parent]):
                self._stick_radius_m[stick] = radius_m[child]
            else:
                joint_m[child] = max(radius_m[child], radius_m[parent])
        self._ball_size_m = np.repeat(joint_m[self._ball_bones][:, None], 3, axis=1)
        self._ball_size_m[len(names) : -2] = radius_m[self._leaves][:, None]
        self._ball_size_m[-2], self._ball_size_m[-1] = HEAD_M, NOSE_RADIUS_M
        self._shade = np.array([RIGHT_SHADE if n.startswith("right_") else 1.0 for n in names])

    @property
    def stick_count(self) -> int:
        """Per person."""
        return len(self._stick_bones)

    @property
    def ball_count(self) -> int:
        """Per person: joints, ends, head, nose."""
        return len(self._ball_bones)

    def sticks(self, pose: Pose, colour: Rgb) -> Parts:
        """Instances of a cylinder of radius 1 from y = 0 to 1."""
        start = pose.position_m[self._stick_bones]
        along = np.concatenate([pose.position_m[self._children], self._ends_m(pose)]) - start
        length_m = np.linalg.norm(along, axis=1)
        radius_m = self._stick_radius_m * _size(pose.shape)
        return Parts(
            position_m=start,
            wxyz=_turn_from_y(along / np.maximum(length_m, 1e-9)[:, None]),
            scale_m=np.stack([radius_m, length_m, radius_m], axis=1),
            rgb=self._paint(pose, self._stick_bones, colour),
        )

    def balls(self, pose: Pose, colour: Rgb) -> Parts:
        """Instances of a sphere of radius 1."""
        size = _size(pose.shape)
        head_m, head_rotation = pose.position_m[self._head], pose.rotation[self._head]
        face_m = head_m + size * np.array([HEAD_CENTRE_M, NOSE_M]) @ head_rotation.T
        wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (self.ball_count, 1))
        wxyz[-2] = to_wxyz(Rotation.from_matrix(head_rotation))
        return Parts(
            position_m=np.concatenate([pose.position_m, self._ends_m(pose), face_m]),
            wxyz=wxyz,
            scale_m=self._ball_size_m * size,
            rgb=self._paint(pose, self._ball_bones, colour),
        )

    def name_place_m(self, pose: Pose) -> Float[np.ndarray, "3"]:
        """Above the head."""
        return pose.position_m[self._head] + [0.0, _NAME_ABOVE_HEAD_M * _size(pose.shape), 0.0]

    def _ends_m(self, pose: Pose) -> Float[np.ndarray, "l 3"]:
        ends = end_offsets_m(pose.shape)
        offsets = np.array([ends[name] for name in self._leaf_names])
        turned = np.einsum("lij,lj->li", pose.rotation[self._leaves], offsets)
        return pose.position_m[self._leaves] + turned

    def _paint(
        self, pose: Pose, bones: Int[np.ndarray, " n"], colour: Rgb
    ) -> UInt8[np.ndarray, "n 3"]:
        quality = np.round(np.clip(pose.quality, 0, 1) * _QUALITY_STEPS) / _QUALITY_STEPS
        share = (_LEAST_COLOUR + (1 - _LEAST_COLOUR) * quality)[:, None]
        rgb = self._shade[:, None] * (share * np.array(colour) + (1 - share) * np.array(PALE_RGB))
        return rgb[bones].astype(np.uint8)


def _sided(name: str) -> bool:
    return name.startswith(("left_", "right_"))


def _size(shape: BodyShape) -> float:
    return shape.height_m / REFERENCE_HEIGHT_M


def _turn_from_y(direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 4"]:
    """The shortest turns that take y to unit directions; about x where they point down."""
    x, y, z = direction.T
    wxyz = np.stack([1 + y, z, np.zeros_like(x), -x], axis=1)
    wxyz[y < -1 + 1e-9] = [0.0, 1.0, 0.0, 0.0]
    return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
