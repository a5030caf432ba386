"""Where the board is in each camera's images: folders, globs or videos, and which belong together.

Cameras are in step by an instant, a whole number: the frame's number in a video, the last number
in an image's name (`cam_2_frame_0350.jpg` is 350), or the `sync_index` of a timestamps file as
caliscope writes it (`sync_index, cam_id, frame_time`; a camera's rows are its frames in order). One
image per camera is one instant.
"""

from __future__ import annotations

import csv
import glob
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from fusecap.calibrate.cameras.board import (
    Board,
    BoardView,
    larger_than_stated,
    why_not_found,
)
from fusecap.errors import CalibrationError, nearest
from fusecap.inputs import FRAME_TIMES, PICTURE, read_bytes, read_text
from fusecap.progress import Progress
from fusecap.sources.video import VIDEO_SUFFIXES, Video

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
MAX_INSPECTED = 240
"""Frames of a video in which the board is searched, evenly spread, unless `every` is given."""
BLURRED = 0.4
"""A view whose edges are this share or less as steep as the camera's median view is not used."""

_KEPT_FOR_CLUES = 6


@dataclass(frozen=True, kw_only=True)
class Shot:
    """One image that shows the board."""

    instant: int
    label: str
    """'frame 12', or the image's name."""
    view: BoardView
    sharpness: float
    """Steepest edges on the board, in shares of its contrast per pixel."""


@dataclass(frozen=True, kw_only=True)
class CameraShots:
    """All a camera saw of the board."""

    name: str
    source: str
    size_px: tuple[int, int]
    """Width, height."""
    inspected: int
    """Images in which the board was searched."""
    blurred: int
    """Views left out because they are blurred."""
    shots: tuple[Shot, ...]


@dataclass(frozen=True, kw_only=True)
class _Image:
    instant: int
    label: str
    grey: np.ndarray


def read_shots(
    name: str,
    source: str | Path,
    board: Board,
    *,
    every: int | None = None,
    sync: Sequence[int] | None = None,
    progress: Progress = lambda what, done, total: None,
) -> CameraShots:
    """The board in one camera's images; raises `CalibrationError` where none shows it.

    `sync` is the instant of each frame of a video, in order.
    """
    source = str(source)
    total, images = _images(source, every, sync)
    shots, sizes, without = [], {}, []
    checked = 0
    for number, image in enumerate(images, start=1):
        progress(f"board in {name}", number, total)
        size = (image.grey.shape[1], image.grey.shape[0])
        sizes.setdefault(size, image.label)
        if len(sizes) > 1:
            (a, in_a), (b, in_b) = list(sizes.items())[:2]
            raise CalibrationError(
                f"camera '{name}' ({source}): images are {a[0]} x {a[1]} ({in_a}) and {b[0]} x "
                f"{b[1]} px ({in_b}); a calibration holds for one size: keep images of one size"
            )
        view = board.detect(image.grey)
        if view is None:
            if len(without) < _KEPT_FOR_CLUES or number % 16 == 0:
                without = [*without, image.grey][-_KEPT_FOR_CLUES:]
            continue
        if checked < 2:
            checked += 1
            larger = larger_than_stated(board, image.grey)
            if larger:
                raise CalibrationError(f"camera '{name}' ({source}): {image.label}: {larger}")
        shots.append(
            Shot(
                instant=image.instant,
                label=image.label,
                view=view,
                sharpness=_sharpness(image.grey, view),
            )
        )
    if not shots:
        clue = why_not_found(board, without) or (
            f"the board file says {board.words}; check it, and that the entire board is lit, "
            "sharp and large enough (a marker's edge needs some 20 px)"
        )
        raise CalibrationError(
            f"camera '{name}' ({source}): the board is in none of {total} images; {clue}"
        )
    steepness = np.array([shot.sharpness for shot in shots])
    sharp = steepness > BLURRED * np.median(steepness)
    return CameraShots(
        name=name,
        source=source,
        size_px=next(iter(sizes)),
        inspected=total,
        blurred=int((~sharp).sum()),
        shots=tuple(shot for shot, ok in zip(shots, sharp, strict=True) if ok),
    )


def read_timestamps(path: Path | str) -> dict[str, list[int]]:
    """Per `cam_id` the `sync_index` of each of its frames, in order."""
    path = Path(path)
    try:
        rows = list(csv.DictReader(io.StringIO(read_text(path, FRAME_TIMES), newline="")))
    except csv.Error as error:
        raise CalibrationError(f"{path}: cannot be read: {error}") from None
    result: dict[str, list[tuple[float, int]]] = {}
    for line, row in enumerate(rows, start=2):
        try:
            camera = row.get("cam_id") or row["port"]
            result.setdefault(camera, []).append((float(row["frame_time"]), int(row["sync_index"])))
        except (KeyError, ValueError, TypeError):
            raise CalibrationError(
                f"{path}: line {line}: expected the columns sync_index, cam_id and frame_time "
                f"with numbers, found {dict(row)}"
            ) from None
    if not result:
        raise CalibrationError(f"{path}: no rows; expected sync_index, cam_id, frame_time")
    return {camera: [index for _, index in sorted(frames)] for camera, frames in result.items()}


def sync_of(name: str, source: str, by_id: Mapping[str, Sequence[int]]) -> Sequence[int]:
    """The timestamps of a camera: by its name, or the number at the end of its name or video's."""
    for text in (name, Path(source).stem):
        number = re.search(r"(\d+)$", text)
        for key in (text, str(int(number.group(1))) if number else text):
            if key in by_id:
                return by_id[key]
    raise CalibrationError(
        f"camera '{name}' ({source}): no rows of its own among the timestamps{nearest(name, by_id)}"
    )


def common_step(sources: Iterable[str]) -> int:
    """Every how many frames to search videos that are in step: the same frames of all of them."""
    frames = [Video(path).info.frames for path in map(Path, sources) if _is_video(path)]
    return max([1, *(-(-count // MAX_INSPECTED) for count in frames)])


def in_step(cameras: Sequence[CameraShots]) -> tuple[CameraShots, ...]:
    """Checks that instants can be shared; one image per camera is one instant."""
    if all(len(camera.shots) == 1 and camera.inspected == 1 for camera in cameras):
        return tuple(
            replace(camera, shots=(replace(camera.shots[0], instant=0),)) for camera in cameras
        )
    return tuple(cameras)


def diverse(shots: Sequence[Shot], count: int, size_px: tuple[int, int]) -> list[Shot]:
    """At most `count` views that differ most in place, size and tilt of the board, in order.

    Starts with the view of most corners; each next one is the farthest from those taken.
    """
    if len(shots) <= count:
        return list(shots)
    look = np.array([_look(shot.view, size_px) for shot in shots])
    taken = [int(np.argmax([len(shot.view) for shot in shots]))]
    distance = np.linalg.norm(look - look[taken[0]], axis=1)
    while len(taken) < count:
        taken.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(look - look[taken[-1]], axis=1))
    return [shots[index] for index in sorted(taken)]


def _look(view: BoardView, size_px: tuple[int, int]) -> np.ndarray:
    """Place, extent and shape in the image: what the mean and covariance of its corners show."""
    scaled = view.pixels / max(size_px)
    centred = scaled - scaled.mean(axis=0)
    _, s, vt = np.linalg.svd(centred / np.sqrt(len(view)), full_matrices=False)
    root = vt.T @ np.diag(s) @ vt
    return np.concatenate([scaled.mean(axis=0), 3 * root[np.triu_indices(2)]])


def _images(
    source: str, every: int | None, sync: Sequence[int] | None
) -> tuple[int, Iterator[_Image]]:
    path = Path(source)
    if _is_video(path):
        video = Video(path)
        frames = video.info.frames
        if sync is not None and abs(len(sync) - frames) > 1:
            raise CalibrationError(
                f"{path}: {frames} frames, but {len(sync)} timestamps; they belong to another video"
            )
        step = every or max(1, -(-frames // MAX_INSPECTED))
        wanted = (
            {n for n, instant in enumerate(sync) if instant % step == 0}
            if sync is not None
            else set(range(0, frames, step))
        )
        return len(wanted), _frames(video, wanted, sync)
    files = _files(source, path)
    files = files[:: every or 1]
    return len(files), _stills(files)


def _is_video(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def _files(source: str, path: Path) -> list[Path]:
    if path.is_dir():
        files = [file for file in path.iterdir() if not file.name.startswith(".")]
    elif path.is_file():
        files = [path]
    else:
        files = [Path(file) for file in glob.glob(source)]
        if not files:
            raise CalibrationError(
                f"{source}: no such video, image, folder or pattern; expected a video "
                f"({', '.join(VIDEO_SUFFIXES[:4])}, ...), a folder of images, or 'left_*.png'"
            )
    files = sorted(file for file in files if file.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise CalibrationError(
            f"{source}: holds no images; expected {', '.join(IMAGE_SUFFIXES)}, or name a video"
        )
    return files


def read_grey(file: Path | str) -> np.ndarray:
    """(h, w) uint8, the picture in a file; raises `InputError`."""
    try:
        content = np.frombuffer(read_bytes(file, PICTURE), np.uint8)
        grey = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE)
    except cv2.error:  # nothing to decode, or more pixels than OpenCV reads
        grey = None
    if grey is None:
        raise CalibrationError(f"{file}: not a readable image; copy it again or remove it")
    return grey


def _stills(files: Sequence[Path]) -> Iterator[_Image]:
    numbers = [re.findall(r"\d+", file.stem) for file in files]
    instants = [int(n[-1]) if n else -1 for n in numbers]
    if len(set(instants)) < len(files) or -1 in instants:
        instants = list(range(len(files)))
    for file, instant in zip(files, instants, strict=True):
        grey = read_grey(file)
        yield _Image(instant=instant, label=file.name, grey=grey)


def _frames(video: Video, wanted: set[int], sync: Sequence[int] | None) -> Iterator[_Image]:
    for frame in video.frames():
        if frame.number in wanted:
            instant = frame.number if sync is None else sync[frame.number]
            grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
            yield _Image(instant=instant, label=f"frame {frame.number}", grey=grey)


def _sharpness(grey: np.ndarray, view: BoardView) -> float:
    low = np.maximum(np.floor(view.pixels.min(axis=0)), 0).astype(int)
    high = np.ceil(view.pixels.max(axis=0)).astype(int) + 1
    part = grey[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if min(part.shape) < 3:
        return 0.0
    dark, bright = np.percentile(part, [5, 95])
    steep = np.hypot(cv2.Sobel(part, -1, 1, 0, scale=1 / 8), cv2.Sobel(part, -1, 0, 1, scale=1 / 8))
    return float(np.percentile(steep, 99) / max(bright - dark, 1.0))
