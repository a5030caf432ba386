"""A live source: a thread of its own that delivers images or samples until it is told to stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

from fusecap.errors import FusecapError
from fusecap.types import CameraImage, CameraSample, ImuSample

Delivery = CameraImage | CameraSample | ImuSample
Deliver = Callable[[Delivery], None]
"""Takes one item at once; never waits."""


class SourceLost(FusecapError):
    """The device is gone or silent; it is worth opening it again later."""


class SessionClock:
    """Nanoseconds since the run began, on the system's monotonic clock."""

    def __init__(self) -> None:
        self._start_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        return time.monotonic_ns() - self._start_ns

    def from_monotonic_ns(self, monotonic_ns: int) -> int:
        """A stamp of the system's monotonic clock, as drivers give it, on the session's clock."""
        return monotonic_ns - self._start_ns


class Source(Protocol):
    """Cameras, sensors and what plays them back."""

    @property
    def name(self) -> str:
        """As shown to users: "camera 'left'", "imus lsl:trunk"."""
        ...

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """Opens the device and delivers until `stopping` is set; returns when there is no more.

        Items carry times on the session's clock. Raises `SourceLost` where the device is gone; it
        is then run again after a pause. Malformed input is counted in `counts`, never raised.
        """
        ...

    @property
    def counts(self) -> SourceCounts:
        """What came in so far."""
        ...


class SourceCounts:
    """What a source has seen; plain integers that one thread writes and others read."""

    __slots__ = ("dropped", "malformed", "note", "oversize", "received")

    def __init__(self) -> None:
        self.received = 0
        """Images, frames or samples delivered."""
        self.dropped = 0
        """That the source itself left out because it came too late or twice."""
        self.malformed = 0
        """Packets that do not follow their format."""
        self.oversize = 0
        self.note = ""
        """What a user should know, e.g. why the last packet was refused."""
