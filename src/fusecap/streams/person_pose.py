"""One person at one instant, as streams send it: in the world, in metres and rotation matrices.

`paper21` has no clavicles, engines' skeletons do. `with_clavicles` puts them in: they turn with the
upper spine bone and carry the share of the shoulder's offset that they have in `extended23`, so
every joint that was solved stays where it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.shape import BodyShape, bones_of_extended, shape_with_clavicles
from fusecap.body.skeleton import EXTENDED23, Skeleton
from fusecap.geometry.quaternions import from_wxyz, to_xyzw
from fusecap.take import Take
from fusecap.types import Estimate


@dataclass(frozen=True, kw_only=True)
class PersonPose:
    """A solved person; world right-handed, y up, and bones parallel to it in the T-pose."""

    name: str
    timestamp_ns: int
    shape: BodyShape
    bone_position_in_world_m: Float[np.ndarray, "b 3"]
    bone_rotation_in_world: Float[np.ndarray, "b 3 3"]
    bone_quality: Float[np.ndarray, " b"]
    """0-1; 0 where the pose is the prior's guess."""

    @property
    def skeleton(self) -> Skeleton:
        """The tree of bones."""
        return self.shape.skeleton

    @property
    def root_position_in_world_m(self) -> Float[np.ndarray, " 3"]:
        """Of the hips."""
        return self.bone_position_in_world_m[0]

    @cached_property
    def bone_rotation_in_parent(self) -> Float[np.ndarray, "b 3 3"]:
        """Local rotations; the root's is the one in the world."""
        return in_parents(
            self.skeleton.parents, self.bone_position_in_world_m, self.bone_rotation_in_world
        )[1]

    @cached_property
    def bone_rotation_in_world_xyzw(self) -> Float[np.ndarray, "b 4"]:
        """Unit quaternions, w >= 0."""
        return to_xyzw(Rotation.from_matrix(self.bone_rotation_in_world))

    @cached_property
    def extended(self) -> PersonPose:
        """The same person on `extended23`."""
        return with_clavicles(self)


@dataclass(frozen=True, kw_only=True)
class StreamFrame:
    """What is sent at one instant."""

    time_s: float
    """Since the stream began, at the recording's own pace."""
    timestamp_ns: int
    """On the take's clock."""
    people: Mapping[str, PersonPose | None]
    """Everyone the stream is about, always in the same order; None while not tracked."""

    @property
    def tracked(self) -> tuple[PersonPose, ...]:
        """Those who are tracked now."""
        return tuple(pose for pose in self.people.values() if pose is not None)


def pose_of_estimate(estimate: Estimate) -> PersonPose:
    """A live solve's result."""
    return PersonPose(
        name=estimate.name,
        timestamp_ns=estimate.timestamp_ns,
        shape=estimate.shape,
        bone_position_in_world_m=estimate.bone_position_in_world_m,
        bone_rotation_in_world=estimate.bone_rotation_in_world,
        bone_quality=estimate.bone_quality,
    )


def pose_of_take(
    take: Take, subject: int, frame: int, shape: BodyShape | None = None
) -> PersonPose | None:
    """One subject in one frame of a take; None where it is not tracked.

    `shape` spares building the subject's, for those who ask for every frame.
    """
    if not take.tracked[subject, frame]:
        return None
    quaternion = take.bone_rotation_in_world_wxyz[subject, frame]
    return PersonPose(
        name=take.subject_names[subject],
        timestamp_ns=int(take.timestamps_ns[frame]),
        shape=shape or take.shape(subject),
        bone_position_in_world_m=take.bone_position_in_world_m[subject, frame],
        bone_rotation_in_world=from_wxyz(quaternion).as_matrix(),
        bone_quality=take.bone_quality[subject, frame],
    )


def with_clavicles(pose: PersonPose) -> PersonPose:
    """The same person on `extended23`; clavicles that were not solved have quality 0."""
    if "left_clavicle" in pose.skeleton.bone_names:
        return pose
    source = bones_of_extended(pose.skeleton)
    position = pose.bone_position_in_world_m[source]
    rotation = pose.bone_rotation_in_world[source]
    quality = pose.bone_quality[source]
    extended = shape_with_clavicles(pose.shape)
    for side in ("left", "right"):
        clavicle = EXTENDED23.bone(f"{side}_clavicle")
        position[clavicle] += rotation[clavicle] @ extended.offsets_m[clavicle]
        quality[clavicle] = 0.0
    return PersonPose(
        name=pose.name,
        timestamp_ns=pose.timestamp_ns,
        shape=extended,
        bone_position_in_world_m=position,
        bone_rotation_in_world=rotation,
        bone_quality=quality,
    )


def in_parents(
    parents: tuple[int, ...],
    position_in_world_m: Float[np.ndarray, "n 3"],
    rotation_in_world: Float[np.ndarray, "n 3 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Positions and rotations relative to the parents'; a root's (-1) stay in the world."""
    parent = np.array(parents)
    child = parent >= 0
    position, rotation = position_in_world_m.copy(), rotation_in_world.copy()
    to_parent = np.swapaxes(rotation_in_world[parent[child]], 1, 2)
    away = position_in_world_m[child] - position_in_world_m[parent[child]]
    position[child] = np.einsum("nij,nj->ni", to_parent, away)
    rotation[child] = to_parent @ rotation_in_world[child]
    return position, rotation
