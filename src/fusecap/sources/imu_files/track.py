"""What every IMU format is brought to: sorted, unit quaternions, specific force.

Files lose packets, repeat them, write them late, and write NaN; `tidy` removes what cannot be used
and says what it did. An accelerometer measures specific force: at rest it reads +9.8 along up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.geometry.quaternions import from_wxyz, to_wxyz
from fusecap.types import GRAVITY_M_S2

EPOCH_ABOVE_S = 1e8
"""Times beyond three years count from 1970."""
EPOCH_PERIOD_S = 2.0**33
"""Far longer than any of them, and still resolved to a microsecond."""
_UNIT_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedClock:
    """The recorder's clock, common to sensors that were recorded together."""

    start_s: float
    """Its reading at the track's time 0."""
    period_s: float
    """It starts over at zero after this long."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuTrack:
    """The samples of one sensor."""

    times_s: np.ndarray
    """(N,) strictly ascending, on the file's clock."""
    orientation_wxyz: np.ndarray
    """(N, 4) imu_world_from_imu, unit; of a file float32, a hundred thousandth of a degree."""
    accel_m_s2: np.ndarray
    """(N, 3) specific force in the imu frame; NaN where not measured; of a file float32."""
    notes: tuple[str, ...] = ()
    """What was wrong with the file and has been dealt with."""
    clock: SharedClock | None = None
    heading_known: bool = True
    """Whether other sensors share the imu_world; else each faces anywhere."""
    bone_from_imu: np.ndarray | None = None
    """(3, 3) how it sits on the bone that it is named after, where the recorder has found that."""

    @property
    def rate_hz(self) -> float:
        """From the median spacing; NaN for a single sample."""
        if len(self.times_s) < 2:
            return float("nan")
        return float(1.0 / np.median(np.diff(self.times_s)))

    @property
    def up_axis(self) -> str | None:
        """Axis of the imu_world that gravity's reaction is nearest to, "y" or "-z" say.

        None with few accelerations, or where gravity has been taken out of them.
        """
        measured = np.isfinite(self.accel_m_s2).all(axis=1)
        if np.count_nonzero(measured) < 10:
            return None
        turned = from_wxyz(self.orientation_wxyz[measured]).apply(self.accel_m_s2[measured])
        force = np.median(turned, axis=0)
        axis = int(np.argmax(np.abs(force)))
        if np.linalg.norm(force) < 0.5 * GRAVITY_M_S2:
            return None
        return f"{'-' if force[axis] < 0 else ''}{'xyz'[axis]}"

    @property
    def gaps(self) -> np.ndarray:
        """(N - 1,) how many samples were lost after each but the last."""
        step = np.diff(self.times_s)
        if len(step) == 0:
            return np.empty(0, dtype=np.int64)
        return np.maximum(np.round(step / np.median(step)).astype(np.int64) - 1, 0)


def tidy(
    where: str,
    times_s: np.ndarray,
    orientation_wxyz: np.ndarray,
    accel_m_s2: np.ndarray | None,
    *,
    clock: SharedClock | None = None,
    notes: tuple[str, ...] = (),
    heading_known: bool = True,
) -> ImuTrack:
    """A track from raw columns; raises `InputError` when no sample is left.

    None for accelerations stands for a file without any; of one whose cells all cannot be read a
    note says so.

    Rows without a time or an orientation are dropped, non-finite accelerations become NaN, rows
    are sorted by time, of equal times the first is kept, quaternions are normalised.
    """
    said = list(notes)
    if accel_m_s2 is None:
        accel_m_s2 = np.full((len(times_s), 3), np.nan)
    elif not np.isfinite(accel_m_s2).all(axis=1).any():
        said.append("no accelerations were read: none of their cells is a number")
    with np.errstate(over="ignore"):  # of numbers beyond every scale, which are left out
        norm = np.linalg.norm(orientation_wxyz, axis=1)
    whole = np.isfinite(times_s) & np.isfinite(norm)
    usable = whole & (norm > 0.1)
    _note(said, ~whole, "{} rows without time or orientation dropped")
    _note(said, whole & ~usable, "{} zero quaternions dropped")
    if not usable.any():
        raise InputError(f"{where}: no sample with an orientation; expected at least one")
    times_s, quaternion, accel = times_s[usable], orientation_wxyz[usable], accel_m_s2[usable]
    norm = norm[usable]
    _note(said, np.abs(norm - 1) > _UNIT_TOLERANCE, "{} quaternions were not unit")
    _note(said, np.diff(times_s) < 0, "{} samples out of order, sorted")
    order = np.argsort(times_s, kind="stable")
    times_s, quaternion, accel = times_s[order], (quaternion / norm[:, None])[order], accel[order]
    fresh = np.concatenate([[True], np.diff(times_s) > 0])
    _note(said, ~fresh, "{} duplicate timestamps dropped")
    times_s, quaternion, accel = times_s[fresh], quaternion[fresh], accel[fresh]
    with np.errstate(over="ignore"):  # of numbers beyond every scale, which become infinite
        accel = accel.astype(np.float32)
    measured = np.all(np.isfinite(accel), axis=1, keepdims=True)
    return ImuTrack(
        times_s=times_s,
        orientation_wxyz=quaternion.astype(np.float32),
        accel_m_s2=np.where(measured, accel, np.float32(np.nan)),
        notes=tuple(said),
        clock=clock,
        heading_known=heading_known,
    )


def _note(said: list[str], affected: np.ndarray, text: str) -> None:
    if affected.any():
        said.append(text.format(np.count_nonzero(affected)))


def specific_force(
    orientation_wxyz: np.ndarray, free_accel_in_imu_world_m_s2: np.ndarray
) -> np.ndarray:
    """What the accelerometer read, from acceleration without gravity in a z-up imu world."""
    result = np.full_like(free_accel_in_imu_world_m_s2, np.nan)
    norm = np.linalg.norm(orientation_wxyz, axis=1)
    usable = np.isfinite(norm) & (norm > 0.1)
    if usable.any():
        imu_world_from_imu = from_wxyz(orientation_wxyz[usable])
        with_gravity = free_accel_in_imu_world_m_s2[usable] + [0.0, 0.0, GRAVITY_M_S2]
        with np.errstate(invalid="ignore", over="ignore"):  # of what `tidy` then drops
            result[usable] = imu_world_from_imu.inv().apply(with_gravity)
    return result


def wxyz_of_matrices(matrices: np.ndarray) -> np.ndarray:
    """(N, 4) of (N, 3, 3); NaN where a matrix is no rotation."""
    usable = np.all(np.isfinite(matrices), axis=(1, 2))
    usable &= np.linalg.det(np.nan_to_num(matrices)) > 0.1
    return _wxyz(usable, Rotation.from_matrix, matrices)


def wxyz_of_euler(roll_pitch_yaw_deg: np.ndarray) -> np.ndarray:
    """(N, 4) of (N, 3) in degrees, Rz(yaw) Ry(pitch) Rx(roll); NaN where an angle is."""
    usable = np.all(np.isfinite(roll_pitch_yaw_deg), axis=1)
    return _wxyz(
        usable, lambda angles: Rotation.from_euler("xyz", angles, degrees=True), roll_pitch_yaw_deg
    )


def _wxyz(
    usable: np.ndarray, rotation: Callable[[np.ndarray], Rotation], values: np.ndarray
) -> np.ndarray:
    result = np.full((len(values), 4), np.nan)
    if usable.any():
        result[usable] = to_wxyz(rotation(values[usable]))
    return result


def since_first(times_s: np.ndarray) -> tuple[np.ndarray, SharedClock | None]:
    """Times, and the clock that they share where they count from 1970: then the first is 0."""
    first = float(np.nanmin(times_s)) if np.isfinite(times_s).any() else 0.0
    if first < EPOCH_ABOVE_S:
        return times_s, None
    return times_s - first, SharedClock(start_s=first, period_s=EPOCH_PERIOD_S)


def unwrapped(counter: np.ndarray, modulus: int) -> np.ndarray:
    """A wrapping counter made monotonic; a step back by less than half the range stays one."""
    if len(counter) == 0:
        return counter.astype(np.float64)
    step = np.mod(np.diff(counter) + modulus / 2, modulus) - modulus / 2
    return np.concatenate([[0.0], np.cumsum(step)]) + counter[0]
