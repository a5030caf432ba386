"""Boxes and keypoints of people in one image: bounds, overlap, who is who.

A box is x0, y0, x1, y1 [px]; a person is (k, 3): x, y [px], confidence 0-1, NaN, NaN, 0 if missing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

SURE = 0.3
"""Confidence from which a keypoint counts as seen."""
PERSON = 0.3
"""Mean confidence of all keypoints below which there is nobody."""
SAME_PERSON = 0.8
"""Similarity above which two sets of keypoints are one person."""

_FALLOFF = 0.15
"""Distance over the root of the person's area at which similarity is exp(-1/2): the mean of the
COCO keypoints' constants 2 sigma (0.05 eyes to 0.21 hips)."""
_SHARED = 4
"""Keypoints seen in both, without which two people are not compared."""
_BEYOND = (0.12, 0.10)
"""What of a body lies beyond its outermost keypoints (skull, hands, soles), in shares of the
bounds' width and height, at each end."""


def overlaps(a: Float[np.ndarray, "n 4"], b: Float[np.ndarray, "m 4"]) -> Float[np.ndarray, "n m"]:
    """Area of the intersection over that of the union."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=2)
    union = areas(a)[:, None] + areas(b)[None] - shared
    return shared / np.maximum(union, 1e-9)


def areas(boxes: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """Zero for boxes turned inside out."""
    return np.prod(np.maximum(boxes[:, 2:4] - boxes[:, :2], 0.0), axis=1)


def suppressed(
    boxes: Float[np.ndarray, "n 5"], least_score: float, most_overlap: float
) -> Float[np.ndarray, "m 5"]:
    """Non-maximum suppression: best first, no two that overlap by more than `most_overlap`."""
    return boxes[unsuppressed(boxes, least_score, most_overlap)]


def unsuppressed(
    boxes: Float[np.ndarray, "n 5"], least_score: float, most_overlap: float
) -> Int[np.ndarray, " m"]:
    """Which of the boxes `suppressed` keeps, in its order."""
    good = np.flatnonzero(boxes[:, 4] >= least_score)
    order = good[np.argsort(-boxes[good, 4], kind="stable")]
    shared = overlaps(boxes[order, :4], boxes[order, :4])
    kept: list[int] = []
    for i in range(len(order)):
        if not kept or shared[i, kept].max() <= most_overlap:
            kept.append(i)
    return order[kept]


def seen(people: Float[np.ndarray, "n k 3"]) -> Bool[np.ndarray, "n k"]:
    """Keypoints that are there with confidence."""
    return np.isfinite(people[:, :, 0]) & (people[:, :, 2] >= SURE)


def bounds(people: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "n 4"]:
    """Boxes about the bodies, from the keypoints seen (all finite ones, where fewer than 4 are).

    NaN for people without keypoints.
    """
    use = seen(people)
    few = use.sum(axis=1) < _SHARED
    use[few] = np.isfinite(people[few, :, 0])
    xy = np.where(use[:, :, None], people[:, :, :2], np.nan)
    low = np.where(use[:, :, None], xy, np.inf).min(axis=1, initial=np.inf)
    high = np.where(use[:, :, None], xy, -np.inf).max(axis=1, initial=-np.inf)
    beyond = _BEYOND * np.maximum(high - low, 0.0)
    boxes = np.concatenate([low - beyond, high + beyond], axis=1)
    boxes[~use.any(axis=1)] = np.nan
    return boxes


def similarity(
    people: Float[np.ndarray, "n k 3"], others: Float[np.ndarray, "m k 3"]
) -> Float[np.ndarray, "n m"]:
    """1 for the same keypoints, towards 0 for people apart; 0 with fewer than 4 in common.

    COCO's object keypoint similarity with one constant for all keypoints and the smaller of the two
    people for scale.
    """
    both = seen(people)[:, None] & seen(others)[None]
    difference = people[:, None, :, :2] - others[None, :, :, :2]
    squared = np.where(both, np.sum(difference**2, axis=3), 0.0)
    scale = np.minimum(areas(bounds(people))[:, None], areas(bounds(others))[None])
    scale = np.maximum(np.nan_to_num(scale), 1.0) * _FALLOFF**2
    near = np.where(both, np.exp(-squared / (2.0 * scale[:, :, None])), 0.0)
    count = both.sum(axis=2)
    return np.where(count >= _SHARED, near.sum(axis=2) / np.maximum(count, 1), 0.0)


def confidence(people: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, " n"]:
    """Mean over all keypoints."""
    return people[:, :, 2].mean(axis=1)


def distinct(people: Float[np.ndarray, "n k 3"]) -> Int[np.ndarray, " m"]:
    """Indices of those who are people, each once (the most confident of its copies), in order."""
    score = confidence(people)
    alike = similarity(people, people)
    kept: list[int] = []
    for i in np.argsort(-score, kind="stable"):
        if score[i] >= PERSON and all(alike[i, j] <= SAME_PERSON for j in kept):
            kept.append(int(i))
    return np.array(sorted(kept), dtype=np.int64)


def within(people: Float[np.ndarray, "n k 3"], size: tuple[int, int]) -> Float[np.ndarray, "n k 3"]:
    """People with keypoints outside the image (w, h), or without confidence, marked missing."""
    xy = people[:, :, :2]
    with np.errstate(invalid="ignore"):
        inside = np.all((xy >= -0.5) & (xy <= np.array(size) - 0.5), axis=2)
    inside &= people[:, :, 2] > 0
    return np.where(inside[:, :, None], people, [np.nan, np.nan, 0.0])
