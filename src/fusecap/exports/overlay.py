"""A video with people drawn in: those found in it, or those who were solved.

Left limbs are drawn bold. Of people found also boxes, a number each and mean confidence. A person
keeps number and colour while the keypoints of one picture lie near those of the last; that is for
the eye only, no other part of fusecap relies on it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.codec import codecs_available
from av.container import OutputContainer
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from jaxtyping import Bool, Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.exports.stick_figures import Sticks
from fusecap.files import written_whole
from fusecap.geometry.camera import Camera
from fusecap.geometry.same_people import same_people

Colour = tuple[int, int, int]
MOST_PX = 30_000
"""Of coordinates that are drawn."""
LINKS = (
    *(("nose", "neck"), ("nose", "upper_neck"), ("head_top", "neck"), ("neck", "mid_hip")),
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("head_top", "upper_neck")),
    *(("nose", "left_eye"), ("nose", "right_eye"), ("left_eye", "left_ear")),
    ("right_eye", "right_ear"),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            *(("shoulder", "elbow"), ("elbow", "wrist"), ("shoulder", "hip"), ("hip", "knee")),
            *(("knee", "ankle"), ("ankle", "big_toe"), ("ankle", "heel")),
            ("big_toe", "small_toe"),
        )
    ),
)
COLOURS_BGR = (
    *((86, 180, 255), (233, 180, 86), (115, 200, 60), (66, 228, 240), (200, 121, 204)),
    *((60, 80, 240), (230, 230, 230), (178, 114, 0)),
)
GREY_BGR = (190, 190, 190)
"""Of bystanders, and of bones that nothing measures."""
_DRAWN_FROM = 0.1
"""Confidence below which a keypoint is not drawn."""
_GATE = 0.5
"""Mean distance to the last picture's person, in body extents, up to which it is the same one."""
_TICKS_HZ = 60_000
"""Time base; MPEG-4 allows up to 65535 and 29.97 Hz fits."""


class PeopleNumbers:
    """Numbers people from one picture to the next."""

    def __init__(self) -> None:
        self._numbers: list[int] = []
        self._people: np.ndarray | None = None
        self._next = 1

    def update(self, people: Float[np.ndarray, "n k 3"]) -> list[int]:
        """The number of each person."""
        numbers = [0] * len(people)
        if self._people is not None:
            same = same_people(self._people, people, gate_extents=_GATE)
            for last, now in zip(*same, strict=True):
                numbers[now] = self._numbers[last]
        for index, number in enumerate(numbers):
            if number == 0:
                numbers[index] = self._next
                self._next += 1
        if len(people):
            self._numbers, self._people = numbers, people
        return numbers


def draw_people(
    image: np.ndarray,
    people: Float[np.ndarray, "n k 3"],
    numbers: list[int],
    landmarks: LandmarkSet,
) -> None:
    """Draws into a BGR image (h, w, 3)."""
    unit = _unit(image)
    for person, number in zip(people, numbers, strict=True):
        colour = COLOURS_BGR[(number - 1) % len(COLOURS_BGR)]
        seen = person[:, 2] >= _DRAWN_FROM
        pixels = np.round(np.where(seen[:, None], person[:, :2], 0.0)).astype(int)
        draw_limbs(image, person, landmarks, colour, unit, bold=3 * unit)
        for pixel in pixels[seen]:
            cv2.circle(image, _point(pixel), 2 * unit, colour, -1, cv2.LINE_AA)
        if seen.any():
            low, high = _point(pixels[seen].min(axis=0)), _point(pixels[seen].max(axis=0))
            cv2.rectangle(image, low, high, colour, unit)
            _write(image, f"{number}  {person[seen, 2].mean():.2f}", low, colour, unit)


def draw_limbs(
    image: np.ndarray,
    person: Float[np.ndarray, "k 3"],
    landmarks: LandmarkSet,
    colour: Colour,
    width: int,
    *,
    bold: int | None = None,
) -> None:
    """Lines between keypoints; those of left limbs `bold` wide."""
    for a, b in LINKS:
        i, j = landmarks.index(a), landmarks.index(b)
        if i is not None and j is not None and (person[[i, j], 2] >= _DRAWN_FROM).all():
            left = a.startswith("left") and b.startswith("left")
            _line(image, person[i], person[j], colour, (bold or width) if left else width)


def draw_bystander(
    image: np.ndarray, person: Float[np.ndarray, "k 3"], landmarks: LandmarkSet
) -> None:
    """Somebody who was found and is nobody's: thin and grey, and said to be so."""
    unit = _unit(image)
    draw_limbs(image, person, landmarks, GREY_BGR, unit)
    seen = person[:, 2] >= _DRAWN_FROM
    if seen.any():
        low = _point(np.round(person[seen, :2].min(axis=0)).clip(-MOST_PX, MOST_PX))
        _write(image, "not followed", low, GREY_BGR, unit)


def draw_solved(
    image: np.ndarray,
    camera: Camera,
    sticks: Sticks,
    colour: Colour,
    *,
    name: str = "",
    scale: float = 1.0,
    unit: int | None = None,
) -> None:
    """A solved person as a camera sees them; bones that nothing measures are dashed and grey.

    `scale`: of the image beside the camera's own pixels.
    """
    unit = unit or _unit(image)
    start, end = (camera.project(points) * scale for points in (sticks.start_m, sticks.end_m))
    for a, b, left, measured in zip(start, end, sticks.left, sticks.measured, strict=True):
        if measured:
            _line(image, a, b, colour, 4 * unit if left else 2 * unit)
        else:
            _dashes(image, a, b, unit)
    seen = np.concatenate([start, end])
    seen = seen[_near(seen)]
    if name and len(seen):
        _write(image, name, _point(np.round(seen.min(axis=0))), colour, unit)


@contextmanager
def overlay_writer(path: Path, size_px: tuple[int, int], rate_hz: float) -> Iterator[OverlayWriter]:
    """An .mp4 that takes its name once it is whole."""
    with (
        written_whole(path) as file,
        av.open(file, "w", format="mp4") as container,
    ):
        codec = "libx264" if "libx264" in codecs_available else "mpeg4"
        stream = container.add_stream(codec, rate=Fraction(rate_hz).limit_denominator(1001))
        stream.width, stream.height = size_px[0] // 2 * 2, size_px[1] // 2 * 2
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, _TICKS_HZ)
        if codec == "libx264":
            stream.options = {"crf": "26", "preset": "veryfast"}
        else:
            stream.bit_rate = size_px[0] * size_px[1] * 4
        writer = OverlayWriter(container, stream)
        yield writer
        writer.flush()


class OverlayWriter:
    """Encodes pictures at their own times."""

    def __init__(self, container: OutputContainer, stream: VideoStream) -> None:
        self._container = container
        self._stream = stream

    def add(self, image: np.ndarray, time_ns: int) -> None:
        """A BGR picture; an odd last row or column is left out."""
        even = image[: self._stream.height, : self._stream.width]
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(even), format="bgr24")
        frame.time_base = Fraction(1, _TICKS_HZ)
        frame.pts = round(time_ns * _TICKS_HZ / 1_000_000_000)
        self._container.mux(self._stream.encode(frame))

    def flush(self) -> None:
        """What the encoder still holds."""
        self._container.mux(self._stream.encode(None))


def _write(
    image: np.ndarray, text: str, corner: tuple[int, int], colour: Colour, unit: int
) -> None:
    scale = 0.45 * unit
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, unit)
    x = min(max(corner[0], 0), max(image.shape[1] - width, 0))
    y = max(corner[1] - 2 * unit, height + unit)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 3 * unit)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, unit, cv2.LINE_AA)


def _line(image: np.ndarray, a: np.ndarray, b: np.ndarray, colour: Colour, width: int) -> None:
    """Ends far outside, as of people beside a camera, are left out: they overflow OpenCV."""
    if _near(np.stack([a[:2], b[:2]])).all():
        ends = _point(np.round(a)), _point(np.round(b))
        cv2.line(image, *ends, colour, width, cv2.LINE_AA)


def _dashes(image: np.ndarray, a: np.ndarray, b: np.ndarray, unit: int) -> None:
    if not _near(np.stack([a, b])).all():
        return
    count = max(int(np.linalg.norm(b - a) / (12 * unit)), 1)
    for first in np.arange(count) / count:
        _line(image, a + (b - a) * first, a + (b - a) * (first + 0.5 / count), GREY_BGR, unit)


def _near(pixels: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    return np.asarray((np.abs(pixels) < MOST_PX).all(axis=1))


def _unit(image: np.ndarray) -> int:
    """Width of thin lines [px]."""
    return max(1, round(max(image.shape[:2]) / 700))


def _point(pixel: np.ndarray) -> tuple[int, int]:
    return int(pixel[0]), int(pixel[1])
