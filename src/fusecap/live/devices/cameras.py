"""A live camera: a grabber gives pictures, this makes `CameraImage`s with session times of them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing

from fusecap.live.devices.clock_map import ClockMap
from fusecap.live.devices.grabbers import Grabber, Picture
from fusecap.live.devices.source import Deliver, SessionClock, SourceCounts, SourceLost
from fusecap.types import CameraImage

SILENCE_S = 2.0
"""A camera without a picture for this long is lost."""
UNSTAMPED_DELAY_S = 0.04
"""Taken off the arrival of pictures without a usable stamp: the period of 25 Hz, about the least
that exposure, readout and transfer of a webcam take. `offset_s` corrects it."""
_IDLE_S = 0.002


class CameraSource:
    """Reads one camera as fast as it comes, so that nothing old waits in a driver's queue."""

    def __init__(
        self,
        *,
        name: str,
        camera: int,
        size_px: tuple[int, int],
        open_grabber: Callable[[], Grabber],
        clock: SessionClock,
        offset_s: float = 0.0,
    ) -> None:
        """`camera` is its place in the rig, `size_px` the calibration's width and height.

        `open_grabber` raises `SourceLost` where the device is not there.
        """
        self._name = name
        self._camera = camera
        self._size_px = size_px
        self._open = open_grabber
        self._clock = clock
        self._offset_ns = round(offset_s * 1e9)
        self._counts = SourceCounts()
        self._size_refused = False

    @property
    def name(self) -> str:
        """Of the camera."""
        return f"camera '{self._name}'"

    @property
    def counts(self) -> SourceCounts:
        """What came in so far; `malformed` counts pictures that cannot be decoded or used."""
        return self._counts

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """Raises `SourceLost` where the camera is gone or silent, and for a wrong size once."""
        exposures = ClockMap(delay_s=UNSTAMPED_DELAY_S)
        with closing(self._open()) as grabber:
            heard_ns = self._clock.now_ns()
            while not stopping.is_set():
                picture = grabber.next()
                self._counts.malformed += grabber.take_broken()
                if picture is None:
                    if self._clock.now_ns() - heard_ns > SILENCE_S * 1e9:
                        raise SourceLost(f"{self.name}: no picture for {SILENCE_S:g} s")
                    stopping.wait(_IDLE_S)
                    continue
                heard_ns = picture.arrival_ns
                if self._fits(picture):
                    self._pass_on(picture, exposures, deliver)

    def _pass_on(self, picture: Picture, exposures: ClockMap, deliver: Deliver) -> None:
        restarts = exposures.restarts
        time_ns = exposures.session_ns(
            picture.stamp_ns, picture.arrival_ns, synchronised=picture.synchronised
        )
        if exposures.restarts > restarts:
            self._counts.note = exposures.note
        if time_ns is None:
            self._counts.dropped += 1
            return
        self._counts.received += 1
        deliver(
            CameraImage(
                camera=self._camera,
                timestamp_ns=time_ns + self._offset_ns,
                image=picture.image,
            )
        )

    def _fits(self, picture: Picture) -> bool:
        height, width = picture.image.shape[:2]
        if (width, height) == self._size_px:
            return True
        self._counts.malformed += 1
        self._counts.note = (
            f"its pictures are {width} x {height}, its calibration is for {self._size_px[0]} x "
            f"{self._size_px[1]}; set that size in the camera, or with ?size= in its address, or "
            "calibrate it anew"
        )
        if not self._size_refused:
            self._size_refused = True
            raise SourceLost(f"{self.name}: {self._counts.note}")
        return False
