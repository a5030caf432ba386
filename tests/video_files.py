"""Writes small videos with known content."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

CODEC = {".mp4": "libx264", ".mkv": "libx264", ".avi": "mpeg4", ".webm": "libvpx"}
_IDENTITY = bytes.fromhex("00010000" + "00000000" * 3 + "00010000" + "00000000" * 3 + "40000000")
_CLOCKWISE = bytes.fromhex(
    "00000000" + "00010000" + "00000000" + "ffff0000" + "00000000" * 4 + "40000000"
)


def stripe(n: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """Frame n of a test video: its number as eight black or white fields, left to right."""
    image = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    for bit in range(8):
        if n >> bit & 1:
            image[:, bit * size[0] // 8 : (bit + 1) * size[0] // 8] = 255
    return image


def number_of(image: np.ndarray) -> int:
    """The frame number that `stripe` drew."""
    width = image.shape[1] // 8
    return sum(int(image[:, bit * width + width // 2].mean() > 127) << bit for bit in range(8))


def write_video(
    path: Path,
    frames: int = 20,
    *,
    rate_hz: float = 30.0,
    times_s: Sequence[float] | None = None,
    picture: Callable[[int], np.ndarray] = stripe,
    codec: str | None = None,
) -> Path:
    """A video; with `times_s` every picture is shown at its own time."""
    first = picture(0)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(
            codec or CODEC[path.suffix], rate=Fraction(rate_hz).limit_denominator(1001)
        )
        stream.width, stream.height = first.shape[1], first.shape[0]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if stream.codec_context.name.startswith(("libx264", "h264")):
            stream.options = {"g": "12", "bf": "2", "preset": "veryfast"}
        if times_s is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        container.start_encoding()
        for n in range(frames):
            frame = av.VideoFrame.from_ndarray(picture(n), format="bgr24")
            if times_s is not None:
                frame.pts, frame.time_base = round(times_s[n] * 1000), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def turn_clockwise(path: Path) -> None:
    """Makes an .mp4 say that its pictures are to be shown turned by 90 degrees clockwise."""
    data = bytearray(path.read_bytes())
    place = data.index(_IDENTITY, data.index(b"tkhd"))
    data[place : place + len(_IDENTITY)] = _CLOCKWISE
    path.write_bytes(data)


def write_sound(path: Path) -> Path:
    """A file with sound only."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 4096), dtype=np.float32), format="fltp", layout="mono"
        )
        frame.sample_rate = 44100
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path
