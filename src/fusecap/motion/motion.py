"""What every motion file becomes: bone rotations in a y-up world, whatever the format.

A joint is named after the bone that starts at it. At zero rotation the bones point along
`bone_vector_m`, in the file's own rest pose: for the CMU database a T-pose facing +z with the legs
splayed by 20 degrees.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.errors import InputError

CMU_UNIT_M = 0.0254 / 0.45
"""Metres per unit of length in the CMU database: inches scaled by 0.45."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """One take as its file has it, T frames of J joints."""

    name: str
    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    """-1 for the root, which comes first; otherwise smaller than the joint's own index."""
    bone_vector_m: Float[np.ndarray, "j 3"]
    """From each joint to the end of its bone at zero rotation; zero for a bone without length."""
    root_position_m: Float[np.ndarray, "t 3"]
    rotation_in_world: Float[np.ndarray, "t j 3 3"]
    rate_hz: float

    def __len__(self) -> int:
        return len(self.root_position_m)

    def __getitem__(self, frames: slice) -> Motion:
        """The given frames; a step divides the rate."""
        return Motion(
            name=self.name,
            joint_names=self.joint_names,
            parents=self.parents,
            bone_vector_m=self.bone_vector_m,
            root_position_m=self.root_position_m[frames],
            rotation_in_world=self.rotation_in_world[frames],
            rate_hz=self.rate_hz / (frames.step or 1),
        )


def chain_rotations(
    parents: tuple[int, ...], local: Float[np.ndarray, "t j 3 3"]
) -> Float[np.ndarray, "t j 3 3"]:
    """Rotations in the world from rotations local to the parent."""
    world = local.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def numbers(tokens: Iterable[str], what: str) -> list[float]:
    """The tokens as finite floats; raises `InputError` quoting the first that is not one."""
    values = []
    for token in tokens:
        try:
            value = float(token)
        except ValueError:
            raise InputError(f"{what}: expected a number, found '{token[:40]}'") from None
        if not np.isfinite(value):
            raise InputError(f"{what}: '{token}' is not a finite number")
        values.append(value)
    return values
