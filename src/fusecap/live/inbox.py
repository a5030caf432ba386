"""What has arrived and has not been taken yet: from many threads to one, bounded, in order."""

from __future__ import annotations

import threading
from collections import deque

from fusecap.live.devices.source import SessionClock
from fusecap.types import CameraSample, Command, ImuSample

Arrival = CameraSample | ImuSample | Command
CAPACITY = 8192
"""Four seconds of 30 sensors and 4 cameras at 60 Hz."""


class Inbox:
    """Never waits on who puts in; where it is full the oldest sensor sample makes room."""

    def __init__(self, clock: SessionClock, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        """Samples that came and were never taken, because the solver did not get to them."""
        self._clock = clock
        self._capacity = capacity
        self._items: deque[tuple[Arrival, int]] = deque()
        self._changed = threading.Condition(threading.Lock())
        self._heard = False
        self._listening = False

    def put(self, item: Arrival) -> None:
        """At the end of the queue, with the time of now."""
        with self._changed:
            if len(self._items) >= self._capacity:
                self._make_room()
            self._items.append((item, self._clock.now_ns()))
            if self._listening:
                self._heard = True
                self._changed.notify()

    def take_all(self) -> list[tuple[Arrival, int]]:
        """Everything in order of arrival, each with when it came."""
        with self._changed:
            items = list(self._items)
            self._items.clear()
        return items

    def wait_until(self, deadline_ns: int, *, or_arrival: bool = False) -> None:
        """Until the session's clock says so, something is there to take, or `wake` is called."""
        with self._changed:
            self._listening = or_arrival
            while not self._heard and not (or_arrival and self._items):
                left_ns = deadline_ns - self._clock.now_ns()
                if left_ns <= 0:
                    break
                self._changed.wait(left_ns * 1e-9)
            self._heard = False
            self._listening = False

    def wake(self) -> None:
        """End a wait at once."""
        with self._changed:
            self._heard = True
            self._changed.notify()

    def _make_room(self) -> None:
        self.dropped += 1
        for index, (item, _) in enumerate(self._items):
            if isinstance(item, ImuSample):
                del self._items[index]
                return
        self._items.popleft()
