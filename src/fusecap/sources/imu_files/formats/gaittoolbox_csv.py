"""CSV samples of the gait-tech toolbox: `// fs=100 ...` lines, then `ori_1..4,acc_1..3,...`.

Orientation is w, x, y, z, imu_world (z up) from imu; acceleration is specific force in the imu
frame.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import read_table
from fusecap.sources.imu_files.track import ImuTrack, tidy

_RATE = re.compile(r"fs=\s*([\d.]+)")


def read(path: Path, _sensor: str | None, rate_hz: float | None) -> ImuTrack:
    """The samples, starting at time 0; `rate_hz` is needed where the header does not say it."""
    table = read_table(path, "ori_1")
    match = _RATE.search(" ".join(table.preamble))
    rate = float(match.group(1)) if match else rate_hz
    if not rate:
        raise InputError(f"{path}: the header states no fs; give rate_hz of this imu")
    accelerations, notes = table.accelerations([f"acc_{i}" for i in (1, 2, 3)])
    return tidy(
        str(path),
        np.arange(len(table.rows)) / rate,
        table.take([f"ori_{i}" for i in (1, 2, 3, 4)]),
        accelerations,
        notes=notes,
    )


FORMAT = ImuFormat(read=read, marks=("ori_1",))
