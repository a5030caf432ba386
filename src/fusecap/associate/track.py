"""One person over time, as the tracker knows them between two solves."""

from __future__ import annotations

import numpy as np

POSITION_GAIN = 0.8
"""Share of a triangulated landmark's news that is believed; the rest is detector noise."""
VELOCITY_GAIN = 0.4
"""Share of one interval's velocity that enters the running one."""
EXTRAPOLATION_S = 0.5
"""Velocity is worth this long: about a step of walking. Later a track waits where it is."""


class Track:
    """Landmarks with constant velocity, what was seen of them, and the body's measure."""

    __slots__ = (
        "born_ns",
        "frames",
        "landmarks",
        "limb_count",
        "limb_sum_m",
        "overlap_since_ns",
        "seen_ns",
        "strong_frames",
        "time_ns",
        "track_id",
        "triangulated_ns",
        "velocity",
    )

    def __init__(
        self, track_id: int, landmarks: np.ndarray, limb_lengths_m: np.ndarray, now_ns: int
    ) -> None:
        self.track_id = track_id
        self.born_ns = self.seen_ns = self.triangulated_ns = self.time_ns = now_ns
        self.landmarks = landmarks
        """At `time_ns` in the world [m] (k, 3), NaN where never seen."""
        self.velocity = np.zeros(landmarks.shape)
        self.frames = 0
        """Updates in which at least two views agreed."""
        self.strong_frames = 0
        """Those of them in which enough views for a birth did."""
        self.limb_sum_m = np.zeros(limb_lengths_m.shape)
        self.limb_count = np.zeros(limb_lengths_m.shape)
        self.overlap_since_ns: int | None = None
        """Since when it has shared its place with another track."""
        self.measure(limb_lengths_m)

    def predict(self, now_ns: int, solved: np.ndarray | None) -> np.ndarray:
        """Landmarks [m] now: the solver's where it gives them, else extrapolated."""
        ahead_s = min((now_ns - self.time_ns) * 1e-9, EXTRAPOLATION_S)
        own = self.landmarks + self.velocity * ahead_s
        return own if solved is None else np.where(np.isnan(solved), own, solved)

    def absorb(self, measured: np.ndarray, predicted: np.ndarray, now_ns: int) -> None:
        """Move to what was measured (k, 3); landmarks without news go along with the body."""
        news = measured - predicted
        fresh = np.isfinite(news[:, 0])
        step = np.where(fresh[:, None], POSITION_GAIN * news, 0.0)
        if fresh.any():
            step[~fresh] = POSITION_GAIN * np.median(news[fresh], axis=0)
        moved = predicted + step
        moved = np.where(np.isnan(moved), measured, moved)
        dt_s = (now_ns - self.time_ns) * 1e-9
        if dt_s > 0:
            velocity = (moved - self.landmarks) / dt_s
            velocity = (1 - VELOCITY_GAIN) * self.velocity + VELOCITY_GAIN * velocity
            self.velocity = np.where(np.isfinite(velocity), velocity, self.velocity)
        self.landmarks = moved
        self.time_ns = self.seen_ns = now_ns

    def restart(self, measured: np.ndarray, now_ns: int) -> None:
        """Begin anew where the person was found again."""
        self.landmarks = measured
        self.velocity = np.zeros(measured.shape)
        self.time_ns = self.seen_ns = self.triangulated_ns = now_ns

    def measure(self, limb_lengths_m: np.ndarray) -> None:
        """Take limb lengths [m] (m,) into the mean; NaN where not seen."""
        known = np.isfinite(limb_lengths_m)
        self.limb_sum_m[known] += limb_lengths_m[known]
        self.limb_count += known

    def limb_lengths_m(self) -> np.ndarray:
        """Mean limb lengths [m] (m,); NaN where never seen."""
        count = np.where(self.limb_count > 0, self.limb_count, np.nan)
        return self.limb_sum_m / count
