"""All sensors of one subject, from motion that something else saw.

1. Clocks are checked: the lag at which angular speeds agree best must be zero.
2. Every sensor is fitted alone (`fusecap.calibrate.imus.fit`), its heading free.
3. Sensors that were reset together share their world: the headings' common value and spread,
   measured on the sensors that observe theirs, are a prior for all in a second fit. A trunk that
   stays upright cannot tell its sensor's heading from its mounting; the arms and legs can.
4. Sensors on other bones than stated, and sensors that slipped, are named.
5. Where landmarks are known, the others are fitted together
   (`fusecap.calibrate.imus.joint_centres`).
6. Each stretch of time is left out once (`FOLDS` interleaved parts), and the residual taken there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from fusecap.calibrate.imus.changes import find_change
from fusecap.calibrate.imus.checks import (
    Worn,
    check_reference,
    checked_lag,
    sensor_rotations,
    why_unusable,
)
from fusecap.calibrate.imus.fit import (
    FREE,
    Fit,
    HeadingPrior,
    Pairs,
    fit,
    make_pairs,
    with_known_pose,
)
from fusecap.calibrate.imus.identify import Identity, identify
from fusecap.calibrate.imus.joint_centres import SeenLandmarks, fit_together, held_back
from fusecap.calibrate.imus.reference import ReferenceMotion
from fusecap.calibrate.imus.sensor_report import (
    FOLDS,
    SensorCalibration,
    SensorFits,
    sensor_calibration,
)
from fusecap.calibrate.imus.tpose import TPOSE_SIGMA_RAD
from fusecap.errors import InputError
from fusecap.progress import Progress

SPREAD_RAD = np.radians(5.0)
"""Least standard deviation of sensors' headings about their common one."""


Mask = Callable[[np.ndarray], np.ndarray]
"""From stretches of time to which of them count."""


@dataclass(frozen=True, kw_only=True)
class Skipped:
    """A sensor that could not be calibrated, and why."""

    subject: str
    bone: str
    file: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class SubjectCalibration:
    """All sensors of one subject."""

    subject: str
    duration_s: float
    lag_s: float
    speed_correlation: float
    sensors: tuple[SensorCalibration, ...]
    skipped: tuple[Skipped, ...]
    series: tuple[tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]], ...]
    """Per sensor times [s] and residuals [deg], held out, for the picture."""


def calibrate_subject(
    reference: ReferenceMotion,
    worn: Sequence[Worn],
    seen: SeenLandmarks | None = None,
    progress: Progress | None = None,
) -> SubjectCalibration:
    """All steps; raises `InputError` where nothing was seen of the subject or clocks disagree."""
    check_reference(reference)
    rotations = sensor_rotations(worn, reference.times_s)
    usable, skipped = [], []
    for each, rotation in zip(worn, rotations, strict=True):
        reason = why_unusable(reference, each, rotation)
        if reason:
            skipped.append(
                Skipped(
                    subject=reference.subject,
                    bone=each.settings.bone,
                    file=each.settings.source_name,
                    reason=reason,
                )
            )
        else:
            usable.append((each, rotation))
    kept = [each for each, _ in usable]
    late_s, correlated = checked_lag(reference, kept)
    pairs = [_pairs(reference, each, rotation) for each, rotation in usable]
    priors = _heading_priors([fit(some) for some in pairs])
    identities: tuple[Identity | None, ...] = (None,) * len(kept)
    if len(kept) > 1:
        stated = [each.settings.bone for each in kept]
        identities = identify(
            reference, stated, np.array([rotation for _, rotation in usable]), among=()
        )
    alone = [fit(some, prior) for some, prior in zip(pairs, priors, strict=True)]
    changes = [find_change(some, fitted) for some, fitted in zip(pairs, alone, strict=True)]
    sound = [
        change is None and (identity is None or not identity.contradicts)
        for change, identity in zip(changes, identities, strict=True)
    ]
    fitted = _Together(reference, kept, pairs, priors, sound, seen, progress).fits(alone)
    sensors, series = [], []
    for index, each in enumerate(kept):
        sensor, drawn = sensor_calibration(
            reference,
            each,
            pairs[index],
            priors[index],
            fitted[index],
            identities[index],
            changes[index],
        )
        sensors.append(sensor)
        series.append(drawn)
    return SubjectCalibration(
        subject=reference.subject,
        duration_s=reference.duration_s,
        lag_s=late_s,
        speed_correlation=correlated,
        sensors=tuple(sensors),
        skipped=tuple(skipped),
        series=tuple(series),
    )


def identify_subject(reference: ReferenceMotion, worn: Sequence[Worn]) -> tuple[Identity, ...]:
    """Which sensor is on which bone, whatever the session states."""
    check_reference(reference)
    rotations = sensor_rotations(worn, reference.times_s)
    for each, rotation in zip(worn, rotations, strict=True):
        reason = why_unusable(reference, each, rotation)
        if reason:
            raise InputError(f"imu '{each.settings.bone}' of '{reference.subject}': {reason}")
    return identify(reference, [each.settings.bone for each in worn], rotations)


def _pairs(reference: ReferenceMotion, worn: Worn, rotation: Float[np.ndarray, "t 3 3"]) -> Pairs:
    bone = reference.skeleton.bone(worn.settings.bone)
    pairs = make_pairs(
        reference.times_s,
        reference.rotation_in_world[:, bone],
        reference.covariance_rad2[:, bone],
        rotation,
    )
    if worn.tpose is None or worn.tpose.complaints:
        return pairs
    return with_known_pose(
        pairs,
        worn.tpose.bone_in_world,
        worn.tpose.sensor_in_imu_world,
        worn.tpose.time_s,
        TPOSE_SIGMA_RAD,
    )


def _heading_priors(free: Sequence[Fit]) -> list[HeadingPrior]:
    """For each sensor what the others say; no prior for fewer than four sensors."""
    heading = np.array([each.heading_rad for each in free])
    variance = np.array([each.covariance[3, 3] for each in free])
    priors = []
    for own in range(len(free)):
        others = [index for index in range(len(free)) if index != own]
        if len(others) < 3:
            priors.append(FREE)
            continue
        weight = 1.0 / (variance[others] + SPREAD_RAD**2)
        common = _robust_mean(heading[others], weight)
        away = np.abs(np.angle(np.exp(1j * (heading[others] - common))))
        order = np.argsort(away)
        half = int(np.searchsorted(np.cumsum(weight[order]), weight.sum() / 2))
        excess = (1.4826 * away[order][half]) ** 2 - float(np.min(variance[others]))
        spread = np.sqrt(max(excess, SPREAD_RAD**2))
        priors.append(HeadingPrior(mean_rad=common, sigma_rad=float(spread)))
    return priors


def _robust_mean(angle_rad: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"]) -> float:
    """The mean within 20 deg of that angle which the others are, in sum, nearest to."""
    away = np.abs(np.angle(np.exp(1j * (angle_rad[:, None] - angle_rad[None]))))
    middle = angle_rad[int(np.argmin(away @ weight))]
    apart = np.angle(np.exp(1j * (angle_rad - middle)))
    near = np.abs(apart) < np.radians(20.0)
    return float(middle + np.average(apart[near], weights=weight[near]))


def _not_in_fold(block: np.ndarray, fold: int) -> np.ndarray:
    return block % FOLDS != fold


def _in_half(block: np.ndarray, half: int) -> np.ndarray:
    return block % 2 == half


class _Together:
    """Fits of all sensors; those that are sound hold each other where landmarks are known."""

    def __init__(
        self,
        reference: ReferenceMotion,
        worn: Sequence[Worn],
        pairs: Sequence[Pairs],
        priors: Sequence[HeadingPrior],
        sound: Sequence[bool],
        seen: SeenLandmarks | None,
        progress: Progress | None,
    ) -> None:
        self._reference = reference
        self._bones = [reference.skeleton.bone(each.settings.bone) for each in worn]
        self._pairs = pairs
        self._priors = priors
        self._sound = sound
        self._seen = seen
        self._progress = progress or (lambda what, done, total: None)
        if seen is not None:
            self._sensors = sensor_rotations(worn, seen.times_s)

    def fits(self, alone: Sequence[Fit]) -> list[SensorFits]:
        """Of all sensors, from where each was fitted alone."""
        masks: list[Mask] = [partial(_not_in_fold, fold=fold) for fold in range(FOLDS)]
        masks += [partial(_in_half, half=half) for half in (0, 1)]
        whole = self._joined(alone, None)
        parts: list[list[Fit | None]] = []
        what = f"sensors of {self._reference.subject}"
        for number, mask in enumerate(masks):
            self._progress(what, number + 1, len(masks) + 1)
            first: list[Fit | None] = []
            for some, prior in zip(self._pairs, self._priors, strict=True):
                left = some.where(mask(some.block))
                enough = (left.block >= 0).sum() >= 3
                first.append(fit(left, prior) if enough else None)
            parts.append(self._joined(first, mask, whole))
        self._progress(what, len(masks) + 1, len(masks) + 1)
        result = []
        for index, fitted in enumerate(whole):
            assert fitted is not None
            even, odd = parts[FOLDS][index], parts[FOLDS + 1][index]
            result.append(
                SensorFits(
                    whole=fitted,
                    folds=tuple(part[index] for part in parts[:FOLDS]),
                    halves=(even or fitted, odd or fitted),
                )
            )
        return result

    def _joined(
        self,
        alone: Sequence[Fit | None],
        mask: Mask | None,
        near: Sequence[Fit | None] | None = None,
    ) -> list[Fit | None]:
        """The given fits, those of sound sensors replaced; `mask` chooses stretches.

        The search starts at the fits, or at those of `near`.
        """
        result = list(alone)
        group = [
            index for index, each in enumerate(alone) if each is not None and self._sound[index]
        ]
        if self._seen is None or not group:
            return result
        pairs, use = [self._pairs[index] for index in group], None
        if mask is not None:
            use = mask(held_back(self._seen.times_s, pairs[0]))
            pairs = [some.where(mask(some.block)) for some in pairs]
        found = fit_together(
            self._reference.skeleton,
            self._seen,
            [self._bones[index] for index in group],
            self._sensors[group],
            pairs,
            [each for index in group if (each := (near or alone)[index]) is not None],
            use=use,
        )
        for index, fitted in zip(group, found, strict=True):
            result[index] = fitted
        return result
