"""One detection at most for each track in each view, and the reverse, at least total distance."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from fusecap.kernels import association as kernels


def assign_each_view(
    distance_m: np.ndarray,
    gate_m: np.ndarray,
    camera_of: np.ndarray,
    first: tuple[int, ...],
    free: np.ndarray,
    person: np.ndarray,
) -> None:
    """Fill the open places of `person` (t, c) with free detections nearer than the track's gate.

    `distance_m` is (t, n), `free` (n,) loses the detections given away. A pair beyond the gate
    costs as much as the gate, so leaving a track without a detection is never dearer than that.
    """
    near = np.empty(distance_m.shape, dtype=bool)
    if not kernels.assign_undisputed(distance_m, gate_m, camera_of, free, person, near):
        return
    cost = np.where(near, distance_m, gate_m[:, None])
    for c in np.flatnonzero(np.bincount(camera_of[near.any(axis=0)])):
        tracks, people = linear_sum_assignment(cost[:, first[c] : first[c + 1]])
        people += first[c]
        chosen = near[tracks, people]
        person[tracks[chosen], c] = people[chosen]
        free[people[chosen]] = False
