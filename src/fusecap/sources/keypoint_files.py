"""OpenPose JSON: one folder per camera, one file per frame.

    {"people": [{"pose_keypoints_2d": [x, y, confidence, ...], "appearance": [0, 17, ...]}, ...]}

The last number of a file's name is its frame. A frame without a file holds nobody. A keypoint at
(0, 0) or with confidence 0 is missing: NaN, NaN, 0 from here on. Folders that fusecap wrote carry
the frames' own times (`fusecap.sources.detection_files`), and how people's clothes look
(`fusecap.appearance`); other programs' have no `appearance`.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.appearance import APPEARANCE_SIZE, unknown
from fusecap.believable import believable_keypoints, surest_rows
from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.errors import InputError
from fusecap.inputs import KEYPOINTS, read_bytes
from fusecap.progress import Progress
from fusecap.sources.detection_files import read_record
from fusecap.sources.keypoint_tables import BODY_POINTS, LANDMARK_SET, SUFFIX, read_table
from fusecap.sources.people_store import PeopleStore

MAX_FRAME = 10**9
"""Longer numbers are dates or serials."""

LEAST_STEPPED = 10
"""Fewer frames say nothing about how a detector counts."""
REGULAR_SHARE = 0.5
"""Of the steps between frames, for those that skip more to be frames without people."""
_OLD_KEY = "pose_keypoints"
_KNOWN_SETS = "known are " + ", ".join(
    f"{landmarks.keypoint_count} (openpose-{landmarks.name})"
    for landmarks in LANDMARK_SETS.values()
)
_FRAME_NUMBER = re.compile(r"(\d+)(?:_keypoints)?$")


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointTrack:
    """Everyone that one camera's detector found."""

    name: str
    landmarks: LandmarkSet
    rate_hz: float
    frames: np.ndarray
    """(F,) frame numbers, ascending; a missing number is a frame without people."""
    step: int = 1
    """Of its video's frames every so many were looked at, and numbered; `frames` counts these."""
    times_s: np.ndarray
    """(F,) on the session's clock: frame / rate, or the video's own time, + offset."""
    people: Sequence[np.ndarray]
    """Per frame (n, K, 3): x [px], y [px], confidence 0-1; NaN, NaN, 0 where missing."""
    appearance: Sequence[np.ndarray] | None = None
    """Per frame (n, 40), uint8, how their clothes look; None where no picture told."""
    broken: tuple[str, ...]
    """Names of unreadable files, taken as frames without people."""


class _BrokenFile(Exception):
    """Truncated or garbled JSON."""


def read_keypoints(
    folder: Path,
    *,
    name: str,
    landmarks: LandmarkSet,
    rate_hz: float,
    offset_s: float = 0.0,
    own_times: bool = True,
    place: tuple[int, int] = (0, 1),
    progress: Progress | None = None,
) -> KeypointTrack:
    """All frames of one camera, whose `place` in a table of several is (row, rows).

    With `own_times` the times and rate that a detection left beside the frames replace `rate_hz`.
    Raises `InputError` for a folder without frames, one whose files are all broken, and keypoints
    of another format; a broken file among good ones counts as a frame without people.
    """
    if folder.suffix == SUFFIX and folder.is_file():
        return _of_table(
            folder, place, name=name, landmarks=landmarks, rate_hz=rate_hz, offset_s=offset_s
        )
    numbered = _numbered_files(folder)
    people = PeopleStore(len(landmarks.landmark_names), 3)
    looks = PeopleStore(APPEARANCE_SIZE, dtype=np.uint8)
    shown = False
    broken: list[str] = []
    for done, file in enumerate(numbered.values(), start=1):
        try:
            found, appearance = _read_frame(os.path.join(folder, file), landmarks)
        except _BrokenFile:
            found, appearance = np.empty((0, len(landmarks.landmark_names), 3)), unknown(0)
            broken.append(file)
        people.append(found)
        looks.append(appearance)
        shown = shown or bool(appearance.any())
        if progress is not None:
            progress(f"camera '{name}'", done, len(numbered))
    if len(broken) == len(numbered):
        raise InputError(
            f"{folder}: none of the {len(numbered)} keypoint files can be read "
            f"(first: {broken[0]}); expected OpenPose JSON: run the detector again"
        )
    frames = np.fromiter(numbered, dtype=np.int64)
    times_s = frames / rate_hz
    record = read_record(folder) if own_times else None
    if record is not None:
        if frames[-1] >= len(record.times_ns):
            raise InputError(
                f"{folder}: frame {frames[-1]} is not in the video that was detected, which has "
                f"{len(record.times_ns)}; delete the folder and detect again"
            )
        times_s, rate_hz = record.frame_times_s(frames), record.video.rate_hz
    step = frame_step(frames)
    return KeypointTrack(
        name=name,
        landmarks=landmarks,
        rate_hz=rate_hz / step,
        frames=frames // step,
        step=step,
        times_s=times_s + offset_s,
        people=people,
        appearance=looks if shown else None,
        broken=tuple(broken),
    )


def _of_table(
    path: Path,
    place: tuple[int, int],
    *,
    name: str,
    landmarks: LandmarkSet,
    rate_hz: float,
    offset_s: float,
) -> KeypointTrack:
    if landmarks.keypoint_count != BODY_POINTS:
        raise InputError(
            f"{path}: FreeMoCap's points are openpose-{LANDMARK_SET}, the cameras have "
            f"openpose-{landmarks.name}"
        )
    found = read_table(path, *place)
    people = PeopleStore(len(landmarks.landmark_names), 3)
    for person in found:
        people.append(without_missing(landmarks.of_keypoints(person[None])))
    frames = np.arange(len(found))
    return KeypointTrack(
        name=name,
        landmarks=landmarks,
        rate_hz=rate_hz,
        frames=frames,
        times_s=frames / rate_hz + offset_s,
        people=people,
        broken=(),
    )


def frame_step(frames: np.ndarray) -> int:
    """How far apart frame numbers regularly are: 1, or what all of many are multiples of."""
    if len(frames) < LEAST_STEPPED:
        return 1
    steps = np.diff(frames)
    step = int(np.gcd.reduce(steps))
    return step if step > 1 and np.mean(steps == step) > REGULAR_SHARE else 1


def frame_number(name: str) -> int | None:
    """The frame that a file's name ends in; None for other files."""
    stem, suffix = os.path.splitext(name)
    match = _FRAME_NUMBER.search(stem) if suffix == ".json" else None
    return int(match.group(1)) if match else None


def _numbered_files(folder: Path) -> dict[int, str]:
    """Names by frame number, which rises."""
    if folder.is_file():
        raise InputError(
            f"{folder}: is a file; expected a folder with one keypoint JSON per frame, as OpenPose "
            "writes them, or FreeMoCap's 2D data (.npy). Tables of another program go in through "
            "Python (examples/1_own_detections.py)"
        )
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected one keypoint JSON per frame")
    by_frame: dict[int, str] = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            number = frame_number(entry.name)
            if number is None:
                continue
            if number >= MAX_FRAME:
                raise InputError(
                    f"{entry.path}: frame {number} is out of range; expected a name that ends in "
                    "the frame's number"
                )
            if number in by_frame:
                pair = sorted((by_frame[number], entry.name))
                raise InputError(
                    f"{folder}: {pair[0]} and {pair[1]} are both frame {number}; "
                    "expected one folder per camera"
                )
            by_frame[number] = entry.name
    if not by_frame:
        raise InputError(
            f"{folder}: no keypoint files; expected one .json per frame whose name ends in the "
            "frame's number"
        )
    return {number: by_frame[number] for number in sorted(by_frame)}


def read_people(path: Path, landmarks: LandmarkSet) -> np.ndarray | None:
    """(n, K, 3) the people of one file; None for one that is truncated, garbled or gone."""
    try:
        return _read_frame(str(path), landmarks)[0]
    except _BrokenFile:
        return None


def _read_frame(path: str, landmarks: LandmarkSet) -> tuple[np.ndarray, np.ndarray]:
    """People (n, K, 3), and how their clothes look (n, 40)."""
    persons = [(values, looks) for values, looks in _persons(path) if values]
    flat = [values for values, _ in persons]
    for values in flat:
        if len(values) != 3 * landmarks.keypoint_count:
            raise _wrong_count(path, landmarks, values)
    try:
        people = np.array(flat, dtype=np.float64).reshape(len(flat), landmarks.keypoint_count, 3)
    except (ValueError, TypeError, OverflowError):
        raise _BrokenFile from None
    people = _with_nan(landmarks.of_keypoints(people))
    rows = surest_rows(people)
    return people[rows], np.array([_bytes(looks) for _, looks in persons], np.uint8)[rows]


def _persons(path: str) -> list[tuple[list[Any], Any]]:
    """Everyone's numbers in one file; OpenPose left `_2d` out of their key before 2018."""
    try:
        people = json.loads(read_bytes(path, KEYPOINTS))["people"]
        persons = [
            (
                person["pose_keypoints_2d"] if "pose_keypoints_2d" in person else person[_OLD_KEY],
                person.get("appearance"),
            )
            for person in people
        ]
    except (ValueError, KeyError, TypeError, AttributeError, InputError, RecursionError):
        raise _BrokenFile from None
    if not all(isinstance(values, list) for values, _ in persons):
        raise _BrokenFile
    return persons


def _bytes(looks: Any) -> list[int]:
    """How somebody's clothes look; zeros for what cannot be that."""
    if not isinstance(looks, list) or len(looks) != APPEARANCE_SIZE:
        return [0] * APPEARANCE_SIZE
    whole = all(isinstance(value, int) and 0 <= value <= 255 for value in looks)
    return looks if whole else [0] * APPEARANCE_SIZE


def sets_in(folder: Path) -> list[LandmarkSet]:
    """Those with as many keypoints as the first person in a folder; raises `InputError`."""
    if folder.suffix == SUFFIX and folder.is_file():
        return [LANDMARK_SETS[LANDMARK_SET]]
    for file in _numbered_files(folder).values():
        try:
            persons = _persons(os.path.join(folder, file))
            counts = {len(values) / 3 for values, _ in persons if values}
        except _BrokenFile:
            continue
        if counts:
            return [s for s in LANDMARK_SETS.values() if s.keypoint_count in counts]
    return []


def without_missing(people: np.ndarray) -> np.ndarray:
    """(n, K, 3) with missing keypoints as NaN, NaN, 0; people without any keypoint are left out.

    Of a crowd the surest are kept, see `fusecap.believable`.
    """
    people = _with_nan(people)
    return people[surest_rows(people)]


def _with_nan(people: np.ndarray) -> np.ndarray:
    confidence = people[:, :, 2]
    seen = np.any(people[:, :, :2] != 0, axis=2) & np.isfinite(confidence)
    people = np.where(seen[:, :, None], people, [np.nan, np.nan, 0.0])
    people[:, :, 2] = np.minimum(people[:, :, 2], 1.0)
    return believable_keypoints(people)


def _wrong_count(path: str, landmarks: LandmarkSet, values: list[Any]) -> InputError:
    found = len(values) / 3
    alike = [
        f"'openpose-{other.name}'"
        for other in LANDMARK_SETS.values()
        if other.keypoint_count == found
    ]
    advice = f"it looks like {' or '.join(alike)}: set format" if alike else _KNOWN_SETS
    return InputError(
        f"{path}: a person has {found:g} keypoints, expected the "
        f"{landmarks.keypoint_count} of 'openpose-{landmarks.name}'; {advice}"
    )
