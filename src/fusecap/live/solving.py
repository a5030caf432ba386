"""The thread that owns the engine: what has arrived goes in, and at each instant a pose comes out.

Instant k is the time k / rate on the session's clock. It is solved `delay` after that, so that what
was exposed then has come through the detector; or sooner, where `eager`, as soon as every source
that is fresh has a sample from then or later. An instant that is late is still solved when the one
after it is not due yet; who is further behind goes on with the newest instant that is due, and what
lies between is counted as skipped. So a machine that is too slow loses instants, never its delay.

With `ahead` there are two fronts. Instants that pictures have reached are solved as above, and send
nothing; what is sent is the newest instant, as soon as sensors have reached it, at the latest 20 ms
after it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from fusecap.engine.engine import LiveStep
from fusecap.engine.sensors import HOLD_S
from fusecap.live.devices.source import SessionClock
from fusecap.live.health import Meter
from fusecap.live.inbox import Inbox
from fusecap.live.latency import (
    EXPOSURE_TO_POSE,
    LAST_SAMPLE_TO_SOLVE,
    SOLVE,
    Arrivals,
    LatencyBook,
)
from fusecap.types import Command, Event, Tick

AHEAD_NS = round(HOLD_S * 1e9)
"""For so long a sensor's last sample holds: the next is not waited for any longer."""
_EARLY_NS = 1_000_000
"""Before an instant is due, samples that wait are taken: it leaves less to do when it is."""
_LOOK_AGAIN_NS = 1_000_000
"""Between two looks whether an instant is ready; a burst of samples is one look."""
_LATE_PERIODS = 0.5
_PEOPLE = 100
"""Of whom a tally is kept."""


class LiveEngine(Protocol):
    """What turns events into poses; holds no clock (`fusecap.engine.engine.Engine`)."""

    @property
    def notes(self) -> deque[str]:
        """What happened, in words; whoever reads them takes them out."""
        ...

    def take(self, event: Event) -> LiveStep | None:
        """One event; a step where it was a tick."""
        ...

    def ready(self, timestamp_ns: int, *, ahead: bool = False) -> bool:
        """Every fresh source has a sample at or after this time; `ahead`: every fresh sensor."""
        ...

    def expected(self, timestamp_ns: int) -> Sequence[np.ndarray]:
        """Per camera (m, k, 3) the people expected in its image."""
        ...


@dataclass(slots=True)
class PersonTally:
    """One person over a run."""

    instants: int = 0
    """With a pose to send."""
    measured: int = 0
    """With a pose that something measured."""
    bone_sigma_deg: float = 0.0
    """Sum over instants of the median over bones; so is the next."""
    position_sigma_m: float = 0.0
    found_anew: int = 0
    """Poses that did not fit and were replaced."""


class Solving:
    """Solves instants on one thread until stopped."""

    def __init__(
        self,
        engine: LiveEngine,
        inbox: Inbox,
        *,
        rate_hz: float,
        delay_ns: int,
        eager: bool,
        ahead: bool,
        clock: SessionClock,
        latency: LatencyBook,
        on_event: Callable[[Event, int], None],
        on_step: Callable[[LiveStep, int], None],
        expect: Callable[[Callable[[], Sequence[np.ndarray]]], None] | None,
        failed: Callable[[Exception], None],
    ) -> None:
        """`expect` takes where people are expected, for a detector.

        `failed` takes what the engine raised; the thread goes on with the next event.
        """
        self.solves = Meter()
        self.skipped = 0
        self.late = 0
        self.failures = 0
        """Events that the engine raised on, which is a fault of fusecap."""
        self.looked = 0
        """Instants for which some camera looked."""
        self.complete = 0
        """Those for which every camera that looked had samples on both sides."""
        self.people: dict[str, PersonTally] = {}
        self._engine = engine
        self._inbox = inbox
        self._rate_hz = rate_hz
        self._delay_ns = delay_ns
        self._eager = eager
        self._ahead = ahead
        self._next = 0
        """That pictures reach, with `ahead`."""
        self._detections_ns: int | None = None
        """The last instant that was looked at."""
        self._both_sides: set[int] = set()
        self._clock = clock
        self._latency = latency
        self._on_event = on_event
        self._on_step = on_step
        self._expect = expect
        self._failed = failed
        self._arrivals = Arrivals()
        self._stopping = threading.Event()
        self.name = "the solver"
        self._thread = threading.Thread(target=self._run, name="fusecap-solver", daemon=True)

    def start(self) -> None:
        """Begin with the next instant."""
        self._thread.start()

    def stop(self) -> None:
        """End before the next instant; does not wait."""
        self._stopping.set()
        self._inbox.wake()

    def join(self, timeout_s: float) -> bool:
        """Whether the thread has ended by then."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        instant = self._next = int(1e-9 * self._clock.now_ns() * self._rate_hz) + 1
        delay_ns = AHEAD_NS if self._ahead else self._delay_ns
        eager = self._ahead or self._eager
        while self._wait_for(instant, delay_ns, eager=eager):
            timestamp_ns = self._time_ns(instant)
            lateness_ns = self._clock.now_ns() - timestamp_ns - delay_ns
            self.late += lateness_ns > _LATE_PERIODS * 1e9 / self._rate_hz
            if self._ahead:
                self._solve_seen()
            self._solve(Tick(timestamp_ns=timestamp_ns, ahead=self._ahead))
            following = self._following(instant, delay_ns)
            self.skipped += following - instant - 1
            instant = following

    def _solve_seen(self) -> None:
        """Instants whose pictures are there, or are no longer waited for."""
        while not self._stopping.is_set():
            timestamp_ns = self._time_ns(self._next)
            due = self._clock.now_ns() >= timestamp_ns + self._delay_ns
            if not (due or (self._eager and self._engine.ready(timestamp_ns))):
                return
            self._solve(Tick(timestamp_ns=timestamp_ns))
            following = self._following(self._next, self._delay_ns)
            self.skipped += following - self._next - 1
            self._next = following

    def _following(self, instant: int, delay_ns: int) -> int:
        """The next one to solve."""
        newest = int(1e-9 * (self._clock.now_ns() - delay_ns) * self._rate_hz)
        return newest if newest > instant + 2 else instant + 1

    def _time_ns(self, instant: int) -> int:
        return round(instant * 1e9 / self._rate_hz)

    def _wait_for(self, instant: int, delay_ns: int, *, eager: bool) -> bool:
        """Take what arrives until the instant can be solved; False at the end of the run."""
        timestamp_ns = self._time_ns(instant)
        due_ns = timestamp_ns + delay_ns
        if not eager:
            self._inbox.wait_until(due_ns - _EARLY_NS)
            self._take_waiting()
        while not self._stopping.is_set():
            now_ns = self._clock.now_ns()
            if eager and now_ns < timestamp_ns:
                self._inbox.wait_until(timestamp_ns)
                continue
            self._take_waiting()
            if now_ns >= due_ns or (eager and self._engine.ready(timestamp_ns, ahead=self._ahead)):
                return True
            if eager:
                self._inbox.wait_until(min(due_ns, now_ns + _LOOK_AGAIN_NS))
            self._inbox.wait_until(due_ns, or_arrival=eager)
        return False

    def _take_waiting(self) -> None:
        for event, arrival_ns in self._inbox.take_all():
            self._engine_takes(event)
            if not isinstance(event, Command):
                self._arrivals.note(event, arrival_ns)
            self._on_event(event, arrival_ns)

    def _solve(self, tick: Tick) -> None:
        start_ns = self._clock.now_ns()
        step = self._engine_takes(tick)
        end_ns = self._clock.now_ns()
        self._on_event(tick, start_ns)
        if not tick.ahead:
            last_arrival_ns, self._both_sides = self._arrivals.instant(tick.timestamp_ns)
            self._latency.solved(tick.timestamp_ns, last_arrival_ns)
            if last_arrival_ns is not None:
                self._latency.add(LAST_SAMPLE_TO_SOLVE, start_ns - last_arrival_ns)
        self._latency.add(SOLVE, end_ns - start_ns)
        if step is None:
            return
        self._on_step(step, end_ns)
        self._latency.add(EXPOSURE_TO_POSE, end_ns - step.timestamp_ns)
        self._tally(step, end_ns)
        if self._expect is not None:
            self._expect(lambda: self._engine.expected(self._clock.now_ns()))

    def _engine_takes(self, event: Event) -> LiveStep | None:
        try:
            return self._engine.take(event)
        except Exception as error:  # one bad event must not end a run of hours
            self.failures += 1
            self._failed(error)
            return None

    def _tally(self, step: LiveStep, now_ns: int) -> None:
        self.solves.add(now_ns)
        cameras = len(step.detections.people)
        looked = step.detections.looked or (True,) * cameras
        looking = {camera for camera in range(cameras) if looked[camera]}
        if step.detections.timestamp_ns != self._detections_ns:
            self._detections_ns = step.detections.timestamp_ns
            self.looked += bool(looking)
            self.complete += bool(looking) and looking <= self._both_sides
        for name, estimate in step.people.items():
            if name not in self.people and (estimate is None or len(self.people) >= _PEOPLE):
                continue
            tally = self.people.setdefault(name, PersonTally())
            tally.found_anew += step.found_anew.get(name, 0)
            if estimate is None:
                continue
            tally.instants += 1
            tally.measured += estimate.measured
            tally.bone_sigma_deg += float(np.median(estimate.bone_sigma_deg))
            tally.position_sigma_m += float(np.median(estimate.position_sigma_m))
