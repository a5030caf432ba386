"""Whether sensors turn as the limbs do that cameras see.

Two triangulated landmarks say where a limb points, and so does the sensor on it, once it is known
how it sits and where its world faces. In a right session the two differ by 3 to 15 degrees, the
typical instant of a limb. Where they differ by more, or less at another time, the causes are
tried: sensors that are late or of another rate, a heading, two sensors exchanged; what makes the
difference fall to less than `EXPLAINED` is named. What turns a sensor about the limb itself no
landmark tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.checks.wearers import LEAST_INSTANTS, Wearer, median_angle
from fusecap.findings import Findings
from fusecap.sources.synchronizer import MountedImu, resample_imus

APART_RAD = np.radians(22.0)
EXPLAINED = 0.5
LEAST_GAIN_RAD, LEAST_GAIN_ALONE_RAD = np.radians(3.0), np.radians(6.0)
"""Of all sensors of a person, of one: less is within what bodies and landmarks differ by."""
SHIFTS_S = np.arange(-30, 31) * 0.05
NEAR_S = SHIFTS_S[np.abs(SHIFTS_S) < 0.625]
"""Of one sensor alone: who walks does the same a second later."""
RATES = (0.5, 0.6, 5 / 6, 1.2, 5 / 3, 2.0)
"""Of what was recorded at one rate and written down as another."""
SURER = 0.7
"""Of what anything else leaves, before another rate is believed."""
HEADINGS_RAD = np.radians(np.arange(-170, 181, 10))
DRIFT_RAD = np.radians(8.0)
"""Between the headings of the first and of the second half; 3 in right sessions."""
LEVEL = 0.3
"""Sine of a limb's angle to up, from which on it tells a heading."""


def check_limbs(wearers: Sequence[Wearer], findings: Findings) -> set[str]:
    """The sensors that it names."""
    alone: list[_Sensor] = []
    for worn in wearers:
        shifted = worn.shifted(SHIFTS_S)
        turned = shifted[SHIFTS_S.tolist().index(0.0)]
        own = worn.own(turned)
        apart = worn.per_sensor(own, turned)
        told = _together(worn, shifted, turned, apart)
        if told is not None:
            findings.add("warning", f"sensors of '{worn.name}'", *told)
            continue
        for index in np.flatnonzero(np.isfinite(apart)).tolist():
            mine = worn.limbs[:, 0] == index
            alone.append(
                _Sensor(
                    where=f"imu '{worn.imus[index].bone}' of '{worn.name}'",
                    imu=worn.imus[index],
                    times_s=worn.times_s,
                    rest=worn.rest[mine],
                    own=own[:, mine],
                    shifted=shifted[np.isin(SHIFTS_S, NEAR_S)][:, :, mine],
                    apart_rad=float(apart[index]),
                )
            )
    exchanged = _check_exchanged([s for s in alone if s.apart_rad > APART_RAD], findings)
    told = set(exchanged)
    for sensor in alone:
        if sensor.where not in exchanged and _check_one(sensor, findings):
            told.add(sensor.where)
    return told


def _together(
    worn: Wearer,
    shifted: Float[np.ndarray, "s t l 3"],
    turned: Float[np.ndarray, "t l 3"],
    apart: Float[np.ndarray, " i"],
) -> tuple[str, str] | None:
    """What all sensors of a person have in common, and what to do."""
    if not np.isfinite(apart).any():
        return None
    typical = float(np.nanmedian(apart))

    def left(turned: np.ndarray) -> float:
        return _median(worn.per_sensor(worn.own(turned), turned))

    causes = _late(SHIFTS_S, [left(late) for late in shifted], "their")
    for heading in HEADINGS_RAD.tolist():
        left_rad = left(_about_up(heading, turned))
        causes.append((left_rad, _heading_remedy(heading, left_rad)))
    least = SURER * min(left_rad for left_rad, _ in causes)
    begin_s = min(float(imu.track.times_s[0]) for imu in worn.imus)
    for rate in RATES:
        left_rad = left(worn.turned(begin_s + (worn.times_s - begin_s) * rate))
        if left_rad < least:
            causes.append((left_rad, _rate_remedy(rate, left_rad)))
    left_rad, remedy = min(causes, key=lambda cause: cause[0])
    if not _explains(left_rad, typical, LEAST_GAIN_RAD):
        drift_rad = _drift_rad(worn, turned)
        if not abs(drift_rad) > DRIFT_RAD:
            return None
        remedy = _drift_remedy(drift_rad)
    return f"point {np.degrees(typical):.0f} deg away from the limbs that cameras see", remedy


@dataclass(frozen=True, kw_only=True)
class _Sensor:
    """One sensor, against the limbs of the person who wears it."""

    where: str
    imu: MountedImu
    times_s: Float[np.ndarray, " t"]
    rest: Float[np.ndarray, "l 3"]
    own: Float[np.ndarray, "t l 3"]
    shifted: Float[np.ndarray, "s t l 3"]
    apart_rad: float

    def turned(self, imu: MountedImu) -> Float[np.ndarray, "t l 3"]:
        """Where its limbs would point by this sensor."""
        rotations, _ = resample_imus([imu], self.times_s)
        return np.einsum("tij,lj->tli", rotations[:, 0], self.rest)

    def left(self, turned: np.ndarray) -> float:
        """Median angle [rad]; infinite where too little is known."""
        angle = median_angle(np.einsum("tli,tli->tl", self.own, turned))
        return angle if np.isfinite(angle) else np.inf


def _check_one(sensor: _Sensor, findings: Findings) -> bool:
    """Whether something was found."""
    late = _late(NEAR_S, [sensor.left(turned) for turned in sensor.shifted], "its")
    if late and _explains(late[0][0], sensor.apart_rad, LEAST_GAIN_ALONE_RAD):
        remedy = late[0][1]
    elif sensor.apart_rad > APART_RAD:
        remedy = (
            f"see that it is the one on the {sensor.imu.bone.replace('_', ' ')} and has not "
            "slipped; fusecap calibrate imu finds how it sits and where its world faces"
        )
    else:
        return False
    findings.add(
        "warning",
        sensor.where,
        f"points {np.degrees(sensor.apart_rad):.0f} deg away from the limb that cameras see",
        remedy,
    )
    return True


def _explains(left_rad: float, apart_rad: float, least_rad: float) -> bool:
    return left_rad < EXPLAINED * apart_rad and apart_rad - left_rad > least_rad


def _about_up(heading_rad: float, turned: np.ndarray) -> np.ndarray:
    return turned @ Rotation.from_euler("y", heading_rad).as_matrix().T


def _late(
    shifts_s: Float[np.ndarray, " s"], left_rad: list[float], whose: str
) -> list[tuple[float, str]]:
    """The shift that leaves least, where it is not one at the end of what is tried."""
    best = int(np.argmin(left_rad))
    if best in (0, len(shifts_s) - 1):
        return []
    return [(left_rad[best], _shift_remedy(shifts_s[best], left_rad[best], whose))]


def _shift_remedy(shift_s: float, left_rad: float, whose: str) -> str:
    return (
        f"add about {shift_s:+.2f} s to {whose} offset_s: then {np.degrees(left_rad):.0f} deg are "
        "left; fusecap calibrate sync finds it exactly"
    )


def _rate_remedy(rate: float, left_rad: float) -> str:
    return (
        f"with times {1 / rate:.2f} times as long {np.degrees(left_rad):.0f} deg are left: "
        "see what rate_hz the sensors recorded at, and whether rows are missing"
    )


def _heading_remedy(heading_rad: float, left_rad: float) -> str:
    return (
        f"add about {np.degrees(heading_rad):+.0f} to their heading_deg, or to tpose_facing_deg "
        f"where a T-pose calibrates them: then {np.degrees(left_rad):.0f} deg are left; fusecap "
        "calibrate imu finds it exactly"
    )


def _drift_remedy(drift_rad: float) -> str:
    return (
        f"headings of the first and of the second half differ by {np.degrees(drift_rad):+.0f} deg: "
        "keep sensors away from iron, and let them settle before recording"
    )


def _drift_rad(worn: Wearer, turned: Float[np.ndarray, "t l 3"]) -> float:
    """By how much the heading of the second half differs from that of the first."""
    own, half = worn.own(turned), len(turned) // 2
    first, second = (
        _heading_rad(own[rows], turned[rows]) for rows in (slice(None, half), slice(half, None))
    )
    return float(np.angle(np.exp(1j * (second - first))))


def _heading_rad(own: Float[np.ndarray, "t l 3"], turned: Float[np.ndarray, "t l 3"]) -> float:
    """From limbs as sensors turn them to those seen, about up: the median of those not upright."""
    seen, said = own[..., 2] + 1j * own[..., 0], turned[..., 2] + 1j * turned[..., 0]
    between = (seen * np.conj(said))[np.isfinite(seen) & (np.abs(said) > LEVEL)]
    if len(between) < LEAST_INSTANTS:
        return float("nan")
    mean = np.angle(between.sum())
    return float(mean + np.median(np.angle(between * np.exp(-1j * mean))))


def _median(values: Float[np.ndarray, " i"]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.inf


def _check_exchanged(apart: list[_Sensor], findings: Findings) -> set[str]:
    """Pairs of which each fits the other's place; where they are."""
    found: set[str] = set()
    for index, one in enumerate(apart):
        for two in apart[index + 1 :]:
            if found & {one.where, two.where}:
                continue
            left_rad = [
                a.left(a.turned(replace(a.imu, track=b.imu.track)))
                for a, b in ((one, two), (two, one))
            ]
            if all(
                _explains(left, each.apart_rad, LEAST_GAIN_ALONE_RAD)
                for left, each in zip(left_rad, (one, two), strict=True)
            ):
                found |= {one.where, two.where}
                findings.add(
                    "warning",
                    one.where,
                    f"points {np.degrees(one.apart_rad):.0f} deg away from the limb that cameras "
                    "see",
                    f"exchanged with {two.where} {np.degrees(max(left_rad)):.0f} deg are left: "
                    "exchange their files",
                )
    return found
