"""Quaternions are wxyz inside; SciPy and most receivers of streams want xyzw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def from_wxyz(quaternion: Float[np.ndarray, "*n 4"] | Sequence[float]) -> Rotation:
    """One rotation of `(4,)`, or many of `(n, 4)`, of any length but zero."""
    return Rotation.from_quat(np.roll(quaternion, -1, axis=-1))


def to_wxyz(rotation: Rotation) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions, w >= 0."""
    return np.roll(to_xyzw(rotation), 1, axis=-1)


def to_xyzw(rotation: Rotation) -> Float[np.ndarray, "*n 4"]:
    """Unit quaternions with w >= 0 in the order of VMC, Live Link, Rokoko, LSL and OSC."""
    return rotation.as_quat(canonical=True)
