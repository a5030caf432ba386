"""Which detection is whose, where tracks are expected.

Each view gives its detections away at least total distance, within a gate; the views of a track
must then agree in space, and what is still free is matched with the skeletons just measured.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from fusecap.associate.options import TrackerOptions
from fusecap.associate.views import Views
from fusecap.kernels import association as kernels

TRUNCATION = 2.0
"""No landmark counts as farther than so many gates: half a body may be wild before the mean is."""


class Matcher:
    """Gives the detections of one instant to the tracks that are expected there."""

    def __init__(self, options: TrackerOptions, mirror: np.ndarray) -> None:
        self._options = options
        self._mirror = mirror

    def match(
        self,
        views: Views,
        expected: np.ndarray,
        young: np.ndarray,
        free: np.ndarray,
        looking: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of detections (t, c) and triangulated landmarks (t, k, 3); `free` is updated.

        Tracks (t,) that are `young` choose after everyone else; `looking` is how many cameras do.
        """
        o = self._options
        person = np.full((len(expected), len(views.cameras)), -1)
        if len(expected) == 0:
            return person, expected.copy()
        gate = np.full(len(expected), o.gate_m)
        distance = self._distance(views, expected, free)
        assign_each_view(
            distance, np.where(young, 0.0, gate), views.camera_of, views.first, free, person
        )
        if young.any():
            assign_each_view(distance, gate, views.camera_of, views.first, free, person)
        if looking > 1:
            self._leave_far_ones(person, distance)
        measured = self._check(views, person, distance, free)

        # Only what was not far from a prediction can be near the skeleton just measured.
        near = free & (distance < 1.5 * o.gate_m).any(axis=0)
        if near.any():
            current = np.where(np.isnan(measured), expected, measured)
            again = self._distance(views, current, near)
            tight = np.full(len(current), o.candidates.consistency_m)
            before = person.copy()
            assign_each_view(again, tight, views.camera_of, views.first, free, person)
            if (person != before).any():
                measured = self._check(views, person, np.fmin(again, distance), free)
            # What looks like somebody already found, doubled or mirrored, is nobody else.
            free &= ~(again < o.candidates.consistency_m).any(axis=0)
        return person, measured

    def _leave_far_ones(self, person: np.ndarray, distance: np.ndarray) -> None:
        """A view that no other confirms must be as near as views are to each other."""
        for t in np.flatnonzero((person >= 0).sum(axis=1) == 1):
            camera = int(np.argmax(person[t] >= 0))
            if distance[t, person[t, camera]] > self._options.candidates.consistency_m:
                person[t, camera] = -1

    def _distance(self, views: Views, landmarks: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Distance [m] (t, n) of tracks to detections, right way round or mirrored."""
        truncation_m = TRUNCATION * self._options.gate_m
        plain = views.distances(landmarks, truncation_m, wanted)
        other_way = np.ascontiguousarray(landmarks[:, self._mirror])
        mirrored = views.distances(other_way, truncation_m, wanted)
        return np.minimum(plain, mirrored + self._options.mirror_penalty_m)

    def _check(
        self, views: Views, person: np.ndarray, distance: np.ndarray, free: np.ndarray
    ) -> np.ndarray:
        o = self._options.candidates
        measured = views.triangulate(person, distance, o.consistency_m, o.robust_scale_px)
        free[:] = True
        free[person[person >= 0]] = False
        return measured


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


def cheapest(cost: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (row, column) of least total cost; infinite ones never."""
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e6))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if np.isfinite(cost[r, c])]
