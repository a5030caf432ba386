"""Xsens DOT recordings: `PacketCounter,SampleTimeFine,` and what the payload mode measured.

    Quat_W..Z or Euler_X..Z    imu_world (z up) from imu; Euler in degrees, Rz Ry Rx
    Gyr_X..Z                   deg/s, with Acc_X..Z and perhaps Mag_X..Z: see `raw`
    FreeAcc_X..Z or Acc_X..Z   without gravity in the imu world, or specific force in the imu frame

`SampleTimeFine` counts microseconds in 32 bits, on one clock for synchronised sensors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.raw import Orientation, orientation_from_raw
from fusecap.sources.imu_files.table import ImuTable, read_table
from fusecap.sources.imu_files.track import (
    ImuTrack,
    SharedClock,
    specific_force,
    tidy,
    unwrapped,
    wxyz_of_euler,
)

TICKS_PER_SECOND = 1e6
CLOCK_MODULUS = 2**32
_QUATERNION = ["Quat_W", "Quat_X", "Quat_Y", "Quat_Z"]
_EULER = ["Euler_X", "Euler_Y", "Euler_Z"]
_ACC = ["Acc_X", "Acc_Y", "Acc_Z"]
_FREE_ACC = ["FreeAcc_X", "FreeAcc_Y", "FreeAcc_Z"]


def read(path: Path, _sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples, starting at time 0; raises `InputError`."""
    table = read_table(path, "PacketCounter")
    ticks = table.take(["SampleTimeFine"])[:, 0]
    counted = np.isfinite(ticks)
    ticks[counted] = unwrapped(ticks[counted], CLOCK_MODULUS)
    first = float(np.nanmin(ticks)) if counted.any() else 0.0
    times_s = (ticks - first) / TICKS_PER_SECOND
    orientation = _orientation(table, times_s)
    if not table.has(_ACC) and table.has(_FREE_ACC):
        accelerations, notes = specific_force(orientation.wxyz, table.take(_FREE_ACC)), ()
    else:
        accelerations, notes = table.accelerations(_ACC)
    return tidy(
        str(path),
        times_s,
        orientation.wxyz,
        accelerations,
        clock=SharedClock(
            start_s=first / TICKS_PER_SECOND, period_s=CLOCK_MODULUS / TICKS_PER_SECOND
        ),
        notes=(*orientation.notes, *notes),
        heading_known=orientation.heading_known,
    )


def _orientation(table: ImuTable, times_s: np.ndarray) -> Orientation:
    if table.has(_QUATERNION):
        return Orientation(table.take(_QUATERNION))
    if table.has(_EULER):
        return Orientation(wxyz_of_euler(table.take(_EULER)))
    raw = orientation_from_raw(table, times_s, rad_s=np.pi / 180)
    if raw is not None:
        return raw
    raise InputError(
        f"{table.path}: no orientation (Quat_W..Z or Euler_X..Z); record in a payload mode that "
        "has one, such as 'Extended (Quaternion)' or 'Complete (Quaternion)'"
    )


FORMAT = ImuFormat(read=read, marks=("SampleTimeFine",))
