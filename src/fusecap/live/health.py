"""Lights, rates and incidents: how cameras, sensors and the process itself are doing."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from pathlib import Path

from fusecap.live.devices.source import Delivery, SessionClock
from fusecap.live.status import Incident, Light, SourceStatus
from fusecap.setup import SessionSetup
from fusecap.types import ImuSample

LATE_S = 0.1
LATE_PERIODS = 3
LOST_S = 1.0
INCIDENTS_KEPT = 500
_BUCKETS = 8
"""Seconds that are kept."""
_SECOND_NS = 1_000_000_000
_LEAST_SPAN_NS = 200_000_000

Key = int | tuple[str, str]
"""A camera by its place in the rig, or a sensor by subject and bone."""


def key_of(item: Delivery) -> Key:
    """Which camera or sensor an item comes from."""
    return (item.subject, item.bone) if isinstance(item, ImuSample) else item.camera


class Meter:
    """Counts per second; one thread writes, any reads."""

    def __init__(self) -> None:
        self.total = 0
        self._first_ns: int | None = None
        self._buckets = [(-1, 0)] * _BUCKETS

    def add(self, now_ns: int, count: int = 1) -> None:
        """So many more."""
        if self._first_ns is None:
            self._first_ns = now_ns
        second = now_ns // _SECOND_NS
        at = second % _BUCKETS
        held, so_far = self._buckets[at]
        self._buckets[at] = (second, (so_far if held == second else 0) + count)
        self.total += count

    def rate_hz(self, now_ns: int, seconds: int = 3) -> float:
        """Mean over the last whole seconds, since the first item; 0 in the beginning."""
        second = now_ns // _SECOND_NS
        if self._first_ns is None:
            return 0.0
        span_ns = min(seconds * _SECOND_NS, second * _SECOND_NS - self._first_ns)
        if span_ns < _LEAST_SPAN_NS:
            return 0.0
        counted = sum(count for held, count in self._buckets if second - seconds <= held < second)
        return 1e9 * counted / span_ns


class Input:
    """One camera or one sensor, as it comes in."""

    def __init__(self, name: str, kind: str) -> None:
        self.name = name
        self.kind = kind
        self.meter = Meter()
        self.gone = False
        """The source says that its device is not there."""
        self._last_ns: int | None = None
        self._was_lost = False

    def arrived(self, now_ns: int) -> None:
        """An item came."""
        self.meter.add(now_ns)
        self._last_ns = now_ns

    def age_s(self, now_ns: int) -> float:
        """Since the last item; infinite before the first."""
        return float("inf") if self._last_ns is None else 1e-9 * (now_ns - self._last_ns)

    def light(self, now_ns: int) -> Light:
        """By age and by what the source says."""
        age_s = self.age_s(now_ns)
        if self.gone or LOST_S < age_s < float("inf"):
            return Light.LOST
        if self._last_ns is None:
            return Light.WAITING
        rate_hz = self.meter.rate_hz(now_ns)
        periods_s = LATE_PERIODS / rate_hz if rate_hz else 0.0
        return Light.LATE if age_s > max(LATE_S, periods_s) else Light.FRESH

    def change(self, now_ns: int) -> str:
        """What to tell once about falling silent or being back; empty where nothing has changed.

        A device that is gone is told of by its source.
        """
        lost = self.light(now_ns) is Light.LOST
        if self.gone or lost == self._was_lost:
            return ""
        self._was_lost = lost
        return f"nothing for {LOST_S:g} s" if lost else "back"

    def status(self, now_ns: int, dropped: int, note: str) -> SourceStatus:
        """For the status line."""
        return SourceStatus(
            name=self.name,
            kind=self.kind,
            light=self.light(now_ns),
            rate_hz=self.meter.rate_hz(now_ns),
            age_s=self.age_s(now_ns),
            received=self.meter.total,
            dropped=dropped,
            note=note,
        )


def inputs_of(setup: SessionSetup) -> dict[Key, Input]:
    """Everything that a session expects to hear from: cameras, then sensors."""
    inputs: dict[Key, Input] = {
        index: Input(camera.name, "camera") for index, camera in enumerate(setup.session.cameras)
    }
    for subject in setup.session.subjects:
        for imu in subject.imus:
            inputs[subject.name, imu.bone] = Input(f"{subject.name}/{imu.bone}", "imu")
    return inputs


class Incidents:
    """The first and the latest things that happened; written by any thread."""

    def __init__(self, clock: SessionClock, kept: int = INCIDENTS_KEPT) -> None:
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


class ProcessLoad:
    """What this process takes; of processes it has started, what those took that have ended."""

    def __init__(self) -> None:
        self.peak_mb = 0.0
        self._cpu_s = self._first_cpu_s = _cpu_s()
        self._wall_s = self._first_wall_s = time.monotonic()

    def recent_cpu_share(self) -> float:
        """Cores in use since the last call."""
        cpu_s, wall_s = _cpu_s(), time.monotonic()
        share = (cpu_s - self._cpu_s) / max(wall_s - self._wall_s, 1e-6)
        self._cpu_s, self._wall_s = cpu_s, wall_s
        return share

    def cpu_share(self) -> float:
        """Cores in use since the start."""
        wall_s = max(time.monotonic() - self._first_wall_s, 1e-6)
        return (_cpu_s() - self._first_cpu_s) / wall_s

    def memory_mb(self) -> float:
        """Resident; the largest so far where the system does not tell the present."""
        try:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
            memory_mb = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
        except (OSError, ValueError, IndexError):
            memory_mb = _largest_mb()
        self.peak_mb = max(self.peak_mb, memory_mb)
        return memory_mb


def _cpu_s() -> float:
    return sum(os.times()[:4])


def _largest_mb() -> float:
    try:
        import resource
        import sys
    except ImportError:
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
