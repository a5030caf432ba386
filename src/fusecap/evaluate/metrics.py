"""Errors of poses against truth, as the literature counts them.

Inside metres and radians; a report converts. NaN in an estimate or in the truth means "not there".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A distribution of errors in four numbers, over the values that are not NaN."""

    mean: float
    std: float
    median: float
    mad: float
    """Median absolute deviation from the median."""
    count: int

    def scaled(self, factor: float) -> Summary:
        """The same in another unit."""
        return Summary(
            mean=self.mean * factor,
            std=self.std * factor,
            median=self.median * factor,
            mad=self.mad * factor,
            count=self.count,
        )


def summarize(errors: Float[np.ndarray, "..."]) -> Summary:
    """Summary of `errors`; NaN throughout where there are none."""
    values = errors[np.isfinite(errors)]
    if len(values) == 0:
        return Summary(mean=np.nan, std=np.nan, median=np.nan, mad=np.nan, count=0)
    median = float(np.median(values))
    return Summary(
        mean=float(values.mean()),
        std=float(values.std()),
        median=median,
        mad=float(np.median(np.abs(values - median))),
        count=len(values),
    )


def position_error_m(
    estimate: Float[np.ndarray, "*n j 3"], truth: Float[np.ndarray, "*n j 3"]
) -> Float[np.ndarray, "*n j"]:
    """Distance of each joint, in the world: MPJPE is its mean."""
    return np.linalg.norm(estimate - truth, axis=-1)


def root_relative_error_m(
    estimate: Float[np.ndarray, "*n j 3"], truth: Float[np.ndarray, "*n j 3"]
) -> Float[np.ndarray, "*n j"]:
    """Distance of each joint once the first joints coincide."""
    return position_error_m(estimate - estimate[..., :1, :], truth - truth[..., :1, :])


def aligned_error_m(
    estimate: Float[np.ndarray, "t j 3"], truth: Float[np.ndarray, "t j 3"]
) -> Float[np.ndarray, "t j"]:
    """Distance of each joint after the best similarity of each frame: PA-MPJPE is its mean."""
    return position_error_m(procrustes(estimate, truth), truth)


def procrustes(
    estimate: Float[np.ndarray, "t j 3"], truth: Float[np.ndarray, "t j 3"]
) -> Float[np.ndarray, "t j 3"]:
    """Each frame of `estimate` scaled, turned and moved onto `truth`; never mirrored.

    Frames with NaN stay NaN.
    """
    aligned = np.full_like(estimate, np.nan)
    whole = np.isfinite(estimate).all(axis=(1, 2)) & np.isfinite(truth).all(axis=(1, 2))
    x, y = estimate[whole], truth[whole]
    x_mean, y_mean = x.mean(axis=1, keepdims=True), y.mean(axis=1, keepdims=True)
    x, y = x - x_mean, y - y_mean
    u, s, vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    s[:, 2] *= np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    scale = s.sum(axis=1) / np.maximum((x**2).sum(axis=(1, 2)), 1e-30)
    aligned[whole] = scale[:, None, None] * x @ np.swapaxes(u @ vt, 1, 2) + y_mean
    return aligned


def orientation_error_rad(
    estimate: Float[np.ndarray, "*n 3 3"], truth: Float[np.ndarray, "*n 3 3"]
) -> Float[np.ndarray, "*n"]:
    """Angle of the rotation between the two, from |A - B| = 2√2 sin(angle / 2)."""
    chord = np.linalg.norm(estimate - truth, axis=(-2, -1)) / (2 * np.sqrt(2))
    return 2 * np.arcsin(np.minimum(chord, 1.0))


def correct_limbs(
    estimate: Float[np.ndarray, "*n j 3"],
    truth: Float[np.ndarray, "*n j 3"],
    limbs: Int[np.ndarray, "l 2"],
) -> Bool[np.ndarray, "*n l"]:
    """3D PCP: which limbs' two end errors add up to less than the limb's length.

    A limb without an estimate is wrong; so is one without truth, which the caller leaves out.
    """
    error = position_error_m(estimate, truth)
    first, second = limbs[:, 0], limbs[:, 1]
    length = np.linalg.norm(truth[..., first, :] - truth[..., second, :], axis=-1)
    with np.errstate(invalid="ignore"):
        return error[..., first] + error[..., second] < length


def match_people(
    estimate: Float[np.ndarray, "e t j 3"],
    truth: Float[np.ndarray, "g t j 3"],
    *,
    gate_m: float = 0.5,
) -> Int[np.ndarray, "g t"]:
    """Per true person and frame the estimated one that is it, or -1.

    One to one, of least total mean joint distance; a pair farther apart than the gate is no pair.
    Joints that are NaN on either side do not count.
    """
    people, frames = truth.shape[:2]
    distance = _mean_distance_m(estimate, truth)
    match = np.full((people, frames), -1, dtype=np.int64)
    for frame in range(frames):
        near = np.isfinite(distance[:, :, frame]) & (distance[:, :, frame] <= gate_m)
        if not near.any():
            continue
        # A pair beyond the gate costs more than any set of pairs within it.
        cost = np.where(near, distance[:, :, frame], 1e3)
        for estimated, true in zip(*linear_sum_assignment(cost), strict=True):
            if near[estimated, true]:
                match[true, frame] = estimated
    return match


def _mean_distance_m(
    estimate: Float[np.ndarray, "e t j 3"], truth: Float[np.ndarray, "g t j 3"]
) -> Float[np.ndarray, "e g t"]:
    """Mean over the joints that both have; infinite where they share none."""
    distance = np.full((len(estimate), len(truth), truth.shape[1]), np.inf)
    for e, estimated in enumerate(estimate):
        for g, true in enumerate(truth):
            error = position_error_m(estimated, true)
            there = np.isfinite(error)
            count = there.sum(axis=1)
            mean = np.where(there, error, 0.0).sum(axis=1) / np.maximum(count, 1)
            distance[e, g] = np.where(count > 0, mean, np.inf)
    return distance


def identity_switches(match: Int[np.ndarray, "g t"]) -> int:
    """How often a true person is matched by another estimate than when last matched."""
    switches = 0
    for row in match:
        matched = row[row >= 0]
        switches += int((np.diff(matched) != 0).sum())
    return switches


def idf1(
    estimate: Float[np.ndarray, "e t j 3"],
    truth: Float[np.ndarray, "g t j 3"],
    *,
    gate_m: float = 0.5,
) -> float:
    """Share of detections that carry the right identity over the whole take (Ristani et al. 2016).

    2 IDTP / (estimated + true person-frames), for the best one-to-one pairing of whole tracks.
    """
    agree = (_mean_distance_m(estimate, truth) <= gate_m).sum(axis=2)
    pairs = linear_sum_assignment(agree, maximize=True)
    person_frames = sum(
        int(np.isfinite(people).all(axis=-1).any(axis=-1).sum()) for people in (estimate, truth)
    )
    return 2 * float(agree[pairs].sum()) / person_frames if person_frames else np.nan
