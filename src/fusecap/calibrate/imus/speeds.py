"""Angular speeds of bones and sensors, which depend on neither mounting nor heading.

They tell whether clocks agree, and how well a sensor and a bone go together.
Speeds are over `SPAN_S`: the mean of a tenth of a second, so that a keypoint that jumps for one
frame does not look like a turn.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from fusecap.calibrate.imus.reference import ReferenceMotion
from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.imu_files.track import ImuTrack

SPAN_S = 0.15
MAX_LAG_S = 10.0
LAG_RATE_HZ = 50.0
MIN_OVERLAP_S = 3.0


def angular_speed(
    times_s: Float[np.ndarray, " t"],
    rotation: Float[np.ndarray, "t 3 3"],
    at_s: Float[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Angle turned over `SPAN_S` about each instant, per second; NaN outside and over gaps."""
    known = np.isfinite(rotation).all((1, 2))
    own = times_s[known]
    speed = np.full(len(at_s), np.nan)
    if len(own) < 2:
        return speed
    before, after = at_s - SPAN_S / 2, at_s + SPAN_S / 2
    inside = (before >= own[0]) & (after <= own[-1])
    next_ = np.clip(np.searchsorted(own, at_s), 1, len(own) - 1)
    inside &= own[next_] - own[next_ - 1] <= SPAN_S
    if inside.any():
        turn = Slerp(own, Rotation.from_matrix(rotation[known]))
        between = turn(before[inside]).inv() * turn(after[inside])
        speed[inside] = between.magnitude() / SPAN_S
    return speed


def correlation(first: Float[np.ndarray, " n"], second: Float[np.ndarray, " n"]) -> float:
    """Pearson's, where both are known; 0 where fewer than 20 instants are or one is constant."""
    known = np.isfinite(first) & np.isfinite(second)
    if known.sum() < 20:
        return 0.0
    a, b = first[known] - first[known].mean(), second[known] - second[known].mean()
    size = np.linalg.norm(a) * np.linalg.norm(b)
    return float(a @ b / size) if size > 1e-9 else 0.0


def lag_s(
    reference: ReferenceMotion, bones: list[int], tracks: list[ImuTrack]
) -> tuple[float, float, float]:
    """By how much the sensors' times are late [s], and the mean correlation there and at 0.

    The lag that all sensors of a subject share: the mean over sensors of the correlation between
    a sensor's speed and its bone's, up to `MAX_LAG_S` either way.
    """
    grid = np.arange(reference.times_s[0], reference.times_s[-1], 1 / LAG_RATE_HZ)
    steps = np.arange(-int(MAX_LAG_S * LAG_RATE_HZ), int(MAX_LAG_S * LAG_RATE_HZ) + 1)
    total, counted = np.zeros(len(steps)), 0
    around = np.arange(
        grid[0] - MAX_LAG_S, grid[-1] + MAX_LAG_S + 0.5 / LAG_RATE_HZ, 1 / LAG_RATE_HZ
    )
    for bone, track in zip(bones, tracks, strict=True):
        seen = angular_speed(reference.times_s, reference.rotation_in_world[:, bone], grid)
        worn = angular_speed(track.times_s, from_wxyz(track.orientation_wxyz).as_matrix(), around)
        if np.isfinite(seen).sum() < MIN_OVERLAP_S * LAG_RATE_HZ:
            continue
        total += _correlations(seen, worn, len(steps))
        counted += 1
    if not counted:
        return 0.0, 0.0, 0.0
    total /= counted
    best = int(np.argmax(total))
    return float(steps[best] / LAG_RATE_HZ), float(total[best]), float(total[len(steps) // 2])


def _correlations(
    seen: Float[np.ndarray, " n"], worn: Float[np.ndarray, " m"], count: int
) -> Float[np.ndarray, " s"]:
    """Pearson's for every shift of `seen` along `worn`, over what overlaps; 0 where that is short.

    By sums of products over masked arrays, each a convolution.
    """
    from scipy.signal import correlate

    mask_a, mask_b = np.isfinite(seen).astype(float), np.isfinite(worn).astype(float)
    # Speeds are skewed; their roots weigh quick moments less.
    a, b = np.sqrt(np.nan_to_num(seen)), np.sqrt(np.nan_to_num(worn))

    def sums(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return correlate(y, x, mode="valid", method="fft")[:count]

    n = np.maximum(sums(mask_a, mask_b), 1e-9)
    mean_a, mean_b = sums(a, mask_b) / n, sums(mask_a, b) / n
    covariance = sums(a, b) / n - mean_a * mean_b
    variance_a = np.maximum(sums(a * a, mask_b) / n - mean_a**2, 0.0)
    variance_b = np.maximum(sums(mask_a, b * b) / n - mean_b**2, 0.0)
    result = covariance / np.maximum(np.sqrt(variance_a * variance_b), 1e-6)
    enough = max(MIN_OVERLAP_S * LAG_RATE_HZ, 0.5 * mask_a.sum())
    result[n < enough] = 0.0
    return np.pad(result, (0, count - len(result)))
