"""Xsens MT Manager text exports (MTw, MTi): `//` lines, then tab- or comma-separated columns.

Orientation is imu_world (z up) from imu, as one of
    Quat_q0..q3                w, x, y, z
    Mat[1][1]..Mat[3][3]       Mat[row][column], listed column by column
    Roll, Pitch, Yaw           degrees; Rz(yaw) Ry(pitch) Rx(roll)
    Gyr_X..Z                   rad/s, with Acc_X..Z and perhaps Mag_X..Z: see `raw`
`Acc_X..Z` is specific force in the imu frame. Time is `PacketCounter` (16 bits, common to the
sensors of one recording) over the update rate.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.raw import Orientation, orientation_from_raw
from fusecap.sources.imu_files.table import ImuTable, read_table
from fusecap.sources.imu_files.track import (
    ImuTrack,
    SharedClock,
    tidy,
    unwrapped,
    wxyz_of_euler,
    wxyz_of_matrices,
)

PACKET_MODULUS = 65536
_QUATERNION = [f"Quat_q{i}" for i in range(4)]
_MATRIX = [f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3)]
_EULER_XYZ = ["Roll", "Pitch", "Yaw"]
_RATE = re.compile(r"Update Rate:\s*(\d+(?:\.\d+)?)", re.IGNORECASE)


def read(path: Path, _sensor: str | None, rate_hz: float | None) -> ImuTrack:
    """The samples, starting at time 0; `rate_hz` is needed where the header does not say it."""
    table = read_table(path, "PacketCounter")
    rate = _rate_hz(table, rate_hz)
    counter = table.take(["PacketCounter"])[:, 0]
    counted = np.isfinite(counter)
    packets = np.full(len(counter), np.nan)
    packets[counted] = unwrapped(counter[counted], PACKET_MODULUS)
    if not counted.any():
        raise InputError(f"{path}: PacketCounter is empty; export it, it is the time of a sample")
    first = float(np.nanmin(packets))
    accelerations, notes = table.accelerations(["Acc_X", "Acc_Y", "Acc_Z"])
    times_s = (packets - first) / rate
    orientation = _orientation(table, times_s)
    return tidy(
        str(path),
        times_s,
        orientation.wxyz,
        accelerations,
        clock=SharedClock(start_s=first / rate, period_s=PACKET_MODULUS / rate),
        notes=(*orientation.notes, *notes),
        heading_known=orientation.heading_known,
    )


def _rate_hz(table: ImuTable, stated_hz: float | None) -> float:
    for line in table.preamble:
        match = _RATE.search(line)
        if match and float(match.group(1)) > 0:
            return float(match.group(1))
    if stated_hz is None:
        raise InputError(
            f"{table.path}: the header states no update rate; give rate_hz of this imu"
        )
    return stated_hz


def _orientation(table: ImuTable, times_s: np.ndarray) -> Orientation:
    if table.has(_QUATERNION):
        return Orientation(table.take(_QUATERNION))
    if table.has(_MATRIX):
        return Orientation(wxyz_of_matrices(table.take(_MATRIX).reshape(-1, 3, 3)))
    if table.has(_EULER_XYZ):
        return Orientation(wxyz_of_euler(table.take(_EULER_XYZ)))
    raw = orientation_from_raw(table, times_s, rad_s=1.0)
    if raw is not None:
        return raw
    raise InputError(
        f"{table.path}: no orientation; export quaternions (Quat_q0..3), the rotation matrix "
        "(Mat[1][1]..) or Euler angles (Roll, Pitch, Yaw) from MT Manager"
    )


FORMAT = ImuFormat(read=read, marks=("Quat_q0", "Mat[1][1]", "Roll,Pitch", "PacketCounter,Acc_X"))
