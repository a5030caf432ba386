"""Body-worn sensors that are synchronised with nothing: samples in, readings of one instant out.

Between two samples orientations follow the shorter arc (slerp) and accelerations a line. Where the
next sample has not come the last one holds for 20 ms, and is never extrapolated: sensors send every
10 to 20 ms, so this bridges one packet that is late, and a limb that turns at 5 rad/s is then
wrong by 6 degrees, about what a strapped sensor is wrong anyway. Longer, and a lost sensor would
freeze a limb that moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.engine.samples import Samples
from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.session import ImuSettings, SubjectSettings
from fusecap.sources.synchronizer import (
    EXACT_S,
    MAX_GAP_S,
    accels_between,
    in_world,
    orientations_between,
    world_from_imu_world,
)
from fusecap.types import ImuReading, ImuSample

HOLD_S = 0.02
FRESH_S = 0.05
"""A sensor is waited for while its newest sample is not older than this, three periods at 60 Hz:
one of many that falls silent for a moment must not hold up all the others."""
TPOSE_S = 1.0
"""For which a subject has stood still when it says so."""
TPOSE_SAMPLES = 5
"""Of a sensor in that time; fewer are not trusted."""
TPOSE_MOVED_DEG = 5.0
"""People who try to stand still sway by one or two degrees."""
_EXACT_NS, _MAX_GAP_NS, _HOLD_NS = (round(s * 1e9) for s in (EXACT_S, MAX_GAP_S, HOLD_S))

Measured = tuple[Float[np.ndarray, "4"], Float[np.ndarray, "3"]]
"""Orientation (w, x, y, z) and specific force."""


class Sensors:
    """The latest samples of every sensor of every subject, interpolated on demand."""

    def __init__(self, subjects: Sequence[SubjectSettings]) -> None:
        imus = [(subject.name, imu) for subject in subjects for imu in subject.imus]
        self._row = {(name, imu.bone): row for row, (name, imu) in enumerate(imus)}
        self._rows: dict[str, slice] = {}
        """Each wearer's sensors, in the order of its tables."""
        for subject in subjects:
            start = sum(len(s.imus) for s in subjects[: subjects.index(subject)])
            if subject.imus:
                self._rows[subject.name] = slice(start, start + len(subject.imus))
        self._bones = [imu.bone for _, imu in imus]
        self._samples = [Samples[Measured]() for _ in imus]
        self._world_from_imu_world = np.array(
            [world_from_imu_world(imu.imu_up, imu.heading_deg) for _, imu in imus]
        ).reshape(-1, 3, 3)
        self._bone_from_imu = np.array([_mounting(imu) for _, imu in imus]).reshape(-1, 3, 3)

    def take(self, sample: ImuSample) -> None:
        """Keep a sample; one of no sensor or without an orientation is left out."""
        row = self._row.get((sample.subject, sample.bone))
        # A recording holds more digits than single precision: both must be computed alike.
        orientation = np.asarray(sample.orientation_wxyz, dtype=np.float64)
        accel = np.asarray(sample.accel_m_s2, dtype=np.float64)
        norm = float(np.sqrt(np.dot(orientation, orientation)))
        if row is None or not 0.1 < norm < 10.0:
            return
        if abs(norm - 1.0) > 1e-9:
            orientation = orientation / norm
        if not np.isfinite(accel).all():
            accel = np.full(3, np.nan)
        self._samples[row].insert(sample.timestamp_ns, (orientation, accel))

    def readings(self, now_ns: int) -> dict[str, ImuReading]:
        """By subject what its sensors say at an instant; nothing of subjects without any word."""
        count = len(self._samples)
        rotations, accels = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
        rows: list[int] = []
        first: list[Measured] = []
        second: list[Measured] = []
        share: list[float] = []
        for row, samples in enumerate(self._samples):
            samples.forget_before(now_ns)
            found = _around(samples, now_ns)
            if found is not None and np.isfinite(self._bone_from_imu[row, 0, 0]):
                rows.append(row)
                first.append(found[0])
                second.append(found[1])
                share.append(found[2])
        if rows:
            part = np.array(share)
            rotations[rows], accels[rows] = in_world(
                orientations_between(
                    np.array([quaternion for quaternion, _ in first]),
                    np.array([quaternion for quaternion, _ in second]),
                    part,
                ),
                accels_between(
                    np.array([accel for _, accel in first]),
                    np.array([accel for _, accel in second]),
                    part,
                ),
                self._world_from_imu_world[rows],
                self._bone_from_imu[rows],
            )
        return {
            name: ImuReading(
                bone_rotation_in_world=rotations[some], accel_in_world_m_s2=accels[some]
            )
            for name, some in self._rows.items()
            if np.isfinite(rotations[some, 0, 0]).any()
        }

    def waiting(self, now_ns: int) -> list[bool]:
        """Per fresh sensor whether a sample from the instant or later is still to come."""
        oldest_ns = now_ns - round(FRESH_S * 1e9)
        newest = [samples.newest_ns for samples in self._samples]
        return [newest_ns < now_ns for newest_ns in newest if newest_ns >= oldest_ns]

    @property
    def wearers(self) -> Mapping[str, slice]:
        """Subjects with sensors."""
        return self._rows

    @property
    def mountings(self) -> dict[tuple[str, str], Float[np.ndarray, "3 3"]]:
        """R_ib by subject and bone, of sensors that have one."""
        return {
            key: self._bone_from_imu[row]
            for key, row in self._row.items()
            if np.isfinite(self._bone_from_imu[row, 0, 0])
        }

    def mount_in_tpose(self, subject: str, facing_rad: float) -> str:
        """Take the mountings from the last second, in which the subject stood in the T-pose.

            R_ib = R_facing^-1 R_ig mean(R_i)

        Returns what came of it, in words; nothing changes where a sensor moved or all are silent.
        """
        rows = range(len(self._samples))[self._rows[subject]]
        newest_ns = max(self._samples[row].newest_ns for row in rows)
        found: dict[int, np.ndarray] = {}
        silent, moved = [], []
        for row in rows:
            recent = self._samples[row].since(newest_ns - round(TPOSE_S * 1e9))
            if len(recent) < TPOSE_SAMPLES:
                silent.append(self._bones[row])
                continue
            turned = from_wxyz(np.array([q for q, _ in recent]))
            mean = turned.mean()
            away_deg = np.degrees((mean.inv() * turned).magnitude().max())
            if away_deg > TPOSE_MOVED_DEG:
                moved.append(f"{self._bones[row]} by {away_deg:.0f}")
            found[row] = mean.as_matrix()
        if moved or not found:
            why = f"sensors moved ({', '.join(moved)} degrees)" if moved else "no sensor is heard"
            return f"{subject}: T-pose refused, {why}; stand still for a second and ask again"
        world_from_bone = Rotation.from_rotvec([0.0, facing_rad, 0.0]).as_matrix()
        for row, mean in found.items():
            world_from_imu = self._world_from_imu_world[row] @ mean
            self._bone_from_imu[row] = world_from_bone.T @ world_from_imu
        missed = f"; not heard: {', '.join(silent)}" if silent else ""
        return f"{subject}: T-pose taken by {len(found)} sensors{missed}"


def _mounting(imu: ImuSettings) -> np.ndarray:
    """R_ib; NaN where it is to be found in a T-pose."""
    if imu.bone_from_imu_wxyz is None:
        return np.full((3, 3), np.nan)
    return from_wxyz(imu.bone_from_imu_wxyz).as_matrix()


def _around(samples: Samples[Measured], now_ns: int) -> tuple[Measured, Measured, float] | None:
    """The two samples between which an instant lies, and how far it is on the way."""
    before, after = samples.around(now_ns, _EXACT_NS)
    if after < len(samples):
        second_ns, second = samples.at(after)
        exact = second_ns - now_ns <= _EXACT_NS
        if before < 0:
            return (second, second, 0.0) if exact else None
        first_ns, first = samples.at(before)
        if exact or second_ns - first_ns <= _MAX_GAP_NS:
            share = (now_ns - first_ns) / (second_ns - first_ns)
            return first, second, min(share, 1.0)
    if before < 0:
        return None
    first_ns, first = samples.at(before)
    return (first, first, 0.0) if now_ns - first_ns <= _HOLD_NS else None
