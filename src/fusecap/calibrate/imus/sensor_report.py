"""How well one sensor is calibrated, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.imus.changes import Change
from fusecap.calibrate.imus.checks import Worn
from fusecap.calibrate.imus.fit import Fit, HeadingPrior, Pairs, fit, residual_rad
from fusecap.calibrate.imus.identify import Identity
from fusecap.calibrate.imus.reference import ReferenceMotion
from fusecap.calibrate.verdict import Verdict
from fusecap.geometry.quaternions import from_wxyz, to_wxyz

FOLDS = 4
DRIFT_RAD_S = np.radians(3.0) / 60.0
"""Prior standard deviation of a heading's drift."""
POOR_DEG = 15.0
"""A held-out residual above this is not a calibration."""
LOOSE_DEG, UNOBSERVED_DEG = 8.0, 14.0
"""Uncertainty about an axis beyond which it is called so."""

Fault = Literal["", "wrong bone", "moved", "other motion", "twist unsure", "loose"]
"""What keeps a sensor from being good."""
_VERDICTS: dict[Fault, Verdict] = {
    "": Verdict.GOOD,
    "twist unsure": Verdict.USABLE,
    "loose": Verdict.USABLE,
    "other motion": Verdict.POOR,
    "moved": Verdict.POOR,
    "wrong bone": Verdict.POOR,
}


@dataclass(frozen=True, kw_only=True)
class SensorFits:
    """One sensor: all stretches, each fold left out, and even and odd stretches."""

    whole: Fit
    folds: tuple[Fit | None, ...]
    halves: tuple[Fit, Fit]


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
    verdict: Verdict
    fault: Fault
    remedy: str

    @property
    def usable(self) -> bool:
        """Whether the values are worth writing."""
        return self.verdict is not Verdict.POOR


def sensor_calibration(
    reference: ReferenceMotion,
    worn: Worn,
    pairs: Pairs,
    prior: HeadingPrior,
    found: SensorFits,
    identity: Identity | None,
    change: Change | None,
) -> tuple[SensorCalibration, tuple[np.ndarray, np.ndarray]]:
    fitted = found.whole
    drifting = fit(pairs, prior, drift_sigma_rad_s=DRIFT_RAD_S)
    residual_deg = _held_out_deg(pairs, found.folds)
    recorded = pairs.block >= 0
    sigma = np.degrees(fitted.sigma_rad(pairs))
    held_out = float(np.nanmedian(residual_deg))
    w, x, y, z = to_wxyz(Rotation.from_matrix(fitted.bone_from_imu)).tolist()
    fault, remedy = _fault(worn, identity, change, held_out, sigma)
    step_s = float(np.median(np.diff(reference.times_s)))
    sensor = SensorCalibration(
        subject=reference.subject,
        bone=worn.settings.bone,
        file=worn.settings.source_name,
        bone_from_imu_wxyz=(w, x, y, z),
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
        verdict=_VERDICTS[fault],
        fault=fault,
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
    given = Fit(
        bone_from_imu=from_wxyz(stated).as_matrix(),
        heading_rad=float(np.radians(worn.settings.heading_deg)),
        drift_rad_s=0.0,
        middle_s=0.0,
        covariance=np.zeros((4, 4)),
        cost=0.0,
    )
    residual = residual_rad(pairs, given.errors(pairs))[pairs.block >= 0]
    return float(np.degrees(np.median(residual)))


def _fault(
    worn: Worn,
    identity: Identity | None,
    change: Change | None,
    held_out_deg: float,
    sigma_deg: Float[np.ndarray, "3"],
) -> tuple[Fault, str]:
    """The gravest, and its remedy."""
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
        return "other motion", (
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
    return "", ""
