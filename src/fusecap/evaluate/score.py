"""A take against the truth it should have found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.errors import TakeError
from fusecap.evaluate.metrics import (
    Summary,
    acceleration_error_m_s2,
    aligned_error_m,
    aligned_orientation_error_rad,
    axial_error_rad,
    false_tracks,
    foot_contact,
    foot_skate_m_s,
    identity_switches,
    idf1,
    jitter_m_s3,
    long_axes,
    match_people,
    missed_tracks,
    orientation_error_rad,
    position_error_m,
    root_relative_error_m,
    standing_heights_m,
    summarize,
)
from fusecap.take import Take

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
    aligned_orientation_error_deg: Summary
    """Once each frame is turned as Procrustes turns its joints."""
    axial_error_deg: Summary
    """Twist about the bones' long axes, which joint positions do not show."""
    bone_position_error_mm: dict[str, float]
    """Mean per bone."""
    bone_orientation_error_deg: dict[str, float]
    bone_axial_error_deg: dict[str, float]
    bone_orientation_variance_ratio: dict[str, float]
    """Per bone its mean squared error over its mean variance, as the take has it; NaN where that is
    none. 1: the error bars are true."""
    bone_position_variance_ratio: dict[str, float]
    acceleration_error_m_s2: float
    """Mean over joints and frames."""
    jitter_km_s3: float
    """Mean jerk of the joints; compare with that of the truth."""
    true_jitter_km_s3: float
    foot_skate_m_s: float
    """Mean horizontal speed of ankles and toes while the truth has them on the floor."""
    true_foot_skate_m_s: float
    contact_share: float
    """Of the true ankles' and toes' frames, those on the floor."""
    found_share: float
    """Of the true person-frames, those that an estimate matched."""
    extra_share: float
    """Of the estimated person-frames, those that are nobody's."""
    identity_switches: int
    idf1: float
    missed_tracks: int
    """True people found in less than a fifth of their frames."""
    false_tracks: int
    """Estimated people who were nobody in more than four fifths of theirs."""
    subjects: int
    """Estimated ones that were tracked at all."""


def main_figures(score: TakeScore) -> dict[str, float]:
    """Means of the errors and of how it moves, by names with units, for `--json`."""
    return {
        "position_error_mm": score.position_error_mm.mean,
        "orientation_error_deg": score.orientation_error_deg.mean,
        "acceleration_error_m_s2": score.acceleration_error_m_s2,
        "jitter_km_s3": score.jitter_km_s3,
        "true_jitter_km_s3": score.true_jitter_km_s3,
        "foot_skate_m_s": score.foot_skate_m_s,
        "true_foot_skate_m_s": score.true_foot_skate_m_s,
    }


def score_take(take: Take, truth: Take, *, gate_m: float = 0.5) -> TakeScore:
    """Score the frames that both takes have; people are matched frame by frame, by distance."""
    if take.bone_names != truth.bone_names:
        raise TakeError("the take and its truth have different skeletons")
    rows, true_rows = same_instants(take.timestamps_ns, truth.timestamps_ns)
    if len(rows) == 0:
        raise TakeError("the take and its truth share no timestamp")
    position = take.bone_position_in_world_m[:, rows]
    true_position = truth.bone_position_in_world_m[:, true_rows]
    match = match_people(position, true_position, gate_m=gate_m)
    person, frame = np.nonzero(match >= 0)
    found = match[person, frame]
    x, y = position[found, frame], true_position[person, frame]
    rotation = _rotations(take)[found, rows[frame]]
    true_rotation = _rotations(truth)[person, true_rows[frame]]
    position_mm = position_error_m(x, y) * 1e3
    orientation_deg = np.degrees(orientation_error_rad(rotation, true_rotation))
    aligned_deg = np.degrees(aligned_orientation_error_rad(rotation, true_rotation, x, y))
    axial_deg = _axial_error_deg(truth, person, rotation, true_rotation)
    tracked, true_tracked = take.tracked[:, rows], truth.tracked[:, true_rows]
    return TakeScore(
        position_error_mm=summarize(position_mm),
        root_relative_error_mm=summarize(root_relative_error_m(x, y) * 1e3),
        aligned_error_mm=summarize(aligned_error_m(x, y) * 1e3),
        orientation_error_deg=summarize(orientation_deg),
        aligned_orientation_error_deg=summarize(aligned_deg),
        axial_error_deg=summarize(axial_deg),
        bone_position_error_mm=_per_bone(take, position_mm),
        bone_orientation_error_deg=_per_bone(take, orientation_deg),
        bone_axial_error_deg=_per_bone(take, axial_deg),
        bone_orientation_variance_ratio=_ratio(
            take, orientation_deg, take.bone_sigma_deg[found, rows[frame]]
        ),
        bone_position_variance_ratio=_ratio(
            take, position_mm, 1e3 * take.position_sigma_m[found, rows[frame]]
        ),
        **_motion(truth, _in_place_of(match, position), true_position),
        found_share=len(found) / int(true_tracked.sum()) if true_tracked.any() else np.nan,
        extra_share=1 - len(found) / int(tracked.sum()) if tracked.any() else 0.0,
        identity_switches=identity_switches(match),
        idf1=idf1(position, true_position, gate_m=gate_m),
        missed_tracks=missed_tracks(match, true_tracked),
        false_tracks=false_tracks(match, tracked),
        subjects=int(take.tracked.any(axis=1).sum()),
    )


def _axial_error_deg(
    truth: Take,
    person: Int[np.ndarray, " n"],
    rotation: Float[np.ndarray, "n b 3 3"],
    true_rotation: Float[np.ndarray, "n b 3 3"],
) -> Float[np.ndarray, "n b"]:
    """Axial errors of people of different shapes."""
    error = np.empty(rotation.shape[:2])
    for subject in range(len(truth.subject_names)):
        rows = person == subject
        axes = long_axes(truth.shape(subject))
        error[rows] = np.degrees(axial_error_rad(rotation[rows], true_rotation[rows], axes))
    return error


def _in_place_of(
    match: Int[np.ndarray, "g t"], position: Float[np.ndarray, "e t j 3"]
) -> Float[np.ndarray, "g t j 3"]:
    """The estimated joints in the order of the true people; NaN where unmatched."""
    estimate = np.full((*match.shape, *position.shape[2:]), np.nan)
    person, frame = np.nonzero(match >= 0)
    estimate[person, frame] = position[match[person, frame], frame]
    return estimate


def _motion(
    truth: Take, estimate: Float[np.ndarray, "g t j 3"], true_position: Float[np.ndarray, "g t j 3"]
) -> dict[str, float]:
    """Means of the errors of the motion; over the same frames for the estimate and the truth."""
    rate_hz = truth.rate_hz
    seen = np.where(np.isfinite(estimate), true_position, np.nan)
    feet = [bone for bone, name in enumerate(truth.bone_names) if name.endswith(("_foot", "_toes"))]
    contact = np.zeros((*estimate.shape[:2], len(feet)), dtype=bool)
    for subject in range(len(truth.subject_names)):
        rest_m = standing_heights_m(truth.shape(subject))[feet]
        contact[subject] = foot_contact(seen[subject][:, feet], rest_m, rate_hz)
    return {
        "acceleration_error_m_s2": summarize(acceleration_error_m_s2(estimate, seen, rate_hz)).mean,
        "jitter_km_s3": summarize(jitter_m_s3(estimate, rate_hz)).mean * 1e-3,
        "true_jitter_km_s3": summarize(jitter_m_s3(seen, rate_hz)).mean * 1e-3,
        "foot_skate_m_s": summarize(foot_skate_m_s(estimate[:, :, feet], contact, rate_hz)).mean,
        "true_foot_skate_m_s": summarize(foot_skate_m_s(seen[:, :, feet], contact, rate_hz)).mean,
        "contact_share": float(contact.mean()) if contact.size else np.nan,
    }


def same_instants(
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
    rotation = np.full((*take.bone_sigma_deg.shape, 3, 3), np.nan)
    for subject in range(len(rotation)):
        rotation[subject] = take.bone_rotation_in_world(subject)
    return rotation


def _ratio(
    take: Take, errors: Float[np.ndarray, "n b"], sigma: Float[np.ndarray, "n b"]
) -> dict[str, float]:
    variance = np.square(sigma).sum(axis=0)
    ratio = np.full(len(take.bone_names), np.nan)
    np.divide(np.square(errors).sum(axis=0), variance, out=ratio, where=variance > 0)
    return dict(zip(take.bone_names, ratio.tolist(), strict=True))


def _per_bone(take: Take, errors: np.ndarray) -> dict[str, float]:
    mean = errors.mean(axis=0) if len(errors) else np.full(len(take.bone_names), np.nan)
    return dict(zip(take.bone_names, mean.tolist(), strict=True))
