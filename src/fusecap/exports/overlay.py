"""A video with the people found in it drawn in: limbs, boxes, a number each, mean confidence.

Left limbs are drawn bold. A person keeps number and colour while the keypoints of one picture lie
near those of the last; that is for the eye only, no other part of fusecap relies on it.
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
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.files import written_whole
from fusecap.geometry.same_people import same_people

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
    unit = max(1, round(max(image.shape[:2]) / 700))
    for person, number in zip(people, numbers, strict=True):
        colour = COLOURS_BGR[(number - 1) % len(COLOURS_BGR)]
        seen = person[:, 2] >= _DRAWN_FROM
        pixels = np.round(np.where(seen[:, None], person[:, :2], 0.0)).astype(int)
        for a, b in LINKS:
            i, j = landmarks.index(a), landmarks.index(b)
            if i is not None and j is not None and seen[i] and seen[j]:
                bold = a.startswith("left") and b.startswith("left")
                ends = _point(pixels[i]), _point(pixels[j])
                cv2.line(image, *ends, colour, 3 * unit if bold else unit, cv2.LINE_AA)
        for pixel in pixels[seen]:
            cv2.circle(image, _point(pixel), 2 * unit, colour, -1, cv2.LINE_AA)
        if seen.any():
            low, high = _point(pixels[seen].min(axis=0)), _point(pixels[seen].max(axis=0))
            cv2.rectangle(image, low, high, colour, unit)
            _write(image, f"{number}  {person[seen, 2].mean():.2f}", low, colour, unit)


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
    image: np.ndarray, text: str, corner: tuple[int, int], colour: tuple[int, int, int], unit: int
) -> None:
    scale = 0.45 * unit
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, unit)
    x = min(max(corner[0], 0), max(image.shape[1] - width, 0))
    y = max(corner[1] - 2 * unit, height + unit)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 3 * unit)
    cv2.putText(image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, unit, cv2.LINE_AA)


def _point(pixel: np.ndarray) -> tuple[int, int]:
    return int(pixel[0]), int(pixel[1])
