"""APDM Opal CSV: one file, several sensors, in either layout.

    <sensor>/Orientation/Scalar,...    a line of names, then one of units; times in seconds
    Format=7,5700,,,Lumbar,...         serial and name over the columns of each sensor, then what
    Time,Accelerometer,,,Gyroscope,    they measure, then axes; times in microseconds since 1970
    ,X,Y,Z,X,...

Orientation is imu_world (z up) from imu; acceleration is specific force in the imu frame.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import ImuTable, chosen, read_table
from fusecap.sources.imu_files.track import ImuTrack, since_first, tidy

_SCALAR = "/Orientation/Scalar"
_NUMBERED = "Format="
_MICROSECOND_S = 1e-6


def read(path: Path, sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples of one sensor; raises `InputError`."""
    table = _table(path)
    name = chosen(path, sensor, _names(table))
    quaternion = [f"{name}/Orientation/{part}" for part in ("Scalar", "X", "Y", "Z")]
    times_s, clock = since_first(table.take(["Time"])[:, 0])
    acceleration = [f"{name}/Acceleration/{axis}" for axis in "XYZ"]
    return tidy(
        f"{path} sensor '{name}'",
        times_s,
        table.take(quaternion),
        table.take(acceleration) if table.has(acceleration) else None,
        clock=clock,
    )


def sensors(path: Path) -> tuple[str, ...]:
    """The sensors that the file holds."""
    return _names(_table(path))


def _names(table: ImuTable) -> tuple[str, ...]:
    return tuple(c.removesuffix(_SCALAR) for c in table.columns if c.endswith(_SCALAR))


def _table(path: Path) -> ImuTable:
    table = read_table(path, "Time")
    if table.preamble and table.preamble[0].startswith(_NUMBERED):
        return _named_from_above(table)
    return table


def _named_from_above(table: ImuTable) -> ImuTable:
    """Columns called as in the other layout, times in seconds."""
    over = [cell.strip() for cell in table.preamble[0].split(",")]
    starts = [i for i, cell in enumerate(over) if i and cell.isdigit()]
    if not starts or not table.units:
        raise InputError(f"{table.path}: no serial numbers over the columns; expected APDM's CSV")
    columns, quantity = list(table.columns), ""
    for start, end in pairwise([*starts, len(columns)]):
        sensor = next((cell for cell in over[start + 1 : end] if cell), over[start])
        for i in range(start, min(end, len(columns))):
            quantity = table.columns[i] or quantity
            axis = table.units[i] if i < len(table.units) else ""
            named = quantity.replace("Accelerometer", "Acceleration")
            columns[i] = f"{sensor}/{named}/{'Scalar' if axis == 'S' else axis}"
    seconds = np.array(table.rows)
    seconds[:, table.columns.index("Time")] *= _MICROSECOND_S
    return replace(table, columns=tuple(columns), rows=seconds)


FORMAT = ImuFormat(read=read, sensors=sensors, marks=("Orientation/Scalar", f"{_NUMBERED}7,"))
