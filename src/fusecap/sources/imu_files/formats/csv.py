"""Our own CSV: `time_s,qw,qx,qy,qz,ax,ay,az`, further columns ignored (docs/formats.md).

The quaternion is imu_world_from_imu; acceleration is specific force in the imu frame [m/s²], and
may be left out or NaN. Without quaternions: `Gyr_X..Z` [rad/s], `Acc_X..Z` and perhaps `Mag_X..Z`
of the raw sensor. Times may also be `time_ms`, `time_us` or `time_ns`, and count from 1970, or
`time_iso`: moments by ISO 8601.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.errors import InputError
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.raw import Orientation, orientation_from_raw
from fusecap.sources.imu_files.table import read_table
from fusecap.sources.imu_files.track import ImuTrack, since_first, tidy

_SECONDS = {"time_s": 1.0, "time_ms": 1e-3, "time_us": 1e-6, "time_ns": 1e-9, "time_iso": 1.0}


def read(path: Path, _sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples; raises `InputError`."""
    table = read_table(path, *_SECONDS)
    unit = next((column for column in table.columns if column in _SECONDS), None)
    if unit is None:
        raise InputError(f"{path}: no column {' or '.join(_SECONDS)}, found {table.columns[:1]}")
    times_s, clock = since_first(table.take([unit])[:, 0] * _SECONDS[unit])
    quaternion = ["qw", "qx", "qy", "qz"]
    orientation = None
    if not table.has(quaternion):
        orientation = orientation_from_raw(table, times_s, rad_s=1.0)
    if orientation is not None:
        accelerations, notes = table.accelerations(["Acc_X", "Acc_Y", "Acc_Z"])
    else:
        orientation = Orientation(table.take(quaternion))
        accelerations, notes = table.accelerations(["ax", "ay", "az"])
    return tidy(
        str(path),
        times_s,
        orientation.wxyz,
        accelerations,
        clock=clock,
        notes=(*orientation.notes, *notes),
        heading_known=orientation.heading_known,
    )


FORMAT = ImuFormat(
    read=read,
    marks=tuple(f"{time},{second}" for time in _SECONDS for second in ("qw", "Gyr_X", "Acc_X")),
)
