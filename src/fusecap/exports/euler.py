"""Rotations as three angles about moving axes, for formats that know nothing else.

(a, b, c) and (a + 180, 180 - b, c + 180) are one rotation: a frame has the triple, and the full
turns, that lie nearest to the frame before.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def euler_rad(rotation: Float[np.ndarray, "t 3 3"], order: str) -> Float[np.ndarray, "t 3"]:
    """Angles about moving axes in this order, from frame to frame as near as can be."""
    first, middle, last = ("XYZ".index(axis) for axis in order)
    sign = 1.0 if (middle - first) % 3 == 1 else -1.0
    cos_b = np.hypot(rotation[:, first, first], rotation[:, first, middle])
    b = np.arctan2(sign * rotation[:, first, last], cos_b)
    a = np.arctan2(-sign * rotation[:, middle, last], rotation[:, last, last])
    # Of R_first(a)ᵀ R the row `middle` holds c alone: exact also where a is arbitrary.
    row = np.cos(a)[:, None] * rotation[:, middle] + np.sin(a)[:, None] * sign * rotation[:, last]
    c = np.arctan2(sign * row[:, first], row[:, middle])
    return _near(np.stack([a, b, c], axis=1))


def _near(angles: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Each frame's nearer triple; a triple's distance to another is that of both their others."""
    other = np.stack([angles[:, 0] + np.pi, np.pi - angles[:, 1], angles[:, 2] + np.pi], axis=1)

    def apart(to: np.ndarray) -> np.ndarray:
        return np.abs((to[1:] - angles[:-1] + np.pi) % (2 * np.pi) - np.pi).sum(axis=1)

    swaps = np.concatenate([[False], apart(other) < apart(angles)])
    swapped = np.logical_xor.accumulate(swaps)
    return np.unwrap(np.where(swapped[:, None], other, angles), axis=0)
