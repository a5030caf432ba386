"""One entrance to all IMU formats."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fusecap.errors import InputError, nearest
from fusecap.inputs import SENSORS, check_input, open_input
from fusecap.sources.imu_files.formats import NAMES, format_named
from fusecap.sources.imu_files.track import ImuTrack

_SNIFFED_BYTES = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuFormat:
    """What a format's module says of it."""

    read: Callable[[Path, str | None, float | None], ImuTrack]
    """Of a file the sensor of this name, at this rate where the file does not state one; raises
    `InputError`."""
    sensors: Callable[[Path], tuple[str, ...]] | None = None
    """Names of the sensors in a file that holds several."""
    suffixes: tuple[str, ...] = (".csv", ".txt", ".sto")
    marks: tuple[str, ...] = ("",)
    """One of them stands near the beginning of such a file, in any case of letters; a comma is
    whatever stands between cells."""


def read_imu(
    path: Path | str,
    *,
    format: str,
    sensor: str | None = None,
    rate_hz: float | None = None,
) -> ImuTrack:
    """The track of one sensor; raises `InputError`.

    `sensor` picks one of a file that holds several. `rate_hz` is used by formats that count
    samples, where the file does not state it.
    """
    path = Path(path)
    check_input(path, SENSORS)
    if format not in NAMES:
        raise InputError(f"no IMU format '{format}'{nearest(format, NAMES)}")
    return format_named(format).read(path, sensor, rate_hz)


def sensor_names(path: Path | str, format: str) -> tuple[str, ...]:
    """The sensors in a file of a format that holds several; empty for the others."""
    sensors = format_named(format).sensors
    return sensors(Path(path)) if sensors else ()


def imu_format_of(path: Path) -> str | None:
    """The format that the file's suffix and first characters tell, if any."""
    suffix = path.suffix.lower()
    likely = [name for name in NAMES if suffix in format_named(name).suffixes]
    if not likely or path.name.endswith(".qca.txt"):
        return None
    try:
        with open_input(path, SENSORS) as file:
            head = file.read(_SNIFFED_BYTES)
    except (InputError, OSError):
        return None
    text = head.replace(b"\0", b"").decode("utf-8", "replace").lower()
    text = re.sub("[\t;]", ",", text.replace('"', ""))
    return next((name for name in likely if _carries(format_named(name), text)), None)


def _carries(format: ImuFormat, text: str) -> bool:
    return any(mark.lower() in text for mark in format.marks)
