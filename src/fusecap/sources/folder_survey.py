"""What lies in a folder that has no session file yet: videos, keypoints, calibration, sensors."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fusecap.errors import FusecapError, InputError
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files.loader import load_rig, may_be_calibration
from fusecap.sources.calibration_files.plausibility import SAME_PLACE_M, camera_spread
from fusecap.sources.imu_files import imu_format_of, read_imu, sensor_names
from fusecap.sources.keypoint_files import sets_in
from fusecap.sources.sensor_bones import bone_of
from fusecap.sources.video import VIDEO_SUFFIXES

DEEPEST = 3
"""Folders below the surveyed one."""
WIDEST_IN_CM_M = 15.0
"""Between cameras: farther apart in centimetres they are taken to be in millimetres."""

_MADE = re.compile(
    r"[_-]?(?P<own>overlay)s?$|[_-](drawn|pose|openpose|rendered|skeleton|keypoints|labeled|annotated)$",
    re.IGNORECASE,
)
"""What programs append to the name of a video that they drew into."""
_MADE_FOLDERS = ("overlay", "overlays")
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
    up: str | None
    """Axis of its reference world that gravity is along, as the folder's first such file tells."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderSurvey:
    """Inputs that a folder holds; paths start at the folder."""

    folder: Path
    videos: tuple[Path, ...]
    made: tuple[Path, ...]
    """Videos that are drawings of others."""
    keypoints: dict[str, Path]
    """By camera."""
    keypoint_format: str | None
    """That of all cameras, as the number of values tells."""
    calibration: Path | None
    """The one that places the cameras best."""
    calibration_units: dict[str, float]
    """In which its cameras stand in a room, with how far apart [m]; cm and mm may both fit."""
    other_calibrations: tuple[Path, ...]
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
    calibration, units, others, cameras = _calibration(folder, files)
    videos, made = _videos(folder, files)
    return FolderSurvey(
        folder=folder,
        videos=videos,
        made=made,
        keypoints=keypoints,
        keypoint_format=_keypoint_format(folder, keypoints),
        calibration=calibration,
        calibration_units=units,
        other_calibrations=others,
        cameras=cameras,
        sensors=_sensors(folder, files),
    )


def _videos(folder: Path, files: list[Path]) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Recordings, and what was made of them: overlays, pictures of a take."""
    videos = [f.relative_to(folder) for f in files if f.suffix.lower() in VIDEO_SUFFIXES]
    stems = {path.stem for path in videos}
    made = [path for path in videos if _is_made(path, stems)]
    return tuple(path for path in videos if path not in made), tuple(made)


def _is_made(path: Path, stems: set[str]) -> bool:
    """Whether a video's name is another's with what a drawing of it is called."""
    if any(part in _MADE_FOLDERS for part in path.parts[:-1]):
        return True
    match = _MADE.search(path.stem)
    return match is not None and (path.stem[: match.start()] in stems or bool(match["own"]))


def _files(folder: Path, depth: int) -> Iterator[Path]:
    with os.scandir(folder) as entries:
        ordered = sorted(entries, key=lambda entry: entry.name)
    for entry in ordered:
        if entry.name.startswith("."):
            continue
        path = Path(entry.path)  # whose questions, unlike an entry's, a link to itself answers
        if path.is_file():
            yield path
        elif depth and path.is_dir():
            yield from _files(path, depth - 1)


def _calibration(
    folder: Path, files: list[Path]
) -> tuple[Path | None, dict[str, float], tuple[Path, ...], tuple[str, ...]]:
    """What places the cameras best, its units, the others that could be read, and its cameras.

    Lenses alone leave all cameras at one point; of files that place them, the one written last
    has had its floor found last.
    """
    readable: list[tuple[tuple[bool, bool, int, float], Path, dict[str, Rig]]] = []
    for file in (file for file in files if may_be_calibration(file)):
        rigs = _in_units(file)
        if rigs:
            placed = any(len(rig) < 2 or camera_spread(rig) > SAME_PLACE_M for rig in rigs.values())
            world = "world" in file.stem.lower()
            rank = (placed, world, -len(file.parts), file.stat().st_mtime)
            readable.append((rank, file.relative_to(folder), rigs))
    if not readable:
        return None, {}, (), ()
    readable.sort(key=lambda item: item[0], reverse=True)
    _, best, rigs = readable[0]
    units = {unit: camera_spread(rig) for unit, rig in rigs.items()}
    others = tuple(path for _, path, _ in readable[1:])
    return best, units, others, next(iter(rigs.values())).names


def _in_units(file: Path) -> dict[str, Rig]:
    """A calibration in metres, else in each unit in which its cameras stand in a room."""
    rigs: dict[str, Rig] = {}
    for unit in ("m", "cm", "mm"):
        with suppress(FusecapError):
            rig = load_rig(file, unit=unit)
            if unit == "m":
                return {unit: rig}
            if unit == "mm" or camera_spread(rig) <= WIDEST_IN_CM_M:
                rigs[unit] = rig
    return rigs


def _keypoint_format(folder: Path, keypoints: dict[str, Path]) -> str | None:
    for path in keypoints.values():
        try:
            alike = sets_in(folder / path)
        except InputError:
            continue
        if alike:
            return f"openpose-{alike[0].name}"
    return None


def _sensors(folder: Path, files: list[Path]) -> tuple[FoundSensor, ...]:
    found: list[FoundSensor] = []
    ups: dict[tuple[Path, str], str | None] = {}
    for file in files:
        format = imu_format_of(file)
        if format is None:
            continue
        try:
            names: tuple[str | None, ...] = sensor_names(file, format) or (None,)
        except InputError:
            continue
        system = (file.parent, format)
        if system not in ups:
            ups[system] = _up(file, format, names[0])
        found += [
            FoundSensor(
                file=file.relative_to(folder),
                format=format,
                sensor=name,
                bone=bone_of(name or file.stem),
                up=ups[system],
            )
            for name in names
        ]
    return tuple(found)


def _up(file: Path, format: str, sensor: str | None) -> str | None:
    try:
        return read_imu(file, format=format, sensor=sensor).up_axis
    except FusecapError:
        return None
