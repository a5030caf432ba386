"""APDM Opal CSV: one file, several sensors, columns `<sensor>/Orientation/Scalar` and so on.

The line below the header holds units. Orientation is imu_world (z up) from imu; acceleration is
specific force in the imu frame.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import ImuTable, chosen, read_table
from fusecap.sources.imu_files.track import ImuTrack, tidy

_SCALAR = "/Orientation/Scalar"


def read(path: Path, sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples of one sensor; raises `InputError`."""
    table = read_table(path, "Time", units_line=True)
    name = chosen(path, sensor, _names(table))
    quaternion = [f"{name}/Orientation/{part}" for part in ("Scalar", "X", "Y", "Z")]
    return tidy(
        f"{path} sensor '{name}'",
        table.take(["Time"])[:, 0],
        table.take(quaternion),
        table.take_or_nan([f"{name}/Acceleration/{axis}" for axis in "XYZ"]),
    )


def sensors(path: Path) -> tuple[str, ...]:
    """The sensors that the file holds."""
    return _names(read_table(path, "Time", units_line=True))


def _names(table: ImuTable) -> tuple[str, ...]:
    return tuple(c.removesuffix(_SCALAR) for c in table.columns if c.endswith(_SCALAR))


FORMAT = ImuFormat(read=read, sensors=sensors, mark="Orientation/Scalar")
