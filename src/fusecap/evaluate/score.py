"""A take against the truth it should have found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.errors import TakeError
from fusecap.evaluate.metrics import (
    Summary,
    aligned_error_m,
    identity_switches,
    idf1,
    match_people,
    orientation_error_rad,
    position_error_m,
    root_relative_error_m,
    summarize,
)
from fusecap.sinks.take import Take

SAME_INSTANT_NS = 1_000_000
"""Frames of a take and of its truth that are this close show one instant."""


@dataclass(frozen=True, kw_only=True)
class TakeScore:
    """Errors over all bones, frames and subjects that were found; what was not found is counted."""

    position_error_mm: Summary
    root_relative_error_mm: Summary
    aligned_error_mm: Summary
    """After Procrustes."""
    orientation_error_deg: Summary
    bone_position_error_mm: dict[str, float]
    """Mean per bone."""
    bone_orientation_error_deg: dict[str, float]
    found_share: float
    """Of the true person-frames, those that an estimate matched."""
    extra_share: float
    """Of the estimated person-frames, those that are nobody's."""
    identity_switches: int
    idf1: float
    subjects: int
    """Estimated ones that were tracked at all."""


def score_take(take: Take, truth: Take, *, gate_m: float = 0.5) -> TakeScore:
    """Score the frames that both takes have; people are matched frame by frame, by distance."""
    if take.bone_names != truth.bone_names:
        raise TakeError("the take and its truth have different skeletons")
    rows, true_rows = _same_instants(take.timestamps_ns, truth.timestamps_ns)
    if len(rows) == 0:
        raise TakeError("the take and its truth share no timestamp")
    position = take.bone_position_in_world_m[:, rows]
    true_position = truth.bone_position_in_world_m[:, true_rows]
    match = match_people(position, true_position, gate_m=gate_m)
    person, frame = np.nonzero(match >= 0)
    found = match[person, frame]
    x, y = position[found, frame], true_position[person, frame]
    position_mm = position_error_m(x, y) * 1e3
    orientation_deg = np.degrees(
        orientation_error_rad(
            _rotations(take)[found, rows[frame]], _rotations(truth)[person, true_rows[frame]]
        )
    )
    tracked = int(take.tracked[:, rows].sum())
    true_tracked = int(truth.tracked[:, true_rows].sum())
    return TakeScore(
        position_error_mm=summarize(position_mm),
        root_relative_error_mm=summarize(root_relative_error_m(x, y) * 1e3),
        aligned_error_mm=summarize(aligned_error_m(x, y) * 1e3),
        orientation_error_deg=summarize(orientation_deg),
        bone_position_error_mm=_per_bone(take, position_mm),
        bone_orientation_error_deg=_per_bone(take, orientation_deg),
        found_share=len(found) / true_tracked if true_tracked else np.nan,
        extra_share=1 - len(found) / tracked if tracked else 0.0,
        identity_switches=identity_switches(match),
        idf1=idf1(position, true_position, gate_m=gate_m),
        subjects=int(take.tracked.any(axis=1).sum()),
    )


def _same_instants(
    times_ns: Int[np.ndarray, " n"], true_times_ns: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Rows of both at the same time, but for the rounding of files."""
    if len(times_ns) == 0 or len(true_times_ns) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    between_ns = (true_times_ns[1:] + true_times_ns[:-1]) // 2
    nearest = np.searchsorted(between_ns, times_ns)
    same = np.abs(true_times_ns[nearest] - times_ns) <= SAME_INSTANT_NS
    return np.flatnonzero(same), nearest[same]


def _rotations(take: Take) -> Float[np.ndarray, "s t b 3 3"]:
    rotation = np.full((*take.bone_quality.shape, 3, 3), np.nan)
    for subject in range(len(rotation)):
        rotation[subject] = take.bone_rotation_in_world(subject)
    return rotation


def _per_bone(take: Take, errors: np.ndarray) -> dict[str, float]:
    mean = errors.mean(axis=0) if len(errors) else np.full(len(take.bone_names), np.nan)
    return dict(zip(take.bone_names, mean.tolist(), strict=True))
