"""The tree of bones, and the frames they live in.

The rest pose is a T-pose facing +z with y up and all rotations zero, so every bone frame is
parallel to the world there: x to the subject's left, y up, z forward. A bone's frame sits at the
joint that ties it to its parent. Bone lengths belong to `BodyShape`; this file knows topology only.

The pose of a body is the vector `theta` (3 + 3B,): root translation in the world, then one
angle-axis vector per bone, local to its parent (the root's local to the world) [1, sec. 3.1].

[1] Malleson, Collomosse, Hilton, IJCV 128 (2020).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Int

from fusecap.errors import MotionError, nearest


@dataclass(frozen=True, kw_only=True)
class Skeleton:
    """A tree of bones: `parents[b] < b`, and -1 for the root."""

    name: str
    bone_names: tuple[str, ...]
    parents: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.bone_names) != len(self.parents) or self.parents[:1] != (-1,):
            raise MotionError(f"skeleton '{self.name}': one parent per bone, the root first")
        for bone, parent in enumerate(self.parents[1:], start=1):
            if not 0 <= parent < bone:
                raise MotionError(
                    f"skeleton '{self.name}': the parent of '{self.bone_names[bone]}' "
                    "must come before it"
                )

    @property
    def bone_count(self) -> int:
        """Number of bones, B."""
        return len(self.bone_names)

    @property
    def pose_size(self) -> int:
        """Length of `theta`, 3 + 3B."""
        return 3 + 3 * self.bone_count

    @cached_property
    def parent_array(self) -> Int[np.ndarray, " b"]:
        """Parents as the kernels want them."""
        return np.array(self.parents, dtype=np.int64)

    def bone(self, name: str) -> int:
        """Index of the bone called `name`; raises `MotionError` naming the nearest one."""
        try:
            return self.bone_names.index(name)
        except ValueError:
            raise MotionError(
                f"skeleton '{self.name}' has no bone '{name}'{nearest(name, self.bone_names)}"
            ) from None

    def children(self, bone: int) -> list[int]:
        """Bones whose parent is `bone`."""
        return [b for b, parent in enumerate(self.parents) if parent == bone]


def _build(name: str, tree: list[tuple[str, str]]) -> Skeleton:
    names = tuple(bone for bone, _ in tree)
    parents = tuple(names.index(parent) if parent else -1 for _, parent in tree)
    return Skeleton(name=name, bone_names=names, parents=parents)


def _limbs(arm_parent: str) -> list[tuple[str, str]]:
    tree = []
    for side in ("left", "right"):
        shoulder = arm_parent.format(side=side)
        tree += [
            (f"{side}_upper_arm", shoulder),
            (f"{side}_forearm", f"{side}_upper_arm"),
            (f"{side}_hand", f"{side}_forearm"),
        ]
    for side in ("left", "right"):
        tree += [
            (f"{side}_thigh", "hips"),
            (f"{side}_shank", f"{side}_thigh"),
            (f"{side}_foot", f"{side}_shank"),
            (f"{side}_toes", f"{side}_foot"),
        ]
    return tree


_TRUNK = [
    ("hips", ""),
    ("spine", "hips"),
    ("spine1", "spine"),
    ("spine2", "spine1"),
    ("spine3", "spine2"),
    ("neck", "spine3"),
    ("head", "neck"),
]

PAPER21 = _build("paper21", _TRUNK + _limbs("spine3"))
"""The paper's 21 bones, 66 degrees of freedom."""

EXTENDED23 = _build(
    "extended23",
    _TRUNK
    + [("left_clavicle", "spine3"), ("right_clavicle", "spine3")]
    + _limbs("{side}_clavicle"),
)
"""`PAPER21` with clavicles, 72 degrees of freedom."""

ELBOW_HINGE = np.array([0.0, np.cos(np.radians(30.0)), -np.sin(np.radians(30.0))])
"""In the upper arm's frame. With arms to the sides and palms down the elbow's pit faces forward and
30 deg up in every skeleton of the CMU motion capture database, from which the pose prior is; people
differ."""

SKELETONS = {skeleton.name: skeleton for skeleton in (PAPER21, EXTENDED23)}


def skeleton_named(name: str) -> Skeleton:
    """The skeleton called `name`; raises `MotionError` naming the known ones."""
    if name not in SKELETONS:
        raise MotionError(f"no skeleton '{name}'{nearest(name, SKELETONS)}")
    return SKELETONS[name]
