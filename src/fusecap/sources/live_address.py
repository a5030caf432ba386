"""Where `fusecap live` finds a camera or a sensor, as the session's `live` keys say it.

    [[camera]]        webcam:0 | v4l2:/dev/video0 | genicam:SERIAL   each with ?size=..&rate=..
                      rtsp://host/path, http://..., udp://... | openpose:FOLDER
    [[subject.imu]]   lsl:STREAM | lsl:STREAM/SENSOR | osc://HOST:PORT/NAME
                      mvn://HOST:PORT/SEGMENT

An address names a device and never a file or a program, so that a stranger's session cannot make
this machine read or run something. A host that is left out is this machine alone (127.0.0.1).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import SplitResult, parse_qsl, urlsplit, urlunsplit

from fusecap.errors import InputError, nearest
from fusecap.sources import imu_streams
from fusecap.sources.live_sensor import SensorAddress

LOOPBACK = "127.0.0.1"
URL_SCHEMES = ("rtsp", "rtsps", "http", "https", "udp", "tcp", "rtp", "rtmp", "srt")
"""What FFmpeg may open for a session: the network, no files, devices or pipes."""
CAMERA_EXAMPLE = 'live = "v4l2:/dev/video0?size=1280x720&rate=30"'
IMU_EXAMPLE = f'live = "osc://{LOOPBACK}:9000/left_forearm"'


@dataclass(frozen=True, slots=True, kw_only=True)
class Capture:
    """What a camera is asked for; None: as the driver has it."""

    size_px: tuple[int, int] | None = None
    """Width, height."""
    rate_hz: float | None = None
    format: str | None = None
    """Of the pixels on the wire, as FFmpeg names it: "mjpeg", "yuyv422"."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Webcam:
    """The system's camera number `index`, through OpenCV."""

    index: int
    capture: Capture = Capture()


@dataclass(frozen=True, slots=True, kw_only=True)
class V4l2:
    """A Linux video device, through FFmpeg, with the driver's exposure stamps."""

    device: str
    capture: Capture = Capture()


@dataclass(frozen=True, slots=True, kw_only=True)
class GenICam:
    """A machine-vision camera, by its serial number."""

    serial: str
    capture: Capture = Capture()


@dataclass(frozen=True, slots=True, kw_only=True)
class VideoUrl:
    """A network camera, or whatever else FFmpeg opens over the network."""

    url: str

    @property
    def shown(self) -> str:
        """Without the password."""
        parts = urlsplit(self.url)
        host = parts.netloc.rpartition("@")[2]
        return urlunsplit(parts._replace(netloc=host, query=""))


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointFolder:
    """A folder that OpenPose writes JSON into; relative to the session."""

    folder: Path


CameraAddress = Webcam | V4l2 | GenICam | VideoUrl | KeypointFolder


def parse_camera_address(text: str) -> CameraAddress:
    """Raises `InputError` that says what is wrong and gives an example."""
    scheme, _, rest = text.partition(":")
    if scheme in URL_SCHEMES:
        return _video_url(text)
    match scheme:
        case "webcam":
            index, capture = _with_capture(text, rest)
            if not re.fullmatch(r"\d{1,3}", index):
                raise wrong_address(text, "expected the camera's number", 'live = "webcam:0"')
            return Webcam(index=int(index), capture=capture)
        case "v4l2":
            device, capture = _with_capture(text, rest)
            if not re.fullmatch(r"/dev/[\w./-]+", device) or ".." in device:
                raise wrong_address(text, "expected a device under /dev", CAMERA_EXAMPLE)
            return V4l2(device=device, capture=capture)
        case "genicam":
            serial, capture = _with_capture(text, rest)
            if not serial:
                raise wrong_address(
                    text, "the serial number is missing", 'live = "genicam:22345678"'
                )
            return GenICam(serial=serial, capture=capture)
        case "openpose":
            if not rest:
                raise wrong_address(
                    text, "the folder is missing", 'live = "openpose:keypoints/left"'
                )
            return KeypointFolder(folder=Path(rest).expanduser())
    known = ("webcam", "v4l2", "genicam", "openpose", *URL_SCHEMES)
    raise wrong_address(
        text, f"no kind of camera is called '{scheme}'{nearest(scheme, known)}", CAMERA_EXAMPLE
    )


def parse_imu_address(text: str) -> SensorAddress:
    """Raises `InputError` that says what is wrong and gives an example."""
    scheme = text.partition(":")[0]
    if scheme not in imu_streams.NAMES:
        raise wrong_address(
            text,
            f"no kind of sensor is called '{scheme}'{nearest(scheme, imu_streams.NAMES)}",
            IMU_EXAMPLE,
        )
    return imu_streams.protocol_named(scheme).parse(text)


def listening(text: str, example: str) -> tuple[SplitResult, str, int | None]:
    """The address in its parts, with the host to bind to and the port."""
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        raise wrong_address(text, "the port must be a number from 1 to 65535", example) from None
    if "://" not in text or parts.username is not None or parts.fragment:
        raise wrong_address(text, "expected a host, a port and a name", example)
    if port == 0:
        raise wrong_address(text, "the port must be a number from 1 to 65535", example)
    return parts, parts.hostname or LOOPBACK, port


def _video_url(text: str) -> VideoUrl:
    example = 'live = "rtsp://192.168.1.20/stream1"'
    try:
        parts = urlsplit(text)
        _ = parts.port
    except ValueError as error:
        raise wrong_address(text, str(error), example) from None
    if not parts.netloc:
        raise wrong_address(text, "the host is missing", example)
    return VideoUrl(url=text)


def _with_capture(text: str, rest: str) -> tuple[str, Capture]:
    """What stands before the question mark, and what is asked for after it."""
    device, _, query = rest.partition("?")
    options = address_options(text, query, ("size", "rate", "format"), CAMERA_EXAMPLE)
    size_px = rate_hz = None
    if "size" in options:
        size = re.fullmatch(r"([1-9]\d{1,4})x([1-9]\d{1,4})", options["size"])
        if size is None:
            found = options["size"]
            raise wrong_address(
                text, f"size={found}: expected WIDTHxHEIGHT in pixels", CAMERA_EXAMPLE
            )
        size_px = int(size[1]), int(size[2])
    if "rate" in options:
        if not re.fullmatch(r"\d{1,4}(\.\d+)?", options["rate"]) or float(options["rate"]) <= 0:
            found = options["rate"]
            raise wrong_address(text, f"rate={found}: expected pictures per second", CAMERA_EXAMPLE)
        rate_hz = float(options["rate"])
    pixels = options.get("format")
    if pixels is not None and not re.fullmatch(r"\w+", pixels):
        raise wrong_address(text, f"format={pixels}: expected a name such as mjpeg", CAMERA_EXAMPLE)
    return device, Capture(size_px=size_px, rate_hz=rate_hz, format=pixels)


def address_options(text: str, query: str, known: tuple[str, ...], example: str) -> dict[str, str]:
    """What stands after the question mark; raises `InputError` for keys that are not `known`."""
    if not query:
        return {}
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True, max_num_fields=8)
    except ValueError:
        raise wrong_address(text, "expected ?key=value&key=value", example) from None
    for key, _ in pairs:
        if key not in known:
            raise wrong_address(text, f"unknown option '{key}'{nearest(key, known)}", example)
    return dict(pairs)


def wrong_address(text: str, what: str, example: str) -> InputError:
    """Says what is wrong with an address, and gives an example."""
    return InputError(f"found '{text}': {what}; write something like {example}")
