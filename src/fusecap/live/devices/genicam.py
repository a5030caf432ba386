"""Machine-vision cameras (GigE Vision, USB3 Vision, ...) through GenICam's own `harvesters`.

Written from its documentation and tried against a stand-in only: no such camera has been at hand.
Needs the extra `genicam` and the maker's GenTL producer, a library whose folder is listed in
GENICAM_GENTL64_PATH, as its installer leaves it. Exposure, gain and trigger stay as the maker's
tools have set them; size and rate are set where the address asks for them.
"""

from __future__ import annotations

import functools
import importlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import InputError, from_extra
from fusecap.live.devices.grabbers import Picture
from fusecap.live.devices.source import SessionClock, SourceLost
from fusecap.sources.live_address import GenICam

_WAIT_S = 0.2
_LOCK = threading.Lock()
"""Producers can be opened once in a process."""


def open_genicam(address: GenICam, clock: SessionClock) -> Callable[[], GenICamGrabber]:
    """What opens the camera; raises `InputError` where `harvesters` is not installed."""
    try:
        core = importlib.import_module("harvesters.core")
    except ImportError:
        raise InputError(
            f"live = 'genicam:...' needs harvesters; {from_extra('genicam')}"
        ) from None
    return lambda: GenICamGrabber(address, clock, core)


class GenICamGrabber:
    """One opened camera."""

    def __init__(self, address: GenICam, clock: SessionClock, core: Any) -> None:
        """Raises `SourceLost`."""
        self._name = f"genicam:{address.serial}"
        self._clock = clock
        self._broken = 0
        try:
            with _LOCK:
                library = _library(core)
                library.update()
                self._camera = library.create({"serial_number": address.serial})
            nodes = self._camera.remote_device.node_map
            capture = address.capture
            if capture.size_px is not None:
                nodes.Width.value, nodes.Height.value = capture.size_px
            if capture.rate_hz is not None:
                nodes.AcquisitionFrameRate.value = capture.rate_hz
            if capture.format is not None:
                nodes.PixelFormat.value = capture.format
            self._camera.start()
        except Exception as error:  # the producer's own kinds
            raise SourceLost(
                f"{self._name}: cannot be opened ({type(error).__name__}: {error}); is its GenTL "
                "producer in GENICAM_GENTL64_PATH, and no other program using it?"
            ) from None

    def next(self) -> Picture | None:
        """The newest picture; None where there is none yet."""
        try:
            buffer = self._camera.try_fetch(timeout=_WAIT_S)
            if buffer is None:
                return None
            with buffer:
                arrival_ns = self._clock.now_ns()
                part = buffer.payload.components[0]
                image = _bgr(part.data, part.width, part.height, part.data_format)
                stamp_ns = buffer.timestamp_ns or None
        except Exception as error:  # the producer's own kinds
            raise SourceLost(f"{self._name}: {type(error).__name__}: {error}") from None
        if image is None:
            self._broken += 1
            return None
        return Picture(image=image, arrival_ns=arrival_ns, stamp_ns=stamp_ns)

    def take_broken(self) -> int:
        """Pictures of a pixel format that is not known here."""
        broken, self._broken = self._broken, 0
        return broken

    def close(self) -> None:
        """Stops the camera and gives it back."""
        self._camera.destroy()


@functools.cache
def _library(core: Any) -> Any:
    library = core.Harvester()
    for folder in os.environ.get("GENICAM_GENTL64_PATH", "").split(os.pathsep):
        for producer in sorted(Path(folder).glob("*.cti")) if folder else ():
            library.add_file(str(producer))
    return library


def _bgr(data: np.ndarray, width: int, height: int, pixels: str) -> np.ndarray | None:
    """(h, w, 3) of its own; None for a format that is not one of 8 bits."""
    import cv2

    # OpenCV names a Bayer pattern by its second row [OpenCV, color conversions].
    codes = {
        "Mono8": cv2.COLOR_GRAY2BGR,
        "BayerRG8": cv2.COLOR_BayerBG2BGR,
        "BayerBG8": cv2.COLOR_BayerRG2BGR,
        "BayerGR8": cv2.COLOR_BayerGB2BGR,
        "BayerGB8": cv2.COLOR_BayerGR2BGR,
    }
    if pixels in codes:
        return cv2.cvtColor(data.reshape(height, width), codes[pixels])
    if pixels == "RGB8":
        return np.ascontiguousarray(data.reshape(height, width, 3)[:, :, ::-1])
    return data.reshape(height, width, 3).copy() if pixels == "BGR8" else None
