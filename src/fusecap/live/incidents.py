"""What has happened in a run, in bounded memory."""

from __future__ import annotations

import threading
from collections import deque

from fusecap.live.devices.source import SessionClock
from fusecap.live.status import Incident

KEPT = 500


class Incidents:
    """The first and the latest things that happened; written by any thread."""

    def __init__(self, clock: SessionClock, kept: int = KEPT) -> None:
        self.count = 0
        """Of all, those forgotten included."""
        self._clock = clock
        self._first: list[Incident] = []
        self._latest: deque[Incident] = deque(maxlen=kept // 2)
        self._kept = kept
        self._lock = threading.Lock()

    def add(self, what: str) -> None:
        """Something happened now."""
        incident = Incident(time_s=1e-9 * self._clock.now_ns(), what=what)
        with self._lock:
            self.count += 1
            if len(self._first) < self._kept - self._kept // 2:
                self._first.append(incident)
            else:
                self._latest.append(incident)

    def all(self) -> tuple[Incident, ...]:
        """Those that are kept, oldest first."""
        with self._lock:
            return (*self._first, *self._latest)
