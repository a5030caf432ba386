"""How clothes look to one camera: a few numbers of torso and thighs that a picture leaves.

Per part two distributions, each a row of bytes that sum to about 255, all 0 where the part was
not seen alone:

    chroma     8 hues x 2 saturations, and one bin for what has no colour
    lightness  dark, middle, light: stops against the middle of the picture

Both are soft: a hue between two bins counts for both, so a little other light moves little. Two
descriptors of one camera are compared by

    d = sqrt(1 - BC(chroma) sqrt(BC(lightness)))      BC = sum sqrt(p q), mean over common parts

0 for equal ones, 1 for nothing in common; lightness counts less, as shade and exposure change it.
Nothing here tells who somebody is: only whether two that were seen in one room wear the same.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

PARTS = ("torso", "thighs")
HUES, SATURATIONS, LIGHTNESSES = 8, 2, 3
CHROMA_SIZE = HUES * SATURATIONS + 1
PART_SIZE = CHROMA_SIZE + LIGHTNESSES
APPEARANCE_SIZE = len(PARTS) * PART_SIZE
"""Numbers of one person in one picture."""


def unknown(people: int) -> UInt8[np.ndarray, "n 40"]:
    """Of people whose clothes nobody saw."""
    return np.zeros((people, APPEARANCE_SIZE), np.uint8)


def by_part(appearance: np.ndarray) -> np.ndarray:
    """(..., 40) as (..., parts, numbers)."""
    return appearance.reshape(*appearance.shape[:-1], len(PARTS), PART_SIZE)


def difference(
    a: Float[np.ndarray, "*n parts size"], b: Float[np.ndarray, "*n parts size"]
) -> Float[np.ndarray, "*n"]:
    """D of descriptors by part, counts of any size; NaN where no part is known of both."""
    chroma = _alike(a[..., :CHROMA_SIZE], b[..., :CHROMA_SIZE])
    lightness = _alike(a[..., CHROMA_SIZE:], b[..., CHROMA_SIZE:])
    apart = np.sqrt(np.maximum(1.0 - chroma * np.sqrt(lightness), 0.0))
    known = np.isfinite(apart)
    count = known.sum(axis=-1)
    mean = np.where(known, apart, 0.0).sum(axis=-1) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan)


def _alike(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Bhattacharyya's coefficient of rows, scaled to sum 1; NaN for empty ones."""
    total = p.sum(axis=-1) * q.sum(axis=-1)
    return np.sqrt(p * q).sum(axis=-1) / np.sqrt(np.where(total > 0, total, np.nan))
