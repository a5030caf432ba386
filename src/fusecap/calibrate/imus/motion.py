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
from scipy.spatial.transform import Rotation

from fusecap.calibrate.imus.changes import Change, find_change
from fusecap.calibrate.imus.fit import (
    FREE,
    Fit,
    HeadingPrior,
    Pairs,
    fit,
    make_pairs,
    residual_rad,
    with_known_pose,
)
from fusecap.calibrate.imus.identify import Identity, identify
from fusecap.calibrate.imus.joint_centres import SeenLandmarks, fit_together, held_back
from fusecap.calibrate.imus.reference import ReferenceMotion
from fusecap.calibrate.imus.speeds import lag_s
from fusecap.calibrate.imus.tpose import TPOSE_SIGMA_RAD, TPose
from fusecap.errors import InputError
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings
from fusecap.sources.synchronizer import MountedImu, resample_imus, world_from_imu_world

FOLDS = 4
MIN_OVERLAP_S = 6.0
MAX_LAG_S = 0.1
"""Beyond it nothing sensible can be calibrated."""
MIN_LAG_GAIN = 0.1
"""In correlation, before another lag is believed."""
STILL_RAD = np.radians(2.0)
"""A sensor that never turns farther is not recording."""
SPREAD_RAD = np.radians(5.0)
"""Least standard deviation of sensors' headings about their common one."""
DRIFT_RAD_S = np.radians(3.0) / 60.0
"""Prior standard deviation of a heading's drift."""
POOR_DEG = 15.0
"""A held-out residual above this is not a calibration."""
LOOSE_DEG, UNOBSERVED_DEG = 8.0, 14.0
"""Uncertainty about an axis beyond which it is called so."""


Mask = Callable[[np.ndarray], np.ndarray]
"""From stretches of time to which of them count."""


@dataclass(frozen=True, kw_only=True)
class SensorCalibration:
    """One sensor's result; the residuals are angles about the axes that the reference observes."""

    subject: str
    bone: str
    file: str
    bone_from_imu_wxyz: tuple[float, float, float, float]
    heading_deg: float
    drift_deg_min: float
    drift_sigma_deg_min: float
    sigma_deg: tuple[float, float, float]
    """Of the bone's rotation as calibrated, about its x, y and z axis, over the poses seen."""
    heading_sigma_deg: float
    halves_deg: float
    """Between the bone's orientation as even and as odd stretches calibrate it."""
    held_out_deg: float
    """Median, on stretches that were not used."""
    stated_deg: float | None
    """The same with what the session states; None where it states nothing."""
    share: float
    """Of the reference's duration that the sensor covers."""
    identity: Identity | None
    change: Change | None
    verdict: str
    remedy: str

    @property
    def usable(self) -> bool:
        """Whether the values are worth writing."""
        return self.verdict in ("good", "twist unsure", "loose")


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


@dataclass(frozen=True, kw_only=True)
class Worn:
    """A sensor as the session states it."""

    settings: ImuSettings
    track: ImuTrack
    """On the session's clock."""
    tpose: TPose | None = None


def sensor_rotations(
    worn: Sequence[Worn], times_s: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "i t 3 3"]:
    """U R_i at the given instants; NaN where not measured."""
    mounted = [
        MountedImu(
            bone=each.settings.bone,
            track=each.track,
            world_from_imu_world=world_from_imu_world(each.settings.imu_up, 0.0),
            bone_from_imu=np.eye(3),
            position_in_bone_m=np.zeros(3),
        )
        for each in worn
    ]
    return np.swapaxes(resample_imus(mounted, times_s)[0], 0, 1)


def calibrate_subject(
    reference: ReferenceMotion,
    worn: Sequence[Worn],
    seen: SeenLandmarks | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> SubjectCalibration:
    """All steps; raises `InputError` where nothing was seen of the subject or clocks disagree.

    `progress` is told how many of how many steps are done.
    """
    _check_reference(reference)
    rotations = sensor_rotations(worn, reference.times_s)
    usable, skipped = [], []
    for each, rotation in zip(worn, rotations, strict=True):
        reason = _unusable(reference, each, rotation)
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
    late_s, correlated = _checked_lag(reference, kept)
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
        sensor, drawn = _sensor(
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
    _check_reference(reference)
    rotations = sensor_rotations(worn, reference.times_s)
    for each, rotation in zip(worn, rotations, strict=True):
        reason = _unusable(reference, each, rotation)
        if reason:
            raise InputError(f"imu '{each.settings.bone}' of '{reference.subject}': {reason}")
    return identify(reference, [each.settings.bone for each in worn], rotations)


def _check_reference(reference: ReferenceMotion) -> None:
    if reference.duration_s < MIN_OVERLAP_S:
        raise InputError(
            f"subject '{reference.subject}' is seen for {reference.duration_s:.1f} s, expected "
            f"{MIN_OVERLAP_S:g} s of motion or more; record longer, or calibrate with --from tpose"
        )


def _unusable(reference: ReferenceMotion, worn: Worn, rotation: Float[np.ndarray, "t 3 3"]) -> str:
    """Why a sensor cannot be calibrated; empty where it can."""
    known = np.isfinite(rotation).all((1, 2))
    step_s = float(np.median(np.diff(reference.times_s)))
    if known.sum() * step_s < MIN_OVERLAP_S:
        return (
            f"only {known.sum() * step_s:.1f} s of its samples ({worn.track.times_s[0]:.1f} to "
            f"{worn.track.times_s[-1]:.1f} s) fall within what the cameras saw "
            f"({reference.times_s[0]:.1f} to {reference.times_s[-1]:.1f} s), expected "
            f"{MIN_OVERLAP_S:g} s; check the file, or run: fusecap calibrate sync"
        )
    turned = Rotation.from_matrix(rotation[known])
    if float((turned[0].inv() * turned).magnitude().max()) < STILL_RAD:
        return (
            "its orientation never changes by more than 2 deg; check that the sensor was "
            "switched on and that its file is the right one"
        )
    return _wrong_up(worn)


def _wrong_up(worn: Worn) -> str:
    """Over a recording the specific force averages to gravity, which is up."""
    accel = worn.track.accel_m_s2
    known = np.isfinite(accel).all(axis=1)
    if known.sum() < 10:
        return ""
    quaternion = worn.track.orientation_wxyz[known][:, [1, 2, 3, 0]]
    force = Rotation.from_quat(quaternion).apply(accel[known]).mean(axis=0)
    axis = int(np.argmax(np.abs(force)))
    found = f"{'-' if force[axis] < 0 else ''}{'xyz'[axis]}"
    if np.linalg.norm(force) < 5.0 or found == worn.settings.imu_up:
        return ""
    hint = f'set imu_up = "{found}"' if found in ("y", "z") else "check the axes of its file"
    return (
        f'gravity points along {found} of its reference world, imu_up is "{worn.settings.imu_up}"; '
        f"{hint}"
    )


def _checked_lag(reference: ReferenceMotion, worn: Sequence[Worn]) -> tuple[float, float]:
    bones = [reference.skeleton.bone(each.settings.bone) for each in worn]
    late_s, best, at_zero = lag_s(reference, bones, [each.track for each in worn])
    if abs(late_s) > MAX_LAG_S and best > at_zero + MIN_LAG_GAIN:
        word = "behind" if late_s > 0 else "ahead of"
        raise InputError(
            f"the sensors of '{reference.subject}' are {abs(late_s):.2f} s {word} the cameras "
            f"(angular speeds correlate by {best:.2f} there, by {at_zero:.2f} as the session has "
            "it); run: fusecap calibrate sync"
        )
    return (late_s, best) if best > at_zero + MIN_LAG_GAIN / 2 else (0.0, at_zero)


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


@dataclass(frozen=True, kw_only=True)
class _Fitted:
    """One sensor: all stretches, each fold left out, and even and odd stretches."""

    whole: Fit
    folds: tuple[Fit | None, ...]
    halves: tuple[Fit, Fit]


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
        progress: Callable[[int, int], None] | None,
    ) -> None:
        self._reference = reference
        self._bones = [reference.skeleton.bone(each.settings.bone) for each in worn]
        self._pairs = pairs
        self._priors = priors
        self._sound = sound
        self._seen = seen
        self._progress = progress or (lambda done, total: None)
        if seen is not None:
            self._sensors = sensor_rotations(worn, seen.times_s)

    def fits(self, alone: Sequence[Fit]) -> list[_Fitted]:
        """Of all sensors, from where each was fitted alone."""
        masks: list[Mask] = [partial(_not_in_fold, fold=fold) for fold in range(FOLDS)]
        masks += [partial(_in_half, half=half) for half in (0, 1)]
        whole = self._joined(alone, None)
        parts: list[list[Fit | None]] = []
        for number, mask in enumerate(masks):
            self._progress(number + 1, len(masks) + 1)
            first: list[Fit | None] = []
            for some, prior in zip(self._pairs, self._priors, strict=True):
                left = some.where(mask(some.block))
                enough = (left.block >= 0).sum() >= 3
                first.append(fit(left, prior) if enough else None)
            parts.append(self._joined(first, mask, whole))
        self._progress(len(masks) + 1, len(masks) + 1)
        result = []
        for index, fitted in enumerate(whole):
            assert fitted is not None
            even, odd = parts[FOLDS][index], parts[FOLDS + 1][index]
            result.append(
                _Fitted(
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


def _sensor(
    reference: ReferenceMotion,
    worn: Worn,
    pairs: Pairs,
    prior: HeadingPrior,
    found: _Fitted,
    identity: Identity | None,
    change: Change | None,
) -> tuple[SensorCalibration, tuple[np.ndarray, np.ndarray]]:
    fitted = found.whole
    drifting = fit(pairs, prior, drift_sigma_rad_s=DRIFT_RAD_S)
    residual_deg = _held_out_deg(pairs, found.folds)
    recorded = pairs.block >= 0
    sigma = np.degrees(fitted.sigma_rad(pairs))
    held_out = float(np.nanmedian(residual_deg))
    xyzw = Rotation.from_matrix(fitted.bone_from_imu).as_quat(canonical=True)
    verdict, remedy = _verdict(worn, identity, change, held_out, sigma)
    step_s = float(np.median(np.diff(reference.times_s)))
    sensor = SensorCalibration(
        subject=reference.subject,
        bone=worn.settings.bone,
        file=worn.settings.source_name,
        bone_from_imu_wxyz=(float(xyzw[3]), float(xyzw[0]), float(xyzw[1]), float(xyzw[2])),
        heading_deg=float(np.degrees(fitted.heading_rad)),
        drift_deg_min=float(np.degrees(drifting.drift_rad_s) * 60),
        drift_sigma_deg_min=float(np.degrees(np.sqrt(drifting.covariance[4, 4])) * 60),
        sigma_deg=(float(sigma[0]), float(sigma[1]), float(sigma[2])),
        heading_sigma_deg=float(np.degrees(np.sqrt(fitted.covariance[3, 3]))),
        halves_deg=_halves_deg(pairs, found.halves),
        held_out_deg=held_out,
        stated_deg=_stated_deg(worn, pairs),
        share=min(float(recorded.sum()) * step_s / max(reference.duration_s, step_s), 1.0),
        identity=identity,
        change=change,
        verdict=verdict,
        remedy=remedy,
    )
    judged = np.isfinite(residual_deg)
    return sensor, (pairs.times_s[recorded][judged], residual_deg[judged])


def _held_out_deg(pairs: Pairs, folds: Sequence[Fit | None]) -> Float[np.ndarray, " n"]:
    """Of every recorded instant, with the fit of the folds that its stretch is not in."""
    recorded = pairs.block >= 0
    residual = np.full(len(pairs), np.nan)
    for fold, left in enumerate(folds):
        out = recorded & (pairs.block % FOLDS == fold)
        if left is not None:
            residual[out] = residual_rad(pairs, left.errors(pairs))[out]
    return np.degrees(residual[recorded])


def _halves_deg(pairs: Pairs, halves: tuple[Fit, Fit]) -> float:
    apart = halves[0].errors(pairs) - halves[1].errors(pairs)
    return float(np.degrees(np.median(residual_rad(pairs, apart))))


def _stated_deg(worn: Worn, pairs: Pairs) -> float | None:
    """Median residual with the session's own constants."""
    stated = worn.settings.bone_from_imu_wxyz
    if stated is None:
        return None
    w, x, y, z = stated
    given = Fit(
        bone_from_imu=Rotation.from_quat([x, y, z, w]).as_matrix(),
        heading_rad=float(np.radians(worn.settings.heading_deg)),
        drift_rad_s=0.0,
        middle_s=0.0,
        covariance=np.zeros((4, 4)),
        cost=0.0,
    )
    residual = residual_rad(pairs, given.errors(pairs))[pairs.block >= 0]
    return float(np.degrees(np.median(residual)))


def _verdict(
    worn: Worn,
    identity: Identity | None,
    change: Change | None,
    held_out_deg: float,
    sigma_deg: Float[np.ndarray, "3"],
) -> tuple[str, str]:
    bone = worn.settings.bone
    if identity is not None and identity.contradicts:
        return "wrong bone", (
            f"'{worn.settings.source_name}' is stated on {bone} but moves like {identity.found}; "
            "change the bone of this [[subject.imu]] and calibrate again"
        )
    if change is not None:
        return "moved", (
            f"turned by {np.degrees(change.turn_rad):.0f} deg on its bone (or its heading jumped) "
            f"at about {change.time_s:.0f} s; calibrate the parts before and after as two "
            "sessions, or strap the sensor tighter and record again"
        )
    if held_out_deg > POOR_DEG:
        return "poor", (
            "sensor and cameras do not tell the same motion; check its file, bone and clock "
            "(fusecap doctor, fusecap calibrate sync)"
        )
    axes = [axis for axis, sigma in zip("xyz", sigma_deg, strict=True) if sigma > UNOBSERVED_DEG]
    if axes:
        return "twist unsure", (
            f"its turn about {' and '.join(axes)} of the bone is hardly observed; add a T-pose "
            "(tpose_s), or move in more ways: bend elbows and knees, raise the arms, turn around"
        )
    if max(sigma_deg) > LOOSE_DEG:
        return "loose", "move more, or longer: bend elbows and knees, raise the arms, turn around"
    return "good", ""
