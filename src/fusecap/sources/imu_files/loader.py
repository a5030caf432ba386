"""One entrance to all IMU formats."""

from __future__ import annotations

from pathlib import Path

from fusecap.errors import InputError, nearest
from fusecap.sources.imu_files import apdm, csv, gaittoolbox, mvnx, sto, xsens_dot, xsens_mt
from fusecap.sources.imu_files.track import ImuTrack

_SEVERAL_SENSORS = {"mvnx": mvnx, "sto": sto, "apdm-csv": apdm}
_OWN_TIMES = {"csv": csv, "xsens-dot": xsens_dot}
_COUNTED = {"xsens-mt": xsens_mt, "gaittoolbox-csv": gaittoolbox}


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
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected IMU samples")
    if format in _SEVERAL_SENSORS:
        return _SEVERAL_SENSORS[format].read(path, sensor)
    if format in _OWN_TIMES:
        return _OWN_TIMES[format].read(path)
    if format in _COUNTED:
        return _COUNTED[format].read(path, rate_hz)
    known = (*_OWN_TIMES, *_COUNTED, *_SEVERAL_SENSORS)
    raise InputError(f"no IMU format '{format}'{nearest(format, known)}")


def sensor_names(path: Path | str, format: str) -> tuple[str, ...]:
    """The sensors in a file of a format that holds several; empty for the others."""
    module = _SEVERAL_SENSORS.get(format)
    return module.sensors(Path(path)) if module else ()
