"""The same people in two pictures of one camera, by how near their keypoints lie."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment


def same_people(
    first: Float[np.ndarray, "n k 3"], second: Float[np.ndarray, "m k 3"], *, gate_extents: float
) -> tuple[Int[np.ndarray, " s"], Int[np.ndarray, " s"]]:
    """Indices into both pictures of the people who are in both, one to one.

    A pair's distance is the mean over the keypoints that both have (NaN: missing), as a share of
    the larger one's extent; the total is least, and a pair beyond the gate is no pair.
    """
    if len(first) == 0 or len(second) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    away = np.linalg.norm(first[:, None, :, :2] - second[None, :, :, :2], axis=3)
    shared = np.isfinite(away)
    distance = np.where(shared, away, 0.0).sum(2) / np.maximum(shared.sum(2), 1)
    extent = np.maximum(_extent(first)[:, None], _extent(second)[None, :])
    cost = np.where(shared.any(axis=2), distance / np.maximum(extent, 1.0), np.inf)
    rows, columns = linear_sum_assignment(np.minimum(cost, 10 * gate_extents))
    same = cost[rows, columns] <= gate_extents
    return rows[same], columns[same]


def _extent(people: np.ndarray) -> np.ndarray:
    xy = people[:, :, :2]
    return (np.fmax.reduce(xy, axis=1) - np.fmin.reduce(xy, axis=1)).max(axis=1)
