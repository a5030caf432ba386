"""`detection.json`: what a folder of keypoints that fusecap wrote was made from.

    {"format": "fusecap keypoints 1",
     "landmark_set": "halpe26",
     "detector": "...",                 networks by name and checksum, options that change results
     "video": {"name": "left.mp4", "bytes": 1048576, "sha256": "...",
               "size_px": [1920, 1080], "rate_hz": 60.0, "variable_rate": false},
     "times_ns": [0, 16666667, ...],    of every frame, since the first
     "complete": true}                  every frame has its file

It stands beside the frames, one file each, and says whether they can be used again.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import InputError
from fusecap.inputs import DETECTION, VIDEO, open_input, read_json
from fusecap.progress import Progress
from fusecap.sources.video import Video

FILE_NAME = "detection.json"
FORMAT = "fusecap keypoints 1"
_CHUNK_BYTES = 1 << 22


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoMark:
    """A video by name and content."""

    name: str
    bytes: int
    sha256: str
    size_px: tuple[int, int]
    """Width, height as shown."""
    rate_hz: float
    variable_rate: bool

    def is_likely(self, path: Path) -> bool:
        """Whether `path` has this name and size; its content is not read."""
        return path.is_file() and path.name == self.name and path.stat().st_size == self.bytes


@dataclass(frozen=True, kw_only=True)
class DetectionRecord:
    """What a folder of keypoints was made from."""

    landmark_set: str
    detector: str
    video: VideoMark
    times_ns: np.ndarray
    """(F,) int64, of every frame of the video, since the first."""
    complete: bool

    def frame_times_s(self, frames: np.ndarray) -> np.ndarray:
        """When frames were exposed, since the first.

        A constant rate is taken as such, without the container's rounding of timestamps.
        """
        if self.video.variable_rate:
            return self.times_ns[frames] * 1e-9
        return frames / self.video.rate_hz

    def same_work(self, other: DetectionRecord) -> bool:
        """Whether both are of the same pictures by the same detector."""
        return (self.video.sha256, self.detector, self.landmark_set, len(self.times_ns)) == (
            other.video.sha256,
            other.detector,
            other.landmark_set,
            len(other.times_ns),
        )

    def json(self) -> str:
        """The file's text."""
        return json.dumps(
            {
                "format": FORMAT,
                "landmark_set": self.landmark_set,
                "detector": self.detector,
                "video": asdict(self.video),
                "times_ns": self.times_ns.tolist(),
                "complete": self.complete,
            }
        )


def mark(video: Video, progress: Progress | None = None) -> VideoMark:
    """Name and content of a video; reads the whole file, in MB."""
    digest = hashlib.sha256()
    size = video.path.stat().st_size
    done = 0
    with open_input(video.path, VIDEO) as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
            done += len(chunk)
            if progress is not None:
                progress(f"reading {video.path.name} MB", done >> 20, size >> 20)
    return VideoMark(
        name=video.path.name,
        bytes=size,
        sha256=digest.hexdigest(),
        size_px=video.info.size_px,
        rate_hz=video.info.rate_hz,
        variable_rate=video.info.is_variable_rate,
    )


def read_record(folder: Path) -> DetectionRecord | None:
    """The record of a folder, None where it has none; raises `InputError` for a broken one."""
    path = folder / FILE_NAME
    if not path.exists():
        return None
    try:
        return _record(read_json(path, DETECTION))
    except InputError as error:
        raise InputError(f"{error}; delete the folder and detect again") from None
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise InputError(
            f"{path}: cannot be read ({type(error).__name__}: {error}); expected the record of a "
            "detection: delete the folder and detect again"
        ) from None


def _record(data: dict[str, Any]) -> DetectionRecord:
    if data["format"] != FORMAT:
        raise ValueError(f"format is {data['format']!r}, expected {FORMAT!r}")
    video = data["video"]
    width, height = video["size_px"]
    times_ns = np.array(data["times_ns"], dtype=np.int64)
    if times_ns.ndim != 1 or (np.diff(times_ns) <= 0).any():
        raise ValueError("times_ns is not a list of ascending times")
    return DetectionRecord(
        landmark_set=str(data["landmark_set"]),
        detector=str(data["detector"]),
        video=VideoMark(
            name=str(video["name"]),
            bytes=int(video["bytes"]),
            sha256=str(video["sha256"]),
            size_px=(int(_positive(width)), int(_positive(height))),
            rate_hz=_positive(video["rate_hz"]),
            variable_rate=bool(video["variable_rate"]),
        ),
        times_ns=times_ns,
        complete=bool(data["complete"]),
    )


def _positive(value: Any) -> float:
    if not 0 < float(value) < np.inf:
        raise ValueError(f"{value} where a number above zero is expected")
    return float(value)
