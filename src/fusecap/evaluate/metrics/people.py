"""Who is who: matching, identity switches, IDF1, missed and false tracks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from fusecap.evaluate.metrics.pose import position_error_m

MOSTLY_LOST = 0.2
"""A track matched for less than this share of its frames is no match."""


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


def missed_tracks(match: Int[np.ndarray, "g t"], present: Bool[np.ndarray, "g t"]) -> int:
    """True people who were matched in less than a fifth of the frames that show them.

    "Mostly lost" of the multi-object tracking literature (Wu and Nevatia 2006); people who never
    appear do not count.
    """
    frames = present.sum(axis=1)
    found = ((match >= 0) & present).sum(axis=1)
    return int(((found < MOSTLY_LOST * frames) & (frames > 0)).sum())


def false_tracks(match: Int[np.ndarray, "g t"], tracked: Bool[np.ndarray, "e t"]) -> int:
    """Estimated people who were nobody in more than four fifths of the frames they were tracked."""
    frames = tracked.sum(axis=1)
    somebody = np.array([(match == estimated).sum() for estimated in range(len(tracked))])
    return int(((somebody < MOSTLY_LOST * frames) & (frames > 0)).sum())


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
