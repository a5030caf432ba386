"""Recorded items at their own pace: the sources of a playback.

All of them share one `Schedule`: what was recorded `t` after the earliest item of all is stamped
`start + t` on the run's clock and arrives then, later by a delay and a random jitter. Within a
source nothing overtakes. Round `n` of a loop is stamped `start + n * round + t`: time never jumps.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float, Int, UInt8

from fusecap.live.devices.source import Deliver, Delivery, SessionClock, SourceCounts
from fusecap.progress import Progress
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.video import Video
from fusecap.types import CameraImage, CameraSample, ImuSample

TOO_LATE_NS = 100_000_000
"""A picture decoded this long after its time is left out."""


class Schedule:
    """When everything is due; the first source to run starts the playback of all."""

    def __init__(
        self,
        sources: Sequence[PacedSource],
        clock: SessionClock,
        *,
        loop: bool = False,
        two_way: bool = False,
        delay_ns: int = 0,
        jitter_ns: int = 0,
    ) -> None:
        """For a loop, `two_way` plays every second round backwards."""
        self.clock = clock
        self.endless = loop
        self.two_way = two_way
        self.delay_ns = delay_ns
        self.jitter_ns = jitter_ns
        self.first_ns = min(int(source.times_ns[0]) for source in sources)
        self.last_ns = max(int(source.times_ns[-1]) for source in sources)
        period_ns = max(_period_ns(source.times_ns) for source in sources)
        self.one_way_ns = self.last_ns - self.first_ns + period_ns
        self.round_ns = self.one_way_ns * (2 if self.two_way else 1)
        self._start_ns: int | None = None
        self._lock = threading.Lock()

    def start_ns(self) -> int:
        """When the playback began, on the run's clock; it begins when this is first asked."""
        with self._lock:
            if self._start_ns is None:
                self._start_ns = self.clock.now_ns()
            return self._start_ns

    def round(self, times_ns: Int[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
        """A source's items in one round: when, since its start [ns], and which."""
        since_ns, rows = times_ns - self.first_ns, np.arange(len(times_ns))
        if self.two_way:
            back_ns = self.one_way_ns + self.last_ns - times_ns[::-1]
            return np.concatenate([since_ns, back_ns]), np.concatenate([rows, rows[::-1]])
        return since_ns, rows


def _period_ns(times_ns: Int[np.ndarray, " n"]) -> int:
    steps = np.diff(times_ns)
    return int(np.median(steps[steps > 0])) if np.any(steps > 0) else 1_000_000_000 // 30


class PacedSource(ABC):
    """The items of one source, one after the other."""

    def __init__(self, name: str, times_s: Float[np.ndarray, " n"]) -> None:
        self.name = name
        self.counts = SourceCounts()
        self.times_ns: Int[np.ndarray, " n"] = np.round(times_s * 1e9).astype(np.int64)
        """Ascending, on the session's clock."""
        self._runs = 0

    def follow(self, schedule: Schedule, seed: int) -> None:
        """Learn when items are due; to be called before `run`."""
        self._schedule = schedule
        self._since_ns, self._rows = schedule.round(self.times_ns)
        self._rng = np.random.default_rng(seed)

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """Every item at its time; run again, from the present on."""
        schedule = self._schedule
        clock, start_ns = schedule.clock, schedule.start_ns()
        begin_ns = clock.now_ns() - start_ns if self._runs else 0
        self._runs += 1
        due_ns = 0
        for stamp_ns, item in self._items(start_ns, begin_ns):
            late_ns = schedule.delay_ns
            if schedule.jitter_ns:
                late_ns += int(self._rng.integers(schedule.jitter_ns))
            due_ns = max(due_ns, stamp_ns + late_ns)
            wait_ns = due_ns - clock.now_ns()
            if stopping.wait(wait_ns * 1e-9) if wait_ns > 0 else stopping.is_set():
                return
            self.counts.received += 1
            deliver(item)

    def _rounds(self, begin_ns: int) -> Iterator[tuple[int, int]]:
        """Starts of rounds since that of the playback [ns], and the first item of each to play."""
        number, since_ns = divmod(begin_ns, self._schedule.round_ns)
        first = int(np.searchsorted(self._since_ns, since_ns))
        while number == 0 or self._schedule.endless:
            yield number * self._schedule.round_ns, first
            number, first = number + 1, 0

    @abstractmethod
    def _items(self, start_ns: int, begin_ns: int) -> Iterator[tuple[int, Delivery]]:
        """With their times on the run's clock, from `begin_ns` of the playback on."""


class _Stored(PacedSource):
    """A source whose items are all in memory."""

    def _items(self, start_ns: int, begin_ns: int) -> Iterator[tuple[int, Delivery]]:
        for round_ns, first in self._rounds(begin_ns):
            for place in range(first, len(self._rows)):
                stamp_ns = start_ns + round_ns + int(self._since_ns[place])
                yield stamp_ns, self._item(int(self._rows[place]), stamp_ns)

    @abstractmethod
    def _item(self, row: int, stamp_ns: int) -> Delivery:
        """What was recorded at `times_ns[row]`, as of `stamp_ns`."""


class Keypoints(_Stored):
    """A camera whose keypoints come from outside."""

    def __init__(self, camera: int, track: KeypointTrack, times_s: np.ndarray) -> None:
        super().__init__(f"camera '{track.name}'", times_s)
        self._camera = camera
        self._people = track.people
        self._appearance = track.appearance

    def _item(self, row: int, stamp_ns: int) -> CameraSample:
        return CameraSample(
            camera=self._camera,
            timestamp_ns=stamp_ns,
            people=self._people[row],
            appearance=None if self._appearance is None else self._appearance[row],
        )


class HeldPictures(_Stored):
    """A camera whose pictures were all decoded before."""

    def __init__(
        self,
        camera: int,
        name: str,
        video: Video,
        times_s: Float[np.ndarray, " f"],
        shown: Int[np.ndarray, " n"],
        progress: Progress | None,
    ) -> None:
        wanted = set(shown.tolist())
        self._camera = camera
        self._images: list[UInt8[np.ndarray, "h w 3"]] = []
        numbers: list[int] = []
        for frame in video.frames(wanted=wanted.__contains__):
            self._images.append(frame.image)
            numbers.append(frame.number)
            if progress is not None:
                progress(f"camera '{name}'", len(numbers), len(wanted))
        super().__init__(f"camera '{name}'", times_s[numbers])

    def _item(self, row: int, stamp_ns: int) -> CameraImage:
        return CameraImage(camera=self._camera, timestamp_ns=stamp_ns, image=self._images[row])


class PacedPictures(PacedSource):
    """A camera whose pictures are decoded one ahead of their time, each round anew."""

    def __init__(
        self,
        camera: int,
        name: str,
        video: Video,
        times_s: Float[np.ndarray, " f"],
        shown: Int[np.ndarray, " n"],
    ) -> None:
        super().__init__(f"camera '{name}'", times_s[shown])
        self._camera = camera
        self._video = video
        self._shown = shown

    def _items(self, start_ns: int, begin_ns: int) -> Iterator[tuple[int, Delivery]]:
        for round_ns, first in self._rounds(begin_ns):
            if first == len(self._shown):
                continue
            stamps_ns = {
                int(number): start_ns + round_ns + int(since_ns)
                for number, since_ns in zip(self._shown, self._since_ns, strict=True)
            }
            wanted = partial(self._in_time, stamps_ns)
            for frame in self._video.frames(int(self._shown[first]), wanted=wanted):
                stamp_ns = stamps_ns[frame.number]
                yield (
                    stamp_ns,
                    CameraImage(camera=self._camera, timestamp_ns=stamp_ns, image=frame.image),
                )

    def _in_time(self, stamps_ns: dict[int, int], number: int) -> bool:
        if number not in stamps_ns:
            return False
        late_ns = self._schedule.clock.now_ns() - stamps_ns[number]
        if late_ns > TOO_LATE_NS + self._schedule.delay_ns:
            self.counts.dropped += 1
            self.counts.note = "its video is decoded more slowly than it is to be shown"
            return False
        return True


class PacedSensors(_Stored):
    """All sensors of one subject, their samples merged in the order of their times."""

    def __init__(
        self,
        subject: str,
        bones: Sequence[str],
        tracks: Sequence[ImuTrack],
        times_s: Sequence[Float[np.ndarray, " _"]],
    ) -> None:
        """`times_s` are the tracks' on the session's clock."""
        together_s = np.concatenate(times_s)
        order = np.argsort(together_s, kind="stable")
        super().__init__(f"imus of '{subject}'", together_s[order])
        self._subject = subject
        self._bones = tuple(bones)
        self._sensor = np.repeat(np.arange(len(tracks)), [len(t) for t in times_s])[order]
        self._orientation = np.concatenate([t.orientation_wxyz for t in tracks])[order]
        self._accel = np.concatenate([t.accel_m_s2 for t in tracks])[order]

    def _item(self, row: int, stamp_ns: int) -> ImuSample:
        return ImuSample(
            subject=self._subject,
            bone=self._bones[self._sensor[row]],
            timestamp_ns=stamp_ns,
            orientation_wxyz=self._orientation[row],
            accel_m_s2=self._accel[row],
        )
