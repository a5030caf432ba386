"""Where a detector's keypoints lie on the body: landmark offsets, eq. 17-18 of the paper.

Per instant, person and landmark the keypoints of all views are triangulated (eq. 17, confidence-
weighted and robust: `fusecap.geometry.triangulation`) and brought into the frame of the landmark's
bone by a known pose (eq. 18). The offset is the median of each axis. Samples are divided by the
person's stature before they are pooled, so that one table serves everyone.

**With truth** the pose comes from a take that something better than the keypoints has made. Every
axis of every landmark is observed, and nothing is assumed.

**Without truth** (`self_calibrate`) the pose comes from a solve that itself followed the keypoints:

    solve with the offsets  ->  eq. 17-18 with the solved poses  ->  new offsets  ->  solve ...

A solve pulls the bones to the keypoints, so eq. 18 then shows only what pose, bone lengths, prior
and IMUs could not absorb of a wrong offset; each round recovers more of it. Some of it none can
see: all landmarks moved alike are a moved person, and knees moved along the thighs are longer
thighs. Left alone, such directions drift with every round. Two things hold them:

- *Prior.* Every round keeps only a share of what it finds away from the defaults: the posterior
  mean under a normal prior about them (`JOINT_SIGMA`, `SURFACE_SIGMA`) and samples that scatter by
  s but are worth only `INDEPENDENT` of them, for a detector errs alike for seconds and a loose
  camera throughout. An offset that shows a residual against its pose settles where the pull of the
  default, growing with the distance, equals it; one that poses absorb shows none and goes back. No
  offset leaves its default by more than `MAX_MOVE`.
- *Symmetry.* Left and right share one offset, mirrored; landmarks of the middle have no sideways
  part.

Rounds end when offsets move by less than `CONVERGED` in the mean, when the reprojection error of
the instants they are measured on no longer falls (the offsets of the best round are kept), or after
`MAX_ROUNDS`.

A worked number: samples that scatter by s = 15 mm about a knee weigh 15²/10 = 22 mm² against the
prior's 12² = 150 mm² (1.75 m stature): a round keeps 87 %. With the 45 mm of cameras that are
calibrated loosely it keeps 43 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.batch.solve import SessionInstants, solve_instants
from fusecap.body.landmarks import LANDMARKS, LandmarkOffsets, LandmarkSet
from fusecap.calibrate.offset_samples import (
    MIN_SAMPLES,
    OffsetSamples,
    measure_offsets,
    reprojection_error_px,
)
from fusecap.calibrate.verdict import Verdict
from fusecap.errors import InputError
from fusecap.evaluate.metrics import Summary
from fusecap.geometry.camera import Rig
from fusecap.progress import Progress
from fusecap.setup import setup_of
from fusecap.sources.session_data import SessionData
from fusecap.take import Take
from fusecap.types import Detections

JOINT_SIGMA, SURFACE_SIGMA = 0.007, 0.010
"""Self-calibration: prior standard deviation per axis of offsets from their defaults, in statures
(12 and 17 mm)."""
INDEPENDENT = 10
"""Self-calibration: of a landmark's samples, those whose errors count as independent."""
MAX_MOVE = 0.035
"""Self-calibration: of an offset per axis from its default, in statures (6 cm)."""
IMPROVES = 0.995
"""Self-calibration: a round must bring the median reprojection error to this share or less."""
CONVERGED = 2e-4
"""Self-calibration: mean step of an offset, in statures (0.35 mm), below which rounds end."""
MAX_ROUNDS = 8
HELD_OUT_SHARE = 0.25
"""Of a session's instants: its last ones, which check what the others calibrated."""

_JOINTS = [
    f"{side}_{joint}"
    for side in ("left", "right")
    for joint in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
_ROUND_SAMPLES = 400
"""Instants measured per round; more do not move the medians."""

Solve = Callable[[LandmarkSet], Take]
"""A solve of the same instants with the given landmarks."""


@dataclass(frozen=True, kw_only=True)
class OffsetRow:
    """One landmark of the report; x left, y up, z forward in the bone's frame at rest."""

    landmark: str
    bone: str
    fraction: tuple[float, float, float]
    """Calibrated offset over stature; the default where too few samples were found."""
    offset_mm: tuple[float, float, float]
    """The same for the mean stature of the subjects."""
    moved_mm: float
    """Distance from the default."""
    mad_mm: tuple[float, float, float]
    samples: int


@dataclass(frozen=True, kw_only=True)
class OffsetCalibration:
    """Calibrated landmarks and what is known about them."""

    landmarks: LandmarkSet
    rows: tuple[OffsetRow, ...]
    with_truth: bool
    step_mm: tuple[float, ...]
    """Self-calibration: mean step of an offset per round that was kept."""
    converged: bool
    person_frames: int
    held_out_before_px: Summary
    """Distance of keypoints from the projected landmarks on instants that were not used, with the
    offsets that the session had."""
    held_out_after_px: Summary

    @property
    def verdict(self) -> Verdict:
        """Poor where held-out instants are not explained better, usable where rounds ran out."""
        if not self.held_out_after_px.median < self.held_out_before_px.median:
            return Verdict.POOR
        return Verdict.GOOD if self.converged else Verdict.USABLE

    @property
    def advice(self) -> tuple[str, ...]:
        """What keeps it from being good."""
        said = []
        if self.verdict is Verdict.POOR:
            said.append(
                "the held-out instants are not explained better than before; do not use these"
            )
        if not self.converged:
            said.append(f"the last round still moved offsets by {self.step_mm[-1]:.1f} mm")
        return tuple(said)


def calibrate_session(
    data: SessionData,
    truth: Take | None = None,
    *,
    per_subject: bool = False,
    progress: Progress | None = None,
) -> OffsetCalibration:
    """Offsets from the first three quarters of a session, checked on the rest.

    With `truth`, its poses are used throughout. Without, instants are solved, and the check solves
    the session with the old and with the new offsets. Raises `InputError` where the session
    has fewer than two cameras or nobody can be measured.
    """
    if data.landmarks is None or len(data.rig) < 2:
        raise InputError(
            f"{data.session.path}: landmark offsets need two cameras or more, found {len(data.rig)}"
        )
    rig, landmarks = data.rig, data.landmarks
    instants = len(data.times_s)
    trained = instants - round(HELD_OUT_SHARE * instants)
    if trained < MIN_SAMPLES:
        raise InputError(
            f"{data.session.path}: {instants} instants; calibrating landmark offsets needs "
            f"{round(MIN_SAMPLES / (1 - HELD_OUT_SHARE))} or more"
        )
    train = [data.detections(instant) for instant in range(trained)]
    held_out = [data.detections(instant) for instant in range(trained, instants)]

    def solve(landmarks: LandmarkSet, end: int) -> Take:
        setup = setup_of(data.session, data.rig, landmarks)
        return solve_instants(setup, SessionInstants(data, 0, end), progress=progress).whole_take

    if truth is not None:
        samples = measure_offsets(rig, landmarks, truth, train)
        if not len(samples.person):
            raise InputError(
                "no keypoints match the people of the truth; check that it belongs to this "
                f"session ({data.session.path}) and that the clocks agree"
            )
        found = FoundOffsets(
            landmarks=landmarks.calibrated(median_offsets(landmarks, samples, per_subject)),
            samples=samples,
            steps=(),
            error_px=(),
            converged=True,
        )
        before = after = truth
    else:
        found = self_calibrate(
            lambda landmarks: solve(landmarks, trained),
            rig,
            landmarks,
            train,
            per_subject=per_subject,
        )
        before = solve(landmarks, instants)
        after = solve(found.landmarks, instants)
    height_m = float(np.mean(before.heights_m)) if len(before.heights_m) else 0.0
    return OffsetCalibration(
        landmarks=found.landmarks,
        rows=report_rows(found.landmarks, found.samples, height_m),
        with_truth=truth is not None,
        step_mm=tuple(1e3 * height_m * step for step in found.steps),
        converged=found.converged,
        person_frames=len(found.samples.person),
        held_out_before_px=reprojection_error_px(rig, landmarks, before, held_out),
        held_out_after_px=reprojection_error_px(rig, found.landmarks, after, held_out),
    )


def origin(found: OffsetCalibration, truth: Path | None) -> str:
    """One line for the file: how the offsets came about."""
    source = f"with the truth of {truth.name}" if truth else f"in {len(found.step_mm)} rounds"
    return f"eq. 17-18 {source}, {found.person_frames} person-frames"


@dataclass(frozen=True, kw_only=True)
class FoundOffsets:
    """Calibrated landmarks, the last samples, and the rounds' mean steps in statures."""

    landmarks: LandmarkSet
    samples: OffsetSamples
    steps: tuple[float, ...]
    error_px: tuple[float, ...]
    """Median reprojection error before the first round and after each."""
    converged: bool


def self_calibrate(
    solve: Solve,
    rig: Rig,
    landmarks: LandmarkSet,
    detections: Sequence[Detections],
    *,
    per_subject: bool = False,
) -> FoundOffsets:
    """Alternate `solve` and eq. 17-18; starts from `landmarks`, pulled to the defaults.

    Raises `InputError` when nobody is found or triangulated.
    """
    rows = detections[:: max(1, len(detections) // _ROUND_SAMPLES)]
    take = solve(landmarks)
    error_px = [reprojection_error_px(rig, landmarks, take, rows).median]
    samples = measure_offsets(rig, landmarks, take, rows)
    if not (samples.count >= MIN_SAMPLES).any():
        raise InputError(
            "too few landmarks were triangulated to calibrate their offsets; look at the session "
            "with: fusecap doctor"
        )
    steps: list[float] = []
    converged = False
    while len(steps) < MAX_ROUNDS and not converged:
        offsets = median_offsets(landmarks, samples, per_subject, damped=True)
        new = landmarks.calibrated(offsets)
        step = _mean_step(landmarks, new, samples.subjects if per_subject else ("",))
        take = solve(new)
        error = reprojection_error_px(rig, new, take, rows).median
        converged = step <= CONVERGED or not error <= IMPROVES * error_px[-1]
        if error <= error_px[-1]:
            landmarks, samples = new, measure_offsets(rig, new, take, rows)
            steps.append(step)
            error_px.append(error)
    return FoundOffsets(
        landmarks=landmarks,
        samples=samples,
        steps=tuple(steps),
        error_px=tuple(error_px),
        converged=converged,
    )


def median_offsets(
    landmarks: LandmarkSet,
    samples: OffsetSamples,
    per_subject: bool = False,
    *,
    damped: bool = False,
) -> LandmarkOffsets:
    """Offsets at the samples' medians, for everyone or also for each subject.

    Landmarks with too few samples keep what `landmarks` has. `damped` is self-calibration's step:
    mirrored, and pulled to the defaults.
    """

    def place(samples: OffsetSamples, known: LandmarkSet) -> dict[str, tuple[float, float, float]]:
        median = samples.median
        found = np.where(np.isfinite(median), median, known.fractions)
        found = _damped(landmarks, found, samples.mad) if damped else found
        return {
            name: (float(x), float(y), float(z))
            for name, (x, y, z) in zip(landmarks.landmark_names, found, strict=True)
        }

    subjects = samples.subjects if per_subject else ()
    return LandmarkOffsets(
        everyone=place(samples, landmarks),
        subjects={name: place(samples.of(name), landmarks.of(name)) for name in subjects},
    )


def report_rows(
    landmarks: LandmarkSet, samples: OffsetSamples, height_m: float
) -> tuple[OffsetRow, ...]:
    """Everyone's offsets, landmark by landmark, for a body of this stature."""
    to_mm = 1e3 * height_m
    rows = []
    for index, name in enumerate(landmarks.landmark_names):
        bone, default = LANDMARKS[name]
        fraction = landmarks.fractions[index]
        rows.append(
            OffsetRow(
                landmark=name,
                bone=bone,
                fraction=_triple(fraction),
                offset_mm=_triple(fraction * to_mm),
                moved_mm=float(np.linalg.norm(fraction - default)) * to_mm,
                mad_mm=_triple(samples.mad[index] * to_mm),
                samples=int(samples.count[index]),
            )
        )
    return tuple(rows)


def _damped(
    landmarks: LandmarkSet, found: Float[np.ndarray, "k 3"], mad: Float[np.ndarray, "k 3"]
) -> Float[np.ndarray, "k 3"]:
    """The posterior mean, mirrored; all in statures."""
    default = landmarks.calibrated(None).fractions
    moved = found - default
    moved = (moved + moved[landmarks.mirror] * [-1.0, 1.0, 1.0]) / 2
    joint = np.isin(landmarks.landmark_names, _JOINTS)
    prior = np.where(joint, JOINT_SIGMA, SURFACE_SIGMA)[:, None] ** 2
    scatter = (1.4826 * np.nan_to_num((mad + mad[landmarks.mirror]) / 2, nan=1.0)) ** 2
    kept = prior / (prior + scatter / INDEPENDENT)
    return default + np.clip(kept * moved, -MAX_MOVE, MAX_MOVE)


def _mean_step(old: LandmarkSet, new: LandmarkSet, subjects: Sequence[str]) -> float:
    steps = [new.of(name).fractions - old.of(name).fractions for name in subjects]
    return float(np.linalg.norm(np.array(steps), axis=-1).mean())


def _triple(values: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
