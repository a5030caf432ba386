"""Keypoints and orientations as smooth signals that can be read at any time.

Cameras and sensors of any rate, with frames at any times, are smoothed by the same kernel in
seconds (`SMOOTH_S`): a line is fitted to the samples about an instant, weighted by a Gaussian. All
lose the same to it and none is delayed. Without smoothing, an interpolated keypoint would be less
noisy half-way between two frames than on one, and every search would favour half frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Camera
from fusecap.geometry.same_people import same_people
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.synchronizer import GATE_EXTENTS, MAX_GAP_PERIODS

SMOOTH_S = 0.035
"""Standard deviation of the kernel: at 3 Hz it leaves 80 % of a signal."""
TREND_S = 0.09
"""The same of the velocities that weigh keypoints: those of a keypoint that only jitters vanish."""
SMOOTH_PERIODS = 0.5
"""Where a camera is so slow that this many of its frame periods are more than `SMOOTH_S`, they are
the kernel of all."""
MAX_GAP_S = 0.1
"""Samples further apart are not interpolated between, but for cameras of which `MAX_GAP_PERIODS`
frame periods are longer."""
MIN_CONFIDENCE = 0.3

_REACH = 2.5


@dataclass(frozen=True, kw_only=True)
class View:
    """One camera's people, R person-frames in tracklets, each in a slot of its own while it lasts.

    Coordinates are X/Z and Y/Z of the camera where it is calibrated, else pixels.
    """

    name: str
    times_s: Float[np.ndarray, " f"]
    row: Int[np.ndarray, "f s"]
    """Person-frame of each frame and slot, or -1."""
    row_s: Float[np.ndarray, " r"]
    tracklet: Int[np.ndarray, " r"]
    point: Float[np.ndarray, "r k 2"]
    """Smoothed; NaN where missing."""
    velocity: Float[np.ndarray, "r k 2"]
    """Per second."""
    trend: Float[np.ndarray, "r k 2"]
    """Velocity over a longer time, `TREND_S`."""
    extent: Float[np.ndarray, " r"]
    """Of the person in the image."""
    focal_px: float
    """Of an image 1920 pixels wide; 1 for pixels."""

    @property
    def seen(self) -> bool:
        """Whether anybody was seen for longer than an instant."""
        return bool(np.isfinite(self.point).any())

    def at(self, times_s: Float[np.ndarray, " t"]) -> tuple[Float[np.ndarray, "t s k 2"], ...]:
        """Points, velocities and trends on the camera's own clock; NaN where nobody was seen."""
        frame = np.searchsorted(self.times_s, times_s, side="right") - 1
        inside = (frame >= 0) & (frame < len(self.times_s))
        first = np.where(inside[:, None], self.row[np.clip(frame, 0, len(self.times_s) - 1)], -1)
        second = np.minimum(first + 1, len(self.row_s) - 1)
        step_s = self.row_s[second] - self.row_s[first]
        linked = (first >= 0) & (second > first) & (self.tracklet[second] == self.tracklet[first])
        linked &= (step_s > 0) & (step_s <= _max_gap_s(self.times_s))
        h = np.where(linked, step_s, np.nan)[:, :, None, None]
        u = (times_s[:, None] - self.row_s[first])[:, :, None, None] / h
        p, q = self.point[first], self.point[second]
        v, w = self.velocity[first], self.velocity[second]
        point = (1 + 2 * u) * (1 - u) ** 2 * p + u * u * (3 - 2 * u) * q
        point += h * u * (1 - u) * ((1 - u) * v - u * w)
        trend = (1 - u) * self.trend[first] + u * self.trend[second]
        return point, (1 - u) * v + u * w, trend

    def people_at(self, times_s: Float[np.ndarray, " t"]) -> Int[np.ndarray, "t s"]:
        """Person-frame nearest before each instant within `MAX_GAP_S`, or -1."""
        frame = np.searchsorted(self.times_s, times_s, side="right") - 1
        near = np.clip(frame, 0, len(self.times_s) - 1)
        late_s = times_s - self.times_s[near]
        inside = (frame >= 0) & (late_s <= min(MAX_GAP_S, 2 * self.period_s))
        return np.where(inside[:, None], self.row[near], -1)

    @property
    def period_s(self) -> float:
        """Median time between frames."""
        return _period_s(self.times_s)


def _period_s(times_s: Float[np.ndarray, " f"]) -> float:
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else MAX_GAP_S


def _max_gap_s(times_s: Float[np.ndarray, " f"]) -> float:
    return max(MAX_GAP_S, MAX_GAP_PERIODS * _period_s(times_s))


def common_smooth_s(tracks: Sequence[KeypointTrack]) -> float:
    """Standard deviation of the kernel [s] that suits every camera of a session."""
    slowest_s = max(_period_s(track.times_s) for track in tracks)
    return max(SMOOTH_S, SMOOTH_PERIODS * slowest_s)


def view_of(track: KeypointTrack, camera: Camera | None, smooth_s: float = SMOOTH_S) -> View:
    """A camera's keypoints as a view, undistorted where `camera` is known.

    Views that are compared share one `smooth_s`.
    """
    tracklet, slot = _linked(track.times_s, track.people)
    frame = np.repeat(np.arange(len(track.people)), [len(people) for people in track.people])
    order = np.lexsort((frame, tracklet))
    keypoints = np.concatenate(track.people)[order] if len(frame) else _nobody(track)
    frame, tracklet, slot = frame[order], tracklet[order], slot[order]
    seen = (keypoints[:, :, 2] >= MIN_CONFIDENCE) & np.isfinite(keypoints[:, :, 0])
    point, focal_px = keypoints[:, :, :2], 1.0
    if camera is not None:
        point = camera.undistort(point.reshape(-1, 2)).reshape(point.shape)
        focal_px = float(camera.matrix[0, 0]) * camera.pixel_scale
    point = np.where(seen[:, :, None], point, np.nan)
    row_s = track.times_s[frame]
    smooth, velocity, trend = (np.full(point.shape, np.nan) for _ in range(3))
    ends = np.flatnonzero(np.diff(tracklet, append=-1)) + 1
    starts = np.concatenate([[0], ends[:-1]])
    for start, end in zip(starts, ends, strict=True) if len(frame) else ():
        if end - start < 3:
            continue
        rows = slice(start, end)
        flat = point[rows].reshape(end - start, -1)
        value, slope = smoothed(row_s[rows], flat, row_s[rows], smooth_s)
        known = np.isfinite(flat)
        smooth[rows] = np.where(known, value, np.nan).reshape(point[rows].shape)
        velocity[rows] = np.where(known, slope, np.nan).reshape(point[rows].shape)
        _, slope = smoothed(row_s[rows], flat, row_s[rows], max(TREND_S, smooth_s))
        trend[rows] = np.where(known, slope, np.nan).reshape(point[rows].shape)
    row = np.full((len(track.people), int(slot.max()) + 1 if len(slot) else 1), -1)
    row[frame, slot] = np.arange(len(frame))
    with np.errstate(invalid="ignore"):
        span = np.fmax.reduce(point, axis=1) - np.fmin.reduce(point, axis=1)
    return View(
        name=track.name,
        times_s=track.times_s,
        row=row,
        row_s=row_s,
        tracklet=tracklet,
        point=smooth,
        velocity=velocity,
        trend=trend,
        extent=span.max(axis=1),
        focal_px=focal_px,
    )


def _nobody(track: KeypointTrack) -> np.ndarray:
    return np.empty((0, len(track.landmarks.landmark_names), 3))


def _linked(
    times_s: Float[np.ndarray, " f"], people: Sequence[np.ndarray]
) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """Per person-frame its tracklet, and a slot that no other tracklet has at the same time."""
    tracklets: list[int] = []
    slots: list[int] = []
    last: list[tuple[int, int]] = []
    count = 0
    max_gap_s = _max_gap_s(times_s)
    for frame, now in enumerate(people):
        current: list[tuple[int, int] | None] = [None] * len(now)
        if frame and times_s[frame] - times_s[frame - 1] <= max_gap_s:
            same = same_people(people[frame - 1], now, gate_extents=GATE_EXTENTS)
            for before, after in zip(*same, strict=True):
                current[after] = last[before]
        taken = {each[1] for each in current if each}
        for index, each in enumerate(current):
            if each is None:
                slot = next(s for s in range(len(taken) + 1) if s not in taken)
                taken.add(slot)
                current[index] = (count, slot)
                count += 1
        last = [each for each in current if each is not None]
        tracklets += [tracklet for tracklet, _ in last]
        slots += [slot for _, slot in last]
    return np.array(tracklets, dtype=np.int64), np.array(slots, dtype=np.int64)


def smoothed(
    times_s: Float[np.ndarray, " n"],
    values: Float[np.ndarray, "n m"],
    at_s: Float[np.ndarray, " g"],
    sigma_s: float,
) -> tuple[Float[np.ndarray, "g m"], Float[np.ndarray, "g m"]]:
    """Value and slope of the weighted line through the samples about each instant.

    `times_s` ascend; NaN values are left out. NaN where no two samples, one of them within
    `MAX_GAP_S`, are in reach.
    """
    shape = (len(at_s), values.shape[1])
    s0, s1, s2, y0, y1 = (np.zeros(shape) for _ in range(5))
    first = np.searchsorted(times_s, at_s - _REACH * sigma_s)
    last = np.searchsorted(times_s, at_s + _REACH * sigma_s, side="right")
    known = np.isfinite(values)
    filled = np.where(known, values, 0.0)
    for step in range(int((last - first).max(initial=0))):
        index = np.minimum(first + step, len(times_s) - 1)
        dt = times_s[index] - at_s
        weight = np.where(first + step < last, np.exp(-0.5 * (dt / sigma_s) ** 2), 0.0)
        w = weight[:, None] * known[index]
        s0 += w
        s1 += w * dt[:, None]
        s2 += w * dt[:, None] ** 2
        y0 += w * filled[index]
        y1 += w * dt[:, None] * filled[index]
    determinant = s0 * s2 - s1 * s1
    with np.errstate(divide="ignore", invalid="ignore"):
        enough = determinant > 1e-4 * sigma_s**2 * np.maximum(s0, 1e-3) ** 2
        value = np.where(enough, (s2 * y0 - s1 * y1) / determinant, np.nan)
        slope = np.where(enough, (s0 * y1 - s1 * y0) / determinant, np.nan)
    return value, slope


def turning_rad_s(
    times_s: Float[np.ndarray, " n"],
    rotation: Float[np.ndarray, "n 3 3"],
    at_s: Float[np.ndarray, " g"],
    sigma_s: float,
) -> Float[np.ndarray, "g 3"]:
    """Smoothed angular velocity in the turning frame.

    NaN where samples are missing or too far apart.
    """
    known = np.isfinite(rotation).all(axis=(1, 2))
    own_s, own = times_s[known], rotation[known]
    if len(own_s) < 3:
        return np.full((len(at_s), 3), np.nan)
    step_s = np.diff(own_s)
    turn = (Rotation.from_matrix(own[:-1]).inv() * Rotation.from_matrix(own[1:])).as_rotvec()
    rate = np.where((step_s <= MAX_GAP_S)[:, None], turn / step_s[:, None], np.nan)
    middle_s = (own_s[:-1] + own_s[1:]) / 2
    value, _ = smoothed(middle_s, rate, at_s, sigma_s)
    covered: Bool[np.ndarray, " g"] = _covered(own_s, at_s)
    return np.where(covered[:, None], value, np.nan)


def _covered(times_s: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Whether each instant lies between two samples that are near each other."""
    after = np.searchsorted(times_s, at_s)
    inside = (after > 0) & (after < len(times_s))
    after = np.clip(after, 1, len(times_s) - 1)
    return inside & (times_s[after] - times_s[after - 1] <= MAX_GAP_S)
