"""What lies in a folder that has no session file yet: videos, keypoints, calibration, sensors."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.errors import FusecapError, InputError
from fusecap.inputs import KEYPOINTS, read_bytes
from fusecap.sources.calibration_files.loader import load_rig, may_be_calibration
from fusecap.sources.imu_files import imu_format_of, sensor_names
from fusecap.sources.sensor_bones import bone_of
from fusecap.sources.video import VIDEO_SUFFIXES

DEEPEST = 3
"""Folders below the surveyed one."""

_DECORATION = re.compile(r"[_-]?(json|keypoints|openpose|pose)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundSensor:
    """One sensor of one file."""

    file: Path
    format: str
    sensor: str | None
    """Its name in a file that holds several."""
    bone: str | None
    """As far as names tell."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderSurvey:
    """Inputs that a folder holds; paths start at the folder."""

    folder: Path
    videos: tuple[Path, ...]
    keypoints: dict[str, Path]
    """By camera."""
    keypoint_format: str | None
    """That of all cameras, as the number of values tells."""
    calibration: Path | None
    cameras: tuple[str, ...]
    """Of the calibration."""
    sensors: tuple[FoundSensor, ...]

    @property
    def nothing(self) -> bool:
        """Whether there is no recording at all."""
        return not (self.videos or self.keypoints or self.sensors)


def survey(folder: Path) -> FolderSurvey:
    """Looks at names and at the first bytes; raises `InputError` where `folder` is none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected one with videos or sensor files")
    files = list(_files(folder, DEEPEST))
    keypoints: dict[str, Path] = {}
    for file in files:
        if file.suffix == ".json" and re.search(r"\d(_keypoints)?$", file.stem):
            name = _DECORATION.sub("", file.parent.name) or file.parent.name
            keypoints.setdefault(name, file.parent.relative_to(folder))
    calibration, cameras = _calibration(folder, files)
    return FolderSurvey(
        folder=folder,
        videos=tuple(f.relative_to(folder) for f in files if f.suffix.lower() in VIDEO_SUFFIXES),
        keypoints=keypoints,
        keypoint_format=_keypoint_format(folder, keypoints),
        calibration=calibration,
        cameras=cameras,
        sensors=tuple(sensor for file in files for sensor in _sensors(folder, file)),
    )


def _files(folder: Path, depth: int) -> Iterator[Path]:
    with os.scandir(folder) as entries:
        ordered = sorted(entries, key=lambda entry: entry.name)
    for entry in ordered:
        if entry.name.startswith("."):
            continue
        if entry.is_file():
            yield Path(entry.path)
        elif depth and entry.is_dir():
            yield from _files(Path(entry.path), depth - 1)


def _calibration(folder: Path, files: list[Path]) -> tuple[Path | None, tuple[str, ...]]:
    """The first file that reads as a calibration, the least deep one first."""
    candidates = [file for file in files if may_be_calibration(file)]
    for file in sorted(candidates, key=lambda file: len(file.parts)):
        for unit in ("m", "mm"):
            try:
                return file.relative_to(folder), load_rig(file, unit=unit).names
            except FusecapError:
                continue
    return None, ()


def _keypoint_format(folder: Path, keypoints: dict[str, Path]) -> str | None:
    for path in keypoints.values():
        for file in sorted((folder / path).glob("*.json")):
            alike = [s.name for s in LANDMARK_SETS.values() if _holds(file, s)]
            if alike:
                return f"openpose-{alike[0]}"
    return None


def _holds(file: Path, landmarks: LandmarkSet) -> bool:
    """Whether the file's first person has as many keypoints as the set."""
    try:
        people = json.loads(read_bytes(file, KEYPOINTS))["people"]
        return len(people[0]["pose_keypoints_2d"]) == 3 * len(landmarks.landmark_names)
    except (InputError, ValueError, KeyError, IndexError, TypeError, RecursionError):
        return False


def _sensors(folder: Path, file: Path) -> list[FoundSensor]:
    format = imu_format_of(file)
    if format is None:
        return []
    try:
        names = sensor_names(file, format)
    except InputError:
        return []
    path = file.relative_to(folder)
    if not names:
        return [FoundSensor(file=path, format=format, sensor=None, bone=bone_of(file.stem))]
    return [
        FoundSensor(file=path, format=format, sensor=name, bone=bone_of(name)) for name in names
    ]
