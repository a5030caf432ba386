"""What gives a camera's pictures: FFmpeg for Linux devices and the network, OpenCV for webcams.

A grabber is one opened device. Its stamps:

- Linux devices (V4L2) stamp buffers with the monotonic clock, which is the session's; FFmpeg hands
  the stamp on as the packet's pts [1], OpenCV as `CAP_PROP_POS_MSEC` [2].
- RTSP and transport streams carry the sender's clock; `ClockMap` brings it to ours.
- Where FFmpeg only numbers the pictures (MJPEG over HTTP, raw streams), and on other systems'
  webcams, there is none, and the arrival counts.

[1] FFmpeg, libavdevice/v4l2.c, option `timestamps` = default. [2] OpenCV, cap_v4l.cpp.
"""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from jaxtyping import UInt8
from numpy import ndarray

from fusecap.live.devices.source import SessionClock, SourceLost
from fusecap.sources.live_address import URL_SCHEMES, Capture, V4l2, VideoUrl, Webcam

OPEN_S = 5.0
READ_S = 1.5
"""How long the network may be silent."""
NUMBERED = frozenset(("mpjpeg", "mjpeg", "image2", "image2pipe", "h264", "hevc", "mpegvideo"))
"""Formats of FFmpeg without times of their own."""
_INTERRUPTED = 1414092869
"""FFmpeg's AVERROR_EXIT, with which PyAV ends what takes too long."""
_PROTOCOLS = (*URL_SCHEMES, "tls", "crypto", "httpproxy", "rtmpt", "rtmps")


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One picture as it came in."""

    image: UInt8[ndarray, "h w 3"]
    """BGR."""
    arrival_ns: int
    """Of its data, before decoding, on the session's clock."""
    stamp_ns: int | None = None
    synchronised: bool = False
    """The stamp is on the session's clock."""


class Grabber(Protocol):
    """An opened camera."""

    def next(self) -> Picture | None:
        """The next picture; None where there is none yet. Raises `SourceLost`."""
        ...

    def take_broken(self) -> int:
        """How many could not be decoded since the last call."""
        ...

    def close(self) -> None:
        """Give the device back."""
        ...


class FfmpegGrabber:
    """Pictures through PyAV."""

    def __init__(
        self,
        name: str,
        url: str,
        clock: SessionClock,
        *,
        format: str | None,
        options: dict[str, str],
        device: bool,
    ) -> None:
        """`device`: stamps are of the monotonic clock, and reading does not wait."""
        import av
        from av.error import FFmpegError
        from av.video.reformatter import VideoReformatter

        self._name = name
        self._clock = clock
        self._device = device
        self._error = FFmpegError
        try:
            self._container = av.open(url, format=format, options=options, timeout=(OPEN_S, READ_S))
        except (FFmpegError, OSError, ValueError) as error:
            raise SourceLost(f"{name}: cannot be opened ({_reason(error)})") from None
        if not self._container.streams.video:
            self._container.close()
            raise SourceLost(f"{name}: no video there")
        self._stream = self._container.streams.video[0]
        # Frame threads would keep back a picture each.
        self._stream.thread_type = "SLICE"
        self._stamped = not set(self._container.format.name.split(",")) & NUMBERED
        self._reformatter = VideoReformatter()
        self._packets: Iterator[Any] = self._container.demux(self._stream)
        self._broken = 0

    def next(self) -> Picture | None:
        """None where the device has nothing yet, and for data that is no picture alone."""
        asked_ns = self._clock.now_ns()
        try:
            packet = next(self._packets)
        except StopIteration:
            raise SourceLost(f"{self._name}: the stream has ended") from None
        except BlockingIOError:
            self._packets = self._container.demux(self._stream)
            return None
        except (self._error, OSError) as error:
            raise SourceLost(f"{self._name}: {_reason(error)}") from None
        arrival_ns = self._clock.now_ns()
        if packet.size == 0:
            raise SourceLost(f"{self._name}: the stream has ended")
        if arrival_ns - asked_ns > 0.9 * READ_S * 1e9:
            # FFmpeg gives up, hands out what it had kept back, and would wait once more.
            raise SourceLost(f"{self._name}: it does not answer")
        try:
            frames = packet.decode()
        except self._error:
            self._broken += 1
            return None
        if not frames:
            return None
        frame = frames[-1]
        self._broken += bool(frame.is_corrupt)
        image = self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        stamp_ns = None
        if self._stamped and frame.pts is not None and frame.time_base is not None:
            stamp_ns = int(frame.pts * frame.time_base * 1_000_000_000)
            if self._device:
                stamp_ns = self._clock.from_monotonic_ns(stamp_ns)
        return Picture(
            image=image, arrival_ns=arrival_ns, stamp_ns=stamp_ns, synchronised=self._device
        )

    def take_broken(self) -> int:
        """Of packets and corrupt pictures."""
        broken, self._broken = self._broken, 0
        return broken

    def close(self) -> None:
        """Ends the connection."""
        self._container.close()


def open_v4l2(address: V4l2, clock: SessionClock) -> FfmpegGrabber:
    """A Linux device; raises `SourceLost`."""
    return FfmpegGrabber(
        address.device,
        address.device,
        clock,
        format="v4l2",
        options=v4l2_options(address.capture),
        device=True,
    )


def v4l2_options(capture: Capture) -> dict[str, str]:
    """As FFmpeg's v4l2 input names them; without a format MJPEG, which USB 2 carries in HD."""
    options = {"timestamps": "default", "fflags": "nonblock"}
    if capture.size_px is not None:
        options["video_size"] = f"{capture.size_px[0]}x{capture.size_px[1]}"
    if capture.rate_hz is not None:
        options["framerate"] = f"{capture.rate_hz:g}"
    if capture.format is not None:
        options["input_format"] = capture.format
    return options


def open_url(address: VideoUrl, clock: SessionClock) -> FfmpegGrabber:
    """A network camera; raises `SourceLost`."""
    return FfmpegGrabber(
        address.shown,
        address.url,
        clock,
        format=None,
        options=url_options(address.url),
        device=False,
    )


def url_options(url: str) -> dict[str, str]:
    """Little buffering, short patience, and no way from the network to files."""
    options = {
        "fflags": "nobuffer",
        "flags": "low_delay",
        "max_delay": "100000",
        "analyzeduration": "500000",
        "fpsprobesize": "0",
        "protocol_whitelist": ",".join(_PROTOCOLS),
    }
    if url.startswith("rtsp"):
        options["rtsp_transport"] = "tcp"
    return options


class OpenCvGrabber:
    """A webcam of any system."""

    def __init__(self, address: Webcam, clock: SessionClock) -> None:
        """Raises `SourceLost`."""
        import cv2

        self._name = f"webcam {address.index}"
        self._clock = clock
        self._cv2 = cv2
        # Whether the camera is there is said in fusecap's words.
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        linux = sys.platform == "linux"
        self._capture = cv2.VideoCapture(address.index, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
        if not self._capture.isOpened():
            self._capture.release()
            raise SourceLost(f"{self._name}: not there, or another program has it")
        asked = address.capture
        if asked.format is not None:
            code = {"mjpeg": "MJPG", "yuyv422": "YUYV"}.get(asked.format, asked.format.upper())
            if len(code) == 4:
                self._capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*code))
        if asked.size_px is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, asked.size_px[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, asked.size_px[1])
        if asked.rate_hz is not None:
            self._capture.set(cv2.CAP_PROP_FPS, asked.rate_hz)
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._monotonic = linux
        self._broken = 0

    def next(self) -> Picture | None:
        """Waits for the device, for as long as OpenCV does (10 s on Linux)."""
        if not self._capture.grab():
            raise SourceLost(f"{self._name}: gives no picture; unplugged?")
        arrival_ns = self._clock.now_ns()
        stamp_ms = self._capture.get(self._cv2.CAP_PROP_POS_MSEC) if self._monotonic else 0.0
        whole, image = self._capture.retrieve()
        if not whole or image is None or image.ndim != 3:
            self._broken += 1
            return None
        stamp_ns = self._clock.from_monotonic_ns(round(stamp_ms * 1e6)) if stamp_ms > 0 else None
        return Picture(image=image, arrival_ns=arrival_ns, stamp_ns=stamp_ns, synchronised=True)

    def take_broken(self) -> int:
        """Pictures that OpenCV could not decode."""
        broken, self._broken = self._broken, 0
        return broken

    def close(self) -> None:
        """Releases the device."""
        self._capture.release()


def _reason(error: Exception) -> str:
    if getattr(error, "errno", None) in (errno.ETIMEDOUT, _INTERRUPTED):
        return "it does not answer"
    return getattr(error, "strerror", None) or type(error).__name__
