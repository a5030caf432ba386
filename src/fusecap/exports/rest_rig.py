"""A rig on a person's body: where its joints are at rest, and how their axes lie."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from fusecap.body.pose import forward_kinematics
from fusecap.body.rigs import RigPreset
from fusecap.body.shape import BodyShape, end_offsets_m
from fusecap.body.skeleton import EXTENDED23


@dataclass(frozen=True, kw_only=True)
class RestRig:
    """A preset on one person's body: joints at rest, standing at the origin, facing +z, y up."""

    preset: RigPreset
    shape: BodyShape
    """On `EXTENDED23`."""
    bone_rest: Float[np.ndarray, "b 3 3"]
    """Of our bones, in the world."""
    bone_rest_positions_m: Float[np.ndarray, "b 3"]
    """Of our bones' joints, in the world."""
    position_m: Float[np.ndarray, "j 3"]
    rotation: Float[np.ndarray, "j 3 3"]
    tip_m: Float[np.ndarray, "j 3"]
    """Where each joint's bone ends."""

    def rest_of(self, bone: str) -> Float[np.ndarray, "3 3"]:
        """Of one of our bones, in the world."""
        return self.bone_rest[EXTENDED23.bone(bone)]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints."""
        return tuple(joint.name for joint in self.preset.joints)

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """Indices; -1 for the root."""
        names = self.names
        return tuple(names.index(j.parent) if j.parent else -1 for j in self.preset.joints)

    @cached_property
    def leaves(self) -> tuple[int, ...]:
        """Joints without a child."""
        return tuple(sorted({*range(len(self.parents))} - {*self.parents}))

    @property
    def travelling(self) -> tuple[int, ...]:
        """The root, and what hangs on a root that never moves: these carry the person about."""
        still = {-1, *(i for i, joint in enumerate(self.preset.joints) if not joint.turns_with)}
        return tuple(joint for joint, parent in enumerate(self.parents) if parent in still)

    @cached_property
    def position_in_parent_m(self) -> Float[np.ndarray, "j 3"]:
        """At rest; the root's in the world."""
        place = self.position_m.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                away = self.position_m[joint] - self.position_m[parent]
                place[joint] = self.rotation[parent].T @ away
        return place

    @cached_property
    def rotation_in_parent(self) -> Float[np.ndarray, "j 3 3"]:
        """At rest; the root's in the world."""
        turn = self.rotation.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                turn[joint] = self.rotation[parent].T @ self.rotation[joint]
        return turn


def rest_rig(preset: RigPreset, shape: BodyShape) -> RestRig:
    """The preset on a body of `EXTENDED23`."""
    local = np.zeros((EXTENDED23.bone_count, 3))
    for bone, vector_deg in preset.rest_deg.items():
        local[EXTENDED23.bone(bone)] = np.radians(vector_deg)
    theta = np.zeros((2, EXTENDED23.pose_size))
    theta[1, 3:] = local.ravel()
    theta[:, 1] = shape.standing_root_height_m
    positions, rotations = forward_kinematics(shape, theta)
    bone_position_m, bone_rest = positions[1], rotations[1]
    ankle = EXTENDED23.bone("left_foot")
    bone_position_m[:, 1] -= (positions[1] - positions[0])[ankle, 1]  # as high as standing straight

    def place(bone: str) -> np.ndarray:
        return bone_position_m[EXTENDED23.bone(bone)] if bone else np.zeros(3)

    names = [joint.name for joint in preset.joints]
    position_m = np.array([place(joint.sits_at) for joint in preset.joints])
    for index, joint in enumerate(preset.joints):
        if joint.towards is not None:
            target, share = joint.towards
            position_m[index] += share * (place(target) - position_m[index])
    tip_m = _tips(preset, shape, position_m, bone_rest)
    rotation = np.tile(np.eye(3), (len(names), 1, 1))
    for index, joint in enumerate(preset.joints):
        if preset.axes:
            bone = joint.turns_with[0] if joint.turns_with else ""
            turn = bone_rest[EXTENDED23.bone(bone)] if bone else np.eye(3)
            rotation[index] = _axes(preset, bone, tip_m[index] - position_m[index], turn)
    return RestRig(
        preset=preset,
        shape=shape,
        bone_rest=bone_rest,
        bone_rest_positions_m=bone_position_m,
        position_m=position_m,
        rotation=rotation,
        tip_m=tip_m,
    )


def _tips(
    preset: RigPreset,
    shape: BodyShape,
    position_m: Float[np.ndarray, "j 3"],
    bone_rest: Float[np.ndarray, "b 3 3"],
) -> Float[np.ndarray, "j 3"]:
    """A bone ends at its child nearest to the body's middle line, a leaf where our bone ends."""
    ends = end_offsets_m(shape)
    names = [joint.name for joint in preset.joints]
    tips = position_m.copy()
    for index, joint in enumerate(preset.joints):
        below = [position_m[names.index(j.name)] for j in preset.joints if j.parent == joint.name]
        apart = [p for p in below if np.linalg.norm(p - position_m[index]) > 1e-6]
        if apart:
            tips[index] = min(apart, key=lambda p: abs(round(p[0] - position_m[index, 0], 6)))
        else:
            bone = joint.turns_with[0]
            tips[index] += bone_rest[EXTENDED23.bone(bone)] @ ends[bone]
    return tips


def _axes(
    preset: RigPreset, bone: str, along_m: Float[np.ndarray, "3"], turn: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "3 3"]:
    """A joint's axes in the world, as columns; `turn` is what its bone has turned from a T-pose."""
    side, _, bare = bone.partition("_")
    told = preset.axes.get(bare if bone else "root", preset.axes[""])
    sign = -1.0 if preset.mirrored and side == "right" else 1.0
    first = along_m if told.not_along is None else turn @ np.array(told.not_along)
    first = first / np.linalg.norm(first) * (-sign if told.along.startswith("-") else sign)
    second = sign * turn @ np.array(told.points)
    second -= first * (first @ second)
    axes = {told.along[-1]: first, told.second: second / np.linalg.norm(second)}
    (third,) = {*"xyz"} - {*axes}
    after = {"x": ("y", "z"), "y": ("z", "x"), "z": ("x", "y")}[third]
    axes[third] = np.cross(axes[after[0]], axes[after[1]])
    return np.stack([axes[axis] for axis in "xyz"], axis=1)
