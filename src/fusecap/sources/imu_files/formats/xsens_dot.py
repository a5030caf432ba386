"""Xsens DOT recordings: `PacketCounter,SampleTimeFine,Quat_W..Z,FreeAcc_X..Z`.

`SampleTimeFine` counts microseconds in 32 bits, on one clock for synchronised sensors. `FreeAcc`
is acceleration without gravity in the imu world (z up).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import read_table
from fusecap.sources.imu_files.track import ImuTrack, SharedClock, specific_force, tidy, unwrapped

TICKS_PER_SECOND = 1e6
CLOCK_MODULUS = 2**32


def read(path: Path, _sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples, starting at time 0; raises `InputError`."""
    table = read_table(path, "PacketCounter")
    ticks = table.take(["SampleTimeFine"])[:, 0]
    quaternion = table.take(["Quat_W", "Quat_X", "Quat_Y", "Quat_Z"])
    counted = np.isfinite(ticks)
    ticks[counted] = unwrapped(ticks[counted], CLOCK_MODULUS)
    first = float(np.nanmin(ticks)) if counted.any() else 0.0
    return tidy(
        str(path),
        (ticks - first) / TICKS_PER_SECOND,
        quaternion,
        specific_force(quaternion, table.take_or_nan(["FreeAcc_X", "FreeAcc_Y", "FreeAcc_Z"])),
        clock=SharedClock(
            start_s=first / TICKS_PER_SECOND, period_s=CLOCK_MODULUS / TICKS_PER_SECOND
        ),
    )


FORMAT = ImuFormat(read=read, mark="SampleTimeFine")
