"""Keypoints from a folder that OpenPose is writing into."""

from __future__ import annotations

import threading
from pathlib import Path

from fusecap.believable import surest
from fusecap.body.landmarks import LandmarkSet
from fusecap.errors import InputError
from fusecap.live.devices.clock_map import ClockMap
from fusecap.live.devices.source import Deliver, SessionClock, SourceCounts, SourceLost
from fusecap.sources.openpose_live import LiveFrame, OpenPoseFolder
from fusecap.types import CameraSample

POLL_S = 0.004


class OpenPoseSource:
    """Frames that were there before the start are taken as past.

    A frame's time is its number over the rate, on the clock of OpenPose's camera, mapped by when
    the files come: what detection takes at the least is not seen and is stated by `offset_s`.
    """

    def __init__(
        self,
        *,
        name: str,
        camera: int,
        folder: Path,
        landmarks: LandmarkSet,
        rate_hz: float,
        clock: SessionClock,
        offset_s: float = 0.0,
    ) -> None:
        self._name = name
        self._camera = camera
        self._folder = OpenPoseFolder(folder, landmarks, skip_existing=True)
        self._period_ns = 1e9 / rate_hz
        self._clock = clock
        self._offset_ns = round(offset_s * 1e9)
        self._times = ClockMap()
        self._run = 0
        self._counts = SourceCounts()

    @property
    def name(self) -> str:
        """Of the camera."""
        return f"camera '{self._name}'"

    @property
    def counts(self) -> SourceCounts:
        """What came in so far; `malformed` counts files that stayed unreadable."""
        return self._counts

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """Raises `SourceLost` for keypoints of another format."""
        while not stopping.wait(POLL_S):
            try:
                frames = self._folder.poll(self._clock.now_ns())
            except InputError as error:
                raise SourceLost(f"{self.name}: {error}") from None
            late = 0
            for frame in frames:
                late += not self._pass_on(frame, deliver)
            self._counts.malformed = self._folder.counts.broken
            self._counts.dropped += late

    def _pass_on(self, frame: LiveFrame, deliver: Deliver) -> bool:
        if frame.run != self._run:
            self._run = frame.run
            self._times = ClockMap()
            self._counts.note = "OpenPose has started again"
        time_ns = self._times.session_ns(round(frame.number * self._period_ns), frame.read_ns)
        if time_ns is None:
            return False
        self._counts.received += 1
        deliver(
            CameraSample(
                camera=self._camera,
                timestamp_ns=time_ns + self._offset_ns,
                people=surest(frame.people),
            )
        )
        return True
