"""A take played at its own pace.

Frame k of a take with timestamps t is due at `start + (t[k] - t[0]) / speed`, counted from one
start, so errors of single waits do not add up: after an hour the stream is as late as after a
second. Who comes too late for a frame goes on with the newest one that is due; what lies between
is skipped and counted.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fusecap.body.shape import BodyShape
from fusecap.errors import InputError, TakeError
from fusecap.streams.person_pose import StreamFrame, pose_of_take
from fusecap.streams.stream import Stream
from fusecap.take import Take

MIN_SPEED, MAX_SPEED = 0.01, 100.0
_LATE_WINDOW = 100_000
"""Latest frames whose lateness is summed up: half an hour at 60 Hz."""


@dataclass(frozen=True, kw_only=True)
class PlaybackState:
    """How a playback goes."""

    elapsed_s: float
    frames: int
    skipped: int
    """Frames that were too late to be sent."""
    late_ms_median: float
    late_ms_p99: float
    """How long after their due time frames were sent, all streams included."""
    interrupted: bool

    @property
    def rate_hz(self) -> float:
        """Frames per second of the clock."""
        return self.frames / self.elapsed_s if self.elapsed_s > 0 else 0.0


class TakePlayer:
    """A take's frames and when they are due; raises `TakeError` where there is nothing to play."""

    def __init__(
        self, take: Take, *, subjects: Sequence[str] = (), speed: float = 1.0, loop: bool = False
    ) -> None:
        if not MIN_SPEED <= speed <= MAX_SPEED:
            raise InputError(f"--speed {speed:g}: expected {MIN_SPEED:g} to {MAX_SPEED:g}")
        if len(take.timestamps_ns) == 0:
            raise TakeError("the take has no frame: nothing to stream; solve it again")
        rows = [take.subject(name) for name in dict.fromkeys(subjects)]
        rows = rows or [i for i in range(len(take.subject_names)) if take.tracked[i].any()]
        if not any(take.tracked[i].any() for i in rows):
            who = ", ".join(f"'{take.subject_names[i]}'" for i in rows) or "anybody"
            raise TakeError(f"the take never tracks {who}: nothing to stream")
        self._take = take
        self._rows = rows
        self._speed = speed
        self._loop = loop
        self._since_first_s = (take.timestamps_ns - take.timestamps_ns[0]) * 1e-9
        self._round_s = float(self._since_first_s[-1]) + 1.0 / take.rate_hz
        self.cast: dict[str, BodyShape] = {take.subject_names[i]: take.shape(i) for i in rows}

    @property
    def rate_hz(self) -> float:
        """At which frames come."""
        return self._take.rate_hz * self._speed

    @property
    def frame_count(self) -> int | None:
        """In all; None where it goes round without end."""
        return None if self._loop else len(self._since_first_s)

    def due_s(self, index: int) -> float:
        """When frame `index` (counted on through rounds) is to be sent, from the start."""
        return self._recorded_s(index) / self._speed

    def newest_due(self, now_s: float, index: int) -> int:
        """The last frame from `index` on that is due."""
        while self._exists(index + 1) and self.due_s(index + 1) <= now_s:
            index += 1
        return index

    def frame(self, index: int) -> StreamFrame | None:
        """None after the last one."""
        if not self._exists(index):
            return None
        row = index % len(self._since_first_s)
        poses = [
            pose_of_take(self._take, subject, row, shape)
            for subject, shape in zip(self._rows, self.cast.values(), strict=True)
        ]
        return StreamFrame(
            time_s=self._recorded_s(index),
            timestamp_ns=int(self._take.timestamps_ns[row]),
            people=dict(zip(self.cast, poses, strict=True)),
        )

    def _exists(self, index: int) -> bool:
        return self._loop or index < len(self._since_first_s)

    def _recorded_s(self, index: int) -> float:
        rounds, row = divmod(index, len(self._since_first_s))
        return rounds * self._round_s + float(self._since_first_s[row])


def play(
    player: TakePlayer,
    streams: Sequence[Stream],
    *,
    each_second: Callable[[PlaybackState], None] | None = None,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
) -> PlaybackState:
    """Send every frame at its time until the end, or until Ctrl-C."""
    start = clock()
    late_s: deque[float] = deque(maxlen=_LATE_WINDOW)
    index = frames = skipped = 0
    next_report_s = 1.0

    def state(interrupted: bool = False) -> PlaybackState:
        late_ms = 1e3 * np.array(late_s or [0.0])
        return PlaybackState(
            elapsed_s=clock() - start,
            frames=frames,
            skipped=skipped,
            late_ms_median=float(np.median(late_ms)),
            late_ms_p99=float(np.percentile(late_ms, 99)),
            interrupted=interrupted,
        )

    def wait_until(due_s: float) -> None:
        while (wait_s := due_s - (clock() - start)) > 0:
            sleep(wait_s)

    try:
        while (frame := player.frame(index)) is not None:
            due_s = player.due_s(index)
            wait_until(due_s)
            for stream in streams:
                stream.send(frame)
            now_s = clock() - start
            late_s.append(now_s - due_s)
            frames += 1
            newest = player.newest_due(now_s, index + 1)
            skipped += newest - (index + 1)
            index = newest
            if each_second is not None and now_s >= next_report_s:
                next_report_s = math.floor(now_s) + 1.0
                each_second(state())
        wait_until(player.due_s(index))
    except KeyboardInterrupt:
        return state(interrupted=True)
    return state()
