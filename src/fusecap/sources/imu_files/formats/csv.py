"""Our own CSV: `time_s,qw,qx,qy,qz,ax,ay,az`, further columns ignored (docs/formats.md).

The quaternion is imu_world_from_imu; acceleration is specific force in the imu frame [m/s²], and
may be left out or NaN.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import read_table
from fusecap.sources.imu_files.track import ImuTrack, tidy


def read(path: Path, _sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples; raises `InputError`."""
    table = read_table(path, "time_s")
    return tidy(
        str(path),
        table.take(["time_s"])[:, 0],
        table.take(["qw", "qx", "qy", "qz"]),
        table.take_or_nan(["ax", "ay", "az"]),
    )


FORMAT = ImuFormat(read=read, mark="time_s,qw")
