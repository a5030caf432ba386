"""One detection at most for each track in each view, and the reverse, at least total distance."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment


def assign_each_view(
    distance_m: np.ndarray,
    gate_m: np.ndarray,
    first: tuple[int, ...],
    free: np.ndarray,
    person: np.ndarray,
) -> None:
    """Fill the open places of `person` (t, c) with free detections nearer than the track's gate.

    `distance_m` is (t, n), `free` (n,) loses the detections given away. A pair beyond the gate
    costs as much as the gate, so leaving a track without a detection is never dearer than that.
    """
    inside = (distance_m < gate_m[:, None]) & free
    for c in range(len(first) - 1):
        view = slice(first[c], first[c + 1])
        near = inside[:, view] & (person[:, c] < 0)[:, None]
        if not near.any():
            continue
        cost = np.where(near, distance_m[:, view], gate_m[:, None])
        tracks, people = linear_sum_assignment(cost)
        chosen = near[tracks, people]
        tracks, people = tracks[chosen], people[chosen] + first[c]
        person[tracks, c] = people
        free[people] = False
