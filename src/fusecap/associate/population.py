"""All tracks, subjects' and bystanders': born, found again, doubled, let go."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusecap.associate.anatomy import Anatomy, size_misfit
from fusecap.associate.candidates import Candidate
from fusecap.associate.matching import cheapest
from fusecap.associate.options import TrackerOptions
from fusecap.associate.track import Track
from fusecap.associate.views import MIN_COMMON
from fusecap.kernels import association as kernels


class Population:
    """Everybody who is tracked, in order of birth."""

    def __init__(
        self,
        options: TrackerOptions,
        anatomy: Anatomy,
        mirror: np.ndarray,
        ids: Iterator[int],
    ) -> None:
        self.tracks: list[Track] = []
        self._options = options
        self._anatomy = anatomy
        self._mirror = mirror
        self._ids = ids

    def begin(self, landmarks: np.ndarray, now_ns: int) -> Track:
        """A new track, tentative until it is established."""
        centre_m, limbs_m = self._anatomy.centre(landmarks), self._anatomy.limb_lengths(landmarks)
        track = Track(next(self._ids), landmarks, centre_m, limbs_m, now_ns)
        self.tracks.append(track)
        return track

    def reunite(self, found: list[Candidate], now_ns: int) -> list[tuple[int, int]]:
        """Which unseen track continues in which candidate: near enough, and the same size."""
        o = self._options
        unseen = [t for t, track in enumerate(self.tracks) if track.seen_ns < now_ns]
        if not unseen:
            return []
        centres = [self._anatomy.centre(c.landmarks_in_world_m) for c in found]
        limbs = [self._anatomy.limb_lengths(c.landmarks_in_world_m) for c in found]
        cost = np.full((len(unseen), len(found)), np.inf)
        for row, t in enumerate(unseen):
            track = self.tracks[t]
            reach = o.reach_m + o.reach_speed_m_s * (now_ns - track.triangulated_ns) * 1e-9
            expected = self._anatomy.centre(track.predict(now_ns))
            for column, centre in enumerate(centres):
                away = float(np.linalg.norm(centre - expected))
                misfit = size_misfit(track.limb_lengths_m(), limbs[column])
                if away < reach and misfit < 2 * o.size_tolerance:
                    cost[row, column] = away + misfit
        return [(unseen[row], column) for row, column in cheapest(cost)]

    def is_duplicate(self, landmarks: np.ndarray) -> bool:
        """Whether somebody already tracked stands there, this way round or the other."""
        return any(
            _apart(landmarks, track.landmarks, self._mirror) < self._options.duplicate_m
            for track in self.tracks
        )

    def forget(
        self,
        measured: np.ndarray,
        subjects: set[int],
        looked: np.ndarray,
        elapsed_ns: int,
        now_ns: int,
    ) -> None:
        """Let go of tracks unseen for too long, and of the younger of two on one person.

        `looked` (c,) are the cameras that looked now, `subjects` the ids of the subjects' tracks.
        """
        o = self._options
        alive = []
        for track in self.tracks:
            known = track.track_id in subjects or track.is_established(o)
            enough = min(2, len(looked)) if known else 1
            track.wait(now_ns, elapsed_ns, int(looked.sum()), enough)
            missed_s, alone_s = track.missed_ns * 1e-9, track.alone_ns * 1e-9
            away_s = (now_ns - track.seen_ns) * 1e-9
            if (
                missed_s <= (o.coast_s if known else o.tentative_s)
                and alone_s <= o.single_view_s
                and away_s <= o.coast_s + o.memory_s
            ):
                alive.append(track)
        doubled = self._doubled(alive, measured, subjects, now_ns)
        self.tracks = [track for track in alive if track not in doubled]

    def _doubled(
        self, alive: list[Track], measured: np.ndarray, subjects: set[int], now_ns: int
    ) -> list[Track]:
        """Tracks that have shared the place of a better established one for too long."""
        seen = [
            (track.track_id not in subjects, track.born_ns, r)
            for r, track in enumerate(self.tracks)
            if track.triangulated_ns == now_ns and track in alive
        ]
        order = [r for *_, r in sorted(seen)]
        same = np.empty((len(order), len(order)), dtype=bool)
        kernels.coincide(measured[order], self._options.duplicate_m / 2, MIN_COMMON, same)
        doubled = []
        for place, r in enumerate(order):
            track = self.tracks[r]
            if not same[place, :place].any():
                track.overlap_since_ns = None
            elif track.overlap_since_ns is None:
                track.overlap_since_ns = now_ns
            elif (now_ns - track.overlap_since_ns) * 1e-9 >= self._options.overlap_s:
                doubled.append(track)
        return doubled


def _apart(a: np.ndarray, b: np.ndarray, mirror: np.ndarray) -> float:
    """Median distance [m] of two skeletons' common landmarks, or of left to right if less."""
    distance = np.fmin(np.linalg.norm(a - b, axis=1), np.linalg.norm(a - b[mirror], axis=1))
    distance = distance[np.isfinite(distance)]
    return float(np.median(distance)) if len(distance) >= MIN_COMMON else np.inf
