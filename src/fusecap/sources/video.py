"""Video files, frame by frame, each with the time it is to be shown at.

    Video(path).info                what the file is
    Video(path).frames(first=n)     its frames from the n-th on, decoded one at a time

Opening reads the timestamps of all packets without decoding them, so every frame has its number and
exact time before the first picture is decoded: cameras can be brought in step, a run resumed at
frame n and a broken picture skipped without shifting what follows.
Times start at 0 with the first frame shown. Pictures are turned as the file says they are to be
shown (phones store portrait videos lying on their side).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.frame import VideoFrame as DecodedFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream

from fusecap.errors import InputError
from fusecap.inputs import VIDEO, check_input

VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mts", ".mpg", ".mpeg")
"""What counts as a video in a folder."""

_ANY_TEXT: dict[str, Any] = (
    {"metadata_errors": "replace"} if int(av.__version__.partition(".")[0]) < 19 else {}
)
"""Titles in another encoding do not matter; PyAV 19, for Python 3.12 and newer, never minds."""
_EARLIER = (0, 100, 1000)
"""Frames by which a seek aims before its goal, tried in turn; then from the start."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoInfo:
    """What a video file is."""

    path: Path
    size_px: tuple[int, int]
    """Width, height as shown."""
    rotation_deg: int
    """By which the stored pictures are turned, counterclockwise: 0, 90, 180 or 270."""
    frames: int
    rate_hz: float
    """The constant rate, or the mean of a variable one."""
    is_variable_rate: bool
    """Whether times leave n / rate by more than the container's rounding."""
    duration_s: float
    """From the first frame to the end of the last."""
    codec: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoFrame:
    """One picture."""

    number: int
    """In the order shown, from 0; numbers of pictures that cannot be decoded are left out."""
    time_ns: int
    """Since the file's first frame."""
    image: np.ndarray
    """(h, w, 3) uint8, BGR."""


class Video:
    """A video file that can be read; raises `InputError` for one that cannot."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        with _opened(self.path) as (container, stream):
            self._pts = _timestamps(container, stream)
            claimed = stream.frames
            rate = float(stream.average_rate or stream.guessed_rate or 0)
            base = stream.time_base or 1  # since PyAV 19 no Fraction, but as rational
            tick = Fraction(base.numerator, base.denominator)
            codec = stream.codec_context.name
            claimed_s = None if container.duration is None else container.duration / 1e6
        if len(self._pts) == 0:
            raise InputError(f"{self.path}: a video without frames; record or copy it again")
        self._reformatter = VideoReformatter()
        first = self._first_frame()
        ns = (self._pts - self._pts[0]) * (tick * 1_000_000_000).numerator
        self.times_ns: np.ndarray = ns // (tick * 1_000_000_000).denominator
        """(F,) int64: when each frame is shown, since the first."""
        rate_hz, variable = _rate(self.times_ns, rate, float(tick))
        self._rotation_deg = _right_angle(self.path, first.rotation)
        turned = self._rotation_deg % 180 != 0
        self.info = VideoInfo(
            path=self.path,
            size_px=(first.height, first.width) if turned else (first.width, first.height),
            rotation_deg=self._rotation_deg,
            frames=len(self._pts),
            rate_hz=rate_hz,
            is_variable_rate=variable,
            duration_s=float(self.times_ns[-1]) * 1e-9 + 1.0 / rate_hz,
            codec=codec,
        )
        self.notes: tuple[str, ...] = self._cut_short(claimed, claimed_s)
        """What is odd about the file and was dealt with."""

    def frames(
        self, first: int = 0, *, wanted: Callable[[int], bool] | None = None
    ) -> Iterator[VideoFrame]:
        """Frames from number `first` on, the same as reading from the start would give.

        Pictures that cannot be decoded are left out, also at the end of a truncated file, and those
        whose number is not `wanted`; it is asked just before the picture is made.
        """
        if first >= len(self._pts):
            return
        for earlier in _EARLIER:
            if first - earlier <= 0:
                break
            start = self._keyframe_at(first - earlier)
            if start is not None and start <= first:
                yield from self._decoded(first, wanted, seek=first - earlier)
                return
        yield from self._decoded(first, wanted, seek=None)

    def _decoded(
        self, first: int, wanted: Callable[[int], bool] | None, *, seek: int | None
    ) -> Iterator[VideoFrame]:
        with _opened(self.path) as (container, stream):
            stream.thread_type = "AUTO"
            if seek is not None:
                container.seek(int(self._pts[seek]), stream=stream)
            number = -1
            for frame in _pictures(container, stream):
                number = self._number(frame, number)
                if number < first or (wanted is not None and not wanted(number)):
                    continue
                yield VideoFrame(
                    number=number, time_ns=int(self.times_ns[number]), image=self._image(frame)
                )

    def _number(self, frame: DecodedFrame, before: int) -> int:
        """By its timestamp; the one after `before` where the frame has none."""
        if frame.pts is None:
            return min(before + 1, len(self._pts) - 1)
        place = int(np.searchsorted(self._pts, frame.pts, side="right")) - 1
        return max(place, 0)

    def _keyframe_at(self, number: int) -> int | None:
        """The first whole picture that a seek to `number` arrives at.

        Pictures shown before it may lean on others that the seek has skipped.
        """
        with _opened(self.path) as (container, stream):
            try:
                container.seek(int(self._pts[number]), stream=stream)
            except FFmpegError:
                return None
            for frame in _pictures(container, stream):
                if frame.pts is None:
                    return None
                if frame.key_frame and not frame.is_corrupt:
                    return self._number(frame, -1)
        return None

    def _first_frame(self) -> DecodedFrame:
        with _opened(self.path) as (container, stream):
            for frame in _pictures(container, stream):
                return frame
        raise InputError(
            f"{self.path}: none of its {len(self._pts)} frames can be decoded; record or copy it "
            "again"
        )

    def _image(self, frame: DecodedFrame) -> np.ndarray:
        image = self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        if self._rotation_deg:
            image = np.rot90(image, self._rotation_deg // 90)
        width, height = self.info.size_px
        if image.shape != (height, width, 3):
            raise InputError(
                f"{self.path}: pictures change from {width} x {height} to {image.shape[1]} x "
                f"{image.shape[0]} in the middle; expected one size: cut the file there"
            )
        return np.ascontiguousarray(image)

    def _cut_short(self, claimed: int, claimed_s: float | None) -> tuple[str, ...]:
        frames, duration_s = self.info.frames, self.info.duration_s
        if claimed > frames:
            return (
                f"{self.path}: cut short, {frames} of {claimed} frames are there; "
                "the rest is missing",
            )
        if not claimed and claimed_s is not None and claimed_s > 1.05 * duration_s + 0.5:
            return (
                f"{self.path}: cut short, {duration_s:.1f} of {claimed_s:.1f} s are there; "
                "the rest is missing",
            )
        return ()


def probe(path: Path | str) -> VideoInfo:
    """What a video file is; raises `InputError` for one that cannot be read."""
    return Video(path).info


def check_video(path: Path | str) -> None:
    """Raises `InputError` for what is no video or cannot be decoded, without looking through it."""
    with _opened(Path(path)):
        pass


def videos_in(folder: Path) -> list[Path]:
    """The video files of a folder by name; raises `InputError` where there are none."""
    found = sorted(
        path
        for path in folder.iterdir()
        if path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")
    )
    if not found:
        raise InputError(f"{folder}: no videos; expected one per camera, e.g. left.mp4")
    return found


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """The file and its first video stream that is not a cover picture."""
    check_input(path, VIDEO)
    if path.stat().st_size == 0:
        raise InputError(f"{path}: an empty file, expected a video; record or copy it again")
    try:
        container: InputContainer = av.open(str(path), **_ANY_TEXT)
    except (FFmpegError, OSError) as error:
        reason = error.strerror or str(error)
        raise InputError(
            f"{path}: cannot be read as a video ({reason}); a recording that was not finished or "
            "copied whole lacks its index: record or copy it again, or repair it"
        ) from None
    with container:
        pictures = [
            s for s in container.streams.video if not s.disposition & Disposition.attached_pic
        ]
        if not pictures:
            kinds = ", ".join(sorted({s.type for s in container.streams})) or "nothing"
            raise InputError(f"{path}: no video in this file, found {kinds}; expected a video")
        if pictures[0].codec_context is None:
            raise InputError(f"{path}: a video that nothing here can decode; convert the file")
        yield container, pictures[0]


def _timestamps(container: InputContainer, stream: VideoStream) -> np.ndarray:
    """(F,) int64 presentation times in units of the time base, ascending, each once."""
    found: list[int] = []
    with contextlib.suppress(FFmpegError):
        for packet in container.demux(stream):
            if packet.size == 0 or packet.is_discard:
                continue
            stamp = packet.pts if packet.pts is not None else packet.dts
            found.append(stamp if stamp is not None else len(found))
    return np.unique(np.array(found, dtype=np.int64))


def _pictures(container: InputContainer, stream: VideoStream) -> Iterator[DecodedFrame]:
    """Everything that decodes, in the order shown; a broken packet is skipped."""
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets)
        except (StopIteration, FFmpegError):
            return
        try:
            decoded = packet.decode()
        except FFmpegError:
            continue
        for frame in decoded:
            if isinstance(frame, DecodedFrame):
                yield frame


def _rate(times_ns: np.ndarray, stated: float, tick_s: float) -> tuple[float, bool]:
    """The rate [Hz], and whether it varies by more than the rounding of timestamps.

    `stated` is the file's own [Hz]; 0: it says nothing.
    """
    if len(times_ns) < 2:
        return stated or 30.0, False
    times_s = times_ns * 1e-9
    mean_hz = (len(times_s) - 1) / float(times_s[-1])
    for rate_hz in ([stated] if stated else []) + [mean_hz]:
        rounding_s = min(1.5 * tick_s, 0.25 / rate_hz) + 1e-9
        if np.abs(times_s - np.arange(len(times_s)) / rate_hz).max() <= rounding_s:
            return rate_hz, False
    return mean_hz, True


def _right_angle(path: Path, rotation_deg: float) -> int:
    turned = round(rotation_deg) % 360
    if turned % 90:
        raise InputError(
            f"{path}: pictures are to be shown turned by {rotation_deg:g} deg; expected a right "
            "angle: convert the file"
        )
    return turned
