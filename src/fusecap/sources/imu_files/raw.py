"""Orientation of sensors that recorded only rates, accelerations and perhaps the magnetic field.

VQF [Laidig and Seel, Information Fusion 2023] looks at the whole recording, on an even grid at the
median rate. Up is told by gravity. Without a magnetometer nothing tells north: the heading starts
anywhere and drifts with what is left of the gyroscope's bias, so `heading_deg` must be found.

Rates in another unit turn gravity away from up between the corrections: where that happens, and not
with the other unit, the file's is told.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Slerp

from fusecap.errors import InputError, from_extra
from fusecap.geometry.quaternions import from_wxyz, to_wxyz
from fusecap.sources.imu_files.table import ImuTable

_WHAT = ("Gyr", "Acc", "Mag")
_LEAST_S = 1.0
_LONGEST_GAP_S = 0.5
_UNSTEADY = np.radians(5.0)
"""Typical angle from gravity to up, beyond which another unit is tried."""
_STEADIER = 0.5
"""Of the angle, with the unit that is then believed."""


class Orientation(NamedTuple):
    """What a reader finds in a file's columns."""

    wxyz: Float[np.ndarray, "n 4"]
    """imu_world from imu; NaN where not known."""
    notes: tuple[str, ...] = ()
    heading_known: bool = True
    """Whether the imu_world is one that other sensors share."""


def orientation_from_raw(
    table: ImuTable, times_s: Float[np.ndarray, " n"], *, rad_s: float
) -> Orientation | None:
    """imu_world (z up) from imu of a table without orientations, and what to know of it.

    Columns are `Gyr_X..Z`, `Acc_X..Z` [m/s^2] and perhaps `Mag_X..Z`; `rad_s` is one unit of the
    gyroscope. NaN where a row misses a number; None without a gyroscope or an
    accelerometer. Raises `InputError` where they are too few, too far apart, of another unit, or
    VQF is missing.
    """
    gyro, accel, field = ([f"{what}_{axis}" for axis in "XYZ"] for what in _WHAT)
    if not (table.has(gyro) and table.has(accel)):
        return None
    try:
        import vqf  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"{table.path}: has no orientation; to find it from gyroscope and accelerometer needs "
            f"a library that cannot be imported ({error}); {from_extra('raw')}"
        ) from None
    magnetic = table.has(field) and bool(np.isfinite(table.take(field)).all(axis=1).any())
    values = table.take([*gyro, *accel, *(field if magnetic else ())])
    whole = np.flatnonzero(np.isfinite(times_s) & np.isfinite(values).all(axis=1))
    _, first = np.unique(times_s[whole], return_index=True)
    rows = whole[first]
    at_s, samples = times_s[rows], values[rows]
    if len(at_s) < 2 or at_s[-1] - at_s[0] < _LEAST_S:
        raise InputError(
            f"{table.path}: too short to find an orientation from gyroscope and accelerometer; "
            f"expected {_LEAST_S:g} s or more"
        )
    gap_s = float(np.diff(at_s).max())
    if gap_s > _LONGEST_GAP_S:
        raise InputError(
            f"{table.path}: {gap_s:.1f} s without samples; turns in them are lost, and with them "
            "the orientation after: cut the recording there"
        )
    step_s = float(np.median(np.diff(at_s)))
    even_s = at_s[0] + step_s * np.arange(round((at_s[-1] - at_s[0]) / step_s) + 2)
    even = np.stack([np.interp(even_s, at_s, column) for column in samples.T], axis=1)
    rates, forces, fields = (np.ascontiguousarray(even[:, i : i + 3]) for i in (0, 3, 6))
    even_wxyz = _estimated(rates * rad_s, forces, fields if magnetic else None, step_s)
    _check_unit(table, rates * rad_s, forces, _unsteadiness(even_wxyz, forces), step_s)
    result = np.full((len(times_s), 4), np.nan)
    result[rows] = to_wxyz(Slerp(even_s, from_wxyz(even_wxyz))(at_s))
    told = (
        "north from the magnetometer" if magnetic else "no magnetometer: its heading is arbitrary"
    )
    note = (
        f"orientation found from gyroscope and accelerometer (VQF), {told}; find heading_deg with: "
        "fusecap calibrate imu"
    )
    return Orientation(result, (note,), heading_known=magnetic)


def _estimated(
    rates_rad_s: Float[np.ndarray, "n 3"],
    forces: Float[np.ndarray, "n 3"],
    fields: Float[np.ndarray, "n 3"] | None,
    step_s: float,
) -> Float[np.ndarray, "n 4"]:
    from vqf import offlineVQF

    if fields is None:
        return offlineVQF(rates_rad_s, forces, None, step_s)["quat6D"]
    return offlineVQF(rates_rad_s, forces, fields, step_s)["quat9D"]


def _unsteadiness(
    orientation_wxyz: Float[np.ndarray, "n 4"], forces: Float[np.ndarray, "n 3"]
) -> float:
    """Median angle [rad] from the measured force to up."""
    force = from_wxyz(orientation_wxyz).apply(forces)
    return float(np.median(np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2])))


def _check_unit(
    table: ImuTable,
    rates_rad_s: Float[np.ndarray, "n 3"],
    forces: Float[np.ndarray, "n 3"],
    unsteadiness: float,
    step_s: float,
) -> None:
    if unsteadiness < _UNSTEADY:
        return
    for factor, unit, other in (
        (np.pi / 180, "deg/s", "rad/s"),
        (180 / np.pi, "rad/s", "deg/s"),
    ):
        left = _unsteadiness(_estimated(factor * rates_rad_s, forces, None, step_s), forces)
        if left < _STEADIER * unsteadiness:
            raise InputError(
                f"{table.path}: the gyroscope is in {unit}, expected {other}: with it gravity "
                f"turns by {np.degrees(unsteadiness):.0f} deg, else by {np.degrees(left):.0f}; "
                "convert Gyr_X..Z"
            )
