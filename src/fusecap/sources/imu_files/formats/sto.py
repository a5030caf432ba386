"""OpenSense `.sto`: header up to `endheader`, then tab columns; a cell is `w,x,y,z`.

Orientations only, imu_world from imu; the column's name is the sensor's.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.inputs import SENSORS, read_lines
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import chosen, number
from fusecap.sources.imu_files.track import ImuTrack, tidy


def read(path: Path, sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples of one column; raises `InputError`."""
    columns, body = _table(path)
    name = chosen(path, sensor, columns[1:])
    column = columns.index(name)
    rows = []
    for line in body:
        cells = line.split("\t")
        if len(cells) > column:
            rows.append([cells[0], *cells[column].split(",")])
    whole = [[number(cell) for cell in row] for row in rows if len(row) == 5]
    numbers = np.array(whole).reshape(-1, 5)
    return tidy(
        f"{path} sensor '{name}'",
        numbers[:, 0],
        numbers[:, 1:],
        None,
        notes=(f"{len(rows) - len(whole)} broken rows dropped",) if len(whole) < len(rows) else (),
    )


def sensors(path: Path) -> tuple[str, ...]:
    """The sensors that the file holds."""
    return tuple(_table(path)[0][1:])


def _table(path: Path) -> tuple[list[str], list[str]]:
    lines = [line.strip() for line in read_lines(path, SENSORS)]
    if "endheader" not in lines:
        raise InputError(f"{path}: no 'endheader' line; expected an OpenSense .sto")
    start = lines.index("endheader")
    header = [line.lower() for line in lines[:start]]
    if not any(line.startswith("datatype=quaternion") for line in header):
        raise InputError(f"{path}: no DataType=Quaternion in the header; expected orientations")
    body = [line for line in lines[start + 1 :] if line]
    if not body or not body[0].startswith("time"):
        raise InputError(f"{path}: no 'time' column below the header")
    return body[0].split("\t"), body[1:]


FORMAT = ImuFormat(read=read, sensors=sensors, marks=("DataType=Quaternion",))
