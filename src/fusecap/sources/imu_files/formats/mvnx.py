"""Xsens MVN `.mvnx`, versions 3 and 4: XML with one element per frame.

`sensorOrientation` (w, x, y, z per sensor) is imu_world (z up) from imu. Version 4 has
`sensorFreeAcceleration`: without gravity, in the imu world. Version 3 has `sensorAcceleration`:
specific force in the imu frame. Poses for calibration (identity, npose, tpose) are no samples.

How a sensor sits on its segment MVN has found in its own calibration: it is what turns the one into
the other, throughout (on the two files at hand within 0.1 to 2.7 degrees). How a segment's axes lie
in the T-pose, in a world whose x is forward and z up, is the frame `tpose`: along the world's but
for some degrees of the pelvis, and for the arms in version 3, which has them by ISB.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fusecap.errors import InputError
from fusecap.geometry.quaternions import from_wxyz
from fusecap.inputs import SENSORS
from fusecap.sources import safe_xml
from fusecap.sources.imu_files.loader import ImuFormat
from fusecap.sources.imu_files.table import chosen, number
from fusecap.sources.imu_files.track import ImuTrack, specific_force, tidy

_BONE_FROM_SEGMENT = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Of a segment whose axes are the world's in the T-pose."""


def read(path: Path, sensor: str | None, _rate_hz: float | None) -> ImuTrack:
    """The samples of one sensor; raises `InputError`."""
    root = _root(path)
    names = _names(root)
    name = chosen(path, sensor, names)
    index = names.index(name)
    frames = [f for f in root.iterfind(".//{*}frames/{*}frame") if f.get("type") == "normal"]
    if not frames:
        raise InputError(f"{path}: no frame of type 'normal'; export the recording again")
    quaternion = _vectors(frames, "sensorOrientation", index, 4)
    force = _vectors(frames, "sensorAcceleration", index, 3)
    free = _vectors(frames, "sensorFreeAcceleration", index, 3)
    if np.all(np.isnan(force)):
        measured = np.isfinite(free).any()
        force = specific_force(quaternion, free) if measured else None
    track = tidy(f"{path} sensor '{name}'", _times_s(root, frames), quaternion, force)
    return replace(track, bone_from_imu=_mounting(root, name, frames, quaternion))


def sensors(path: Path) -> tuple[str, ...]:
    """The sensors that the file holds."""
    return tuple(_names(_root(path)))


def _root(path: Path) -> ElementTree.Element:
    try:
        return safe_xml.parse(path, SENSORS)
    except safe_xml.XmlError as error:
        raise InputError(f"{path}: {error}") from None


def _mounting(
    root: ElementTree.Element, sensor: str, frames: list[ElementTree.Element], wxyz: np.ndarray
) -> np.ndarray | None:
    """bone_from_imu of a sensor called as its segment; None where segments are not exported."""
    segments = [element.get("label", "") for element in root.iterfind(".//{*}segments/{*}segment")]
    if sensor not in segments:
        return None
    segment = segments.index(sensor)
    turned = _vectors(frames, "orientation", segment, 4)
    both = (np.linalg.norm(turned, axis=1) > 0.1) & (np.linalg.norm(wxyz, axis=1) > 0.1)
    if not both.any():
        return None
    mounting = (from_wxyz(turned[both]).inv() * from_wxyz(wxyz[both])).mean().as_matrix()
    stated = [f for f in root.iterfind(".//{*}frames/{*}frame") if f.get("type") == "tpose"]
    tpose = _vectors(stated, "orientation", segment, 4)
    if len(tpose) and np.linalg.norm(tpose[0]) > 0.1:
        mounting = from_wxyz(tpose[0]).as_matrix() @ mounting
    return _BONE_FROM_SEGMENT @ mounting


def _names(root: ElementTree.Element) -> list[str]:
    return [element.get("label", "") for element in root.iterfind(".//{*}sensors/{*}sensor")]


def _times_s(root: ElementTree.Element, frames: list[ElementTree.Element]) -> np.ndarray:
    """Frame index over the frame rate; `time` is rounded to milliseconds."""
    subject = root.find("{*}subject")
    rate = number(subject.get("frameRate", "")) if subject is not None else float("nan")
    index = [frame.get("index") for frame in frames]
    if rate > 0 and all(text is not None for text in index):
        return np.array([number(text or "") for text in index]) / rate
    return np.array([number(frame.get("time", "")) for frame in frames]) / 1000.0


def _vectors(frames: list[ElementTree.Element], tag: str, sensor: int, size: int) -> np.ndarray:
    """(frames, size) of one sensor; NaN where the element is missing or cut short."""
    result = np.full((len(frames), size), np.nan)
    for row, frame in zip(result, frames, strict=True):
        words = (frame.findtext(f"{{*}}{tag}") or "").split()[sensor * size : (sensor + 1) * size]
        if len(words) == size:
            row[:] = [number(word) for word in words]
    return result


FORMAT = ImuFormat(read=read, sensors=sensors, suffixes=(".mvnx",))
