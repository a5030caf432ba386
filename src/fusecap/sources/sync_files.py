"""Clocks as TOML: what `fusecap calibrate sync` writes and a session names.

format = "fusecap sync 1"
origin = "4 cameras, 2 IMU clocks; reference camera 'left'"

[camera.right]
offset_s = 0.01320          # session time = own time * (1 + drift_ppm / 1e6) + offset_s;
drift_ppm = 0.0             # own time is what the session file gives, its offset_s included
error_s = 0.0004            # standard error

[subject.anna.left_shank]
offset_s = -1.25000
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import InputError, nearest
from fusecap.sources.toml_text import quoted, read_written

FORMAT = "fusecap sync 1"
MAX_DRIFT_PPM = 10_000.0
"""A clock that runs more than one percent fast or slow has another rate than was said."""
_KEYS = ("format", "origin", "camera", "subject")
_CLOCK_KEYS = ("offset_s", "drift_ppm", "error_s")


@dataclass(frozen=True, slots=True, kw_only=True)
class Clock:
    """Session time = own time * (1 + drift_ppm / 1e6) + offset_s."""

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    error_s: float | None = None
    """Standard error of the offset; None: not known."""

    def session_s(self, own_s: np.ndarray) -> np.ndarray:
        """Session times of own ones."""
        return own_s * (1.0 + 1e-6 * self.drift_ppm) + self.offset_s


@dataclass(frozen=True, kw_only=True)
class Clocks:
    """Those that a file names; anything else keeps its times."""

    cameras: Mapping[str, Clock] = field(default_factory=dict)
    imus: Mapping[str, Mapping[str, Clock]] = field(default_factory=dict)
    """By subject and bone."""

    def camera(self, name: str) -> Clock:
        """A camera's."""
        return self.cameras.get(name, Clock())

    def imu(self, subject: str, bone: str) -> Clock:
        """A sensor's."""
        return self.imus.get(subject, {}).get(bone, Clock())


def sync_toml(clocks: Clocks, *, origin: str) -> str:
    """The text of a file; `origin` says how the clocks came about."""
    lines = [
        "# session time = own time * (1 + drift_ppm / 1e6) + offset_s",
        f"format = {quoted(FORMAT)}",
        f"origin = {quoted(origin)}",
    ]
    for name, clock in clocks.cameras.items():
        lines += ["", f"[camera.{quoted(name)}]", *_rows(clock)]
    for subject, sensors in clocks.imus.items():
        for bone, clock in sensors.items():
            lines += ["", f"[subject.{quoted(subject)}.{quoted(bone)}]", *_rows(clock)]
    return "\n".join(lines) + "\n"


def read_sync(path: Path | str) -> Clocks:
    """The clocks in a file; raises `InputError`."""
    path = Path(path)
    data = read_written(path, FORMAT, "fusecap calibrate sync")
    for key in data:
        if key not in _KEYS:
            raise InputError(f"{path}: unknown key '{key}'{nearest(key, _KEYS)}")
    return Clocks(
        cameras={
            name: _clock(path, f"camera.{name}", table)
            for name, table in _table(path, "camera", data.get("camera", {})).items()
        },
        imus={
            subject: {
                bone: _clock(path, f"subject.{subject}.{bone}", table)
                for bone, table in _table(path, f"subject.{subject}", sensors).items()
            }
            for subject, sensors in _table(path, "subject", data.get("subject", {})).items()
        },
    )


def _table(path: Path, where: str, table: Any) -> Mapping[str, Any]:
    if not isinstance(table, dict):
        raise InputError(f"{path}: [{where}] is {table!r}, expected a table")
    return table


def _clock(path: Path, where: str, table: Any) -> Clock:
    values: dict[str, float] = {}
    for key, value in _table(path, where, table).items():
        if key not in _CLOCK_KEYS:
            raise InputError(f"{path}: [{where}] unknown key '{key}'{nearest(key, _CLOCK_KEYS)}")
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not abs(value) <= sys.float_info.max:
            raise InputError(f"{path}: [{where}] {key} is {value!r}, expected a number")
        values[key] = float(value)
    if abs(values.get("drift_ppm", 0.0)) > MAX_DRIFT_PPM:
        raise InputError(
            f"{path}: [{where}] drift_ppm is {values['drift_ppm']:g}, expected at most "
            f"{MAX_DRIFT_PPM:g}; a clock this wrong has another rate_hz"
        )
    return Clock(**values)


def _rows(clock: Clock) -> list[str]:
    rows = [f"offset_s = {clock.offset_s + 0.0:.6f}", f"drift_ppm = {clock.drift_ppm + 0.0:.2f}"]
    return rows if clock.error_s is None else [*rows, f"error_s = {clock.error_s:.6f}"]
