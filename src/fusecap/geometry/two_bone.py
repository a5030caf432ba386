"""A limb of two bones that reaches for a place."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

STRETCHED = 0.9995
"""It reaches no further than this share of its length."""


def two_bone_turns(
    root: Float[np.ndarray, "n 3"],
    middle: Float[np.ndarray, "n 3"],
    end: Float[np.ndarray, "n 3"],
    target: Float[np.ndarray, "n 3"],
    *,
    forward: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3 3"]]:
    """Rotations in the world, to put before those of the two bones, that bring `end` to `target`.

    The limb keeps the plane it bends in; a straight one bends towards `forward`. A target out of
    reach is met in direction only.
    """
    upper = np.linalg.norm(middle - root, axis=1)
    lower = np.linalg.norm(end - middle, axis=1)
    reach = np.clip(
        np.linalg.norm(target - root, axis=1),
        np.abs(upper - lower) * 1.001,
        (upper + lower) * STRETCHED,
    )
    along = _unit(target - root)
    beside = _across(middle - root, along)
    straight = np.linalg.norm(beside, axis=1) < 1e-4
    bend = _unit(np.where(straight[:, None], _across(forward, along), beside))
    cosine = np.clip((upper**2 + reach**2 - lower**2) / (2 * upper * reach), -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    new_middle = root + upper[:, None] * (cosine[:, None] * along + sine[:, None] * bend)
    new_end = root + reach[:, None] * along
    return least_turns(middle - root, new_middle - root), least_turns(
        end - middle, new_end - new_middle
    )


def least_turns(
    one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """The shortest rotations that take directions to others."""
    axis = np.cross(one, other)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ni,ni->n", one, other))
    vector = axis * (angle / np.maximum(sine, 1e-15))[:, None]
    return Rotation.from_rotvec(vector).as_matrix()


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _across(
    vectors: Float[np.ndarray, "n 3"], along: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    return vectors - along * np.einsum("ni,ni->n", vectors, along)[:, None]
