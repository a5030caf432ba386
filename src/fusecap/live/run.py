"""A live run: sources, detector, solver and listeners, each on a thread of its own.

    sources ──images──▶ newest per camera ──▶ detector ─┐
       └──────────keypoints, sensors──────────────────▶ inbox ──▶ solver ──▶ listeners
                                                                    └──▶ where to look ──▶ detector

Only the solver's thread touches the engine. Events reach engine and listeners in one order, and
that order alone determines the poses: a recording of it replays to the same bits. Nothing that the
solver does waits: queues are bounded, and a listener must return at once.
"""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from fusecap.detect.detector import Detector
from fusecap.engine.engine import FARTHEST_AHEAD_S, Engine
from fusecap.errors import SessionError
from fusecap.live.detection import DetectionLoop
from fusecap.live.devices.source import Delivery, SessionClock, Source
from fusecap.live.feed import Feed
from fusecap.live.health import Incidents, Key, ProcessLoad, inputs_of, key_of
from fusecap.live.inbox import Inbox
from fusecap.live.input_check import InputCheck
from fusecap.live.latency import CAMERA, SENSOR, LatencyBook
from fusecap.live.listeners import Listener, Listeners
from fusecap.live.report import LiveReport, subject_reports
from fusecap.live.solving import LiveEngine, Solving
from fusecap.live.status import LiveStatus, SourceStatus
from fusecap.setup import SessionSetup
from fusecap.types import CameraImage, CameraSample, Command

DELAY_WITH_DETECTOR_S = 0.2
DELAY_S = 0.05
_SWITCH_INTERVAL_S = 0.0005
"""How long a thread that computes in Python may keep the others waiting."""
_LOOK_S = 0.1
_ROLL_S = 5
_SHOWN = 20
"""Incidents in a status."""
SOONEST_NS = 100_000_000
"""A sample stamped so much later than it came is off: nothing is measured after it arrived."""
_JOIN_S = 2.0
"""For all threads together, when the run ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveOptions:
    """How a run goes; None: what the session says, else what fits."""

    delay_s: float | None = None
    """Between exposure and solve; 0.2 with a detector in the loop, 0.05 without."""
    eager: bool | None = None
    """Solve as soon as every source has what is needed; without a detector."""


class LiveRun:
    """One run from start to report."""

    def __init__(
        self,
        setup: SessionSetup,
        sources: Sequence[Source],
        detector: Detector | None,
        options: LiveOptions | None = None,
        listeners: Sequence[Listener] = (),
        clock: SessionClock | None = None,
        engine: LiveEngine | None = None,
    ) -> None:
        """`clock` is the one that the sources were made with.

        Without an `engine` it is the one for `setup`.
        """
        options = options or LiveOptions()
        live = setup.session.live
        self.setup = setup
        self.begun = False
        """Events may have been taken."""
        self.clock = clock or SessionClock()
        self.latency = LatencyBook()
        self.incidents = Incidents(self.clock)
        self.rate_hz = setup.session.settings.rate_hz
        delay_s = live.delay_s if options.delay_s is None else options.delay_s
        eager = live.eager if options.eager is None else options.eager
        usual_s = DELAY_S if detector is None else DELAY_WITH_DETECTOR_S
        self.delay_s = usual_s if delay_s is None else delay_s
        self.eager = detector is None if eager is None else eager
        if live.poses == "ahead" and self.delay_s > FARTHEST_AHEAD_S:
            raise SessionError(
                f'poses = "ahead" goes {FARTHEST_AHEAD_S:g} s beyond pictures at most, and these '
                f"are {self.delay_s:g} s late; state a shorter delay, or send them solved"
            )
        self._engine = engine or Engine(setup)
        self._inbox = Inbox(self.clock)
        self._inputs = inputs_of(setup)
        self._listeners = Listeners(
            (InputCheck(setup, self.incidents.add), *listeners), self.incidents.add
        )
        self._refused: set[str] = set()
        self._feed_of: dict[Key, Feed] = {}
        self._lateness: deque[tuple[int, int]] = deque([(0, 0)], maxlen=_ROLL_S + 1)
        self._sent: deque[tuple[int, float]] = deque(maxlen=_ROLL_S)
        self._seconds = 0
        self._begun_ns = self._end_ns = self.clock.now_ns()
        self._ended_ns: int | None = None
        self._threads_left: tuple[str, ...] = ()
        self._stopping = threading.Event()
        self._load = ProcessLoad()
        self._feeds = [Feed(source, self._deliver, self.incidents) for source in sources]
        self._detection = (
            None
            if detector is None
            else DetectionLoop(
                detector,
                len(setup.rig),
                emit=self._inbox.put,
                show=lambda image: self._listeners.tell("on_image", image),
                clock=self.clock,
                latency=self.latency,
                incidents=self.incidents,
            )
        )
        self._solving = Solving(
            self._engine,
            self._inbox,
            rate_hz=self.rate_hz,
            delay_ns=round(1e9 * self.delay_s),
            eager=self.eager,
            ahead=live.poses == "ahead",
            clock=self.clock,
            latency=self.latency,
            on_event=lambda event, arrival_ns: self._listeners.tell("on_event", event, arrival_ns),
            on_step=lambda step, now_ns: self._listeners.tell("on_step", step, now_ns),
            expect=self._detection.expect if self._detection else None,
            failed=self._engine_failed,
        )
        self._status = self._make_status(self._begun_ns)

    # Whoever holds the run

    def run(self, seconds: float | None = None) -> LiveReport:
        """Until stopped, until every source has ended, or for so long; then closes listeners."""
        self.begun = True
        self._begun_ns = self.clock.now_ns()
        self._sent.clear()
        self._sent.append((self._begun_ns, 0.0))
        with _undisturbed():
            try:
                self._solving.start()
                if self._detection is not None:
                    self._detection.start()
                for feed in self._feeds:
                    feed.start()
                self._attend(seconds)
            finally:
                self._end()
        return self._report()

    def stop(self) -> None:
        """End the run soon; from any thread, also before `run`."""
        self._stopping.set()

    def close(self) -> None:
        """Close listeners of a run that never began."""
        self._listeners.close()

    def submit(self, command: Command) -> None:
        """A user's wish, to be taken before the next instant; from any thread."""
        self._inbox.put(command)

    def add_listener(self, listener: Listener) -> None:
        """Takes part from the next event on."""
        self._listeners.add(listener)

    def remove_listener(self, listener: Listener) -> None:
        """Takes no more part, and is closed."""
        self._listeners.remove(listener)

    def status(self) -> LiveStatus:
        """As of the last second."""
        return self._status

    # Threads

    def _attend(self, seconds: float | None) -> None:
        """What happens once in a while: lights, status, the end."""
        next_status_ns = self._begun_ns + 1_000_000_000
        while not self._stopping.wait(_LOOK_S):
            now_ns = self.clock.now_ns()
            self._note_changes(now_ns)
            if now_ns >= next_status_ns:
                next_status_ns += 1_000_000_000 * (1 + (now_ns - next_status_ns) // 1_000_000_000)
                self._status = self._make_status(now_ns)
                self._listeners.tell("on_status", self._status)
            if seconds is not None and now_ns - self._begun_ns >= 1e9 * seconds:
                return
            if self._feeds and all(feed.finished for feed in self._feeds):
                seconds = self._drained(now_ns)

    def _drained(self, now_ns: int) -> float:
        """Seconds of the run that it takes until what has come is solved."""
        busy = self._detection is not None and not self._detection.idle
        if self._ended_ns is None or busy:
            self._ended_ns = now_ns
        return 1e-9 * (self._ended_ns - self._begun_ns) + self.delay_s + _LOOK_S

    def _end(self) -> None:
        self._end_ns = self.clock.now_ns()
        self._stopping.set()
        threads = [*self._feeds, *([self._detection] if self._detection else []), self._solving]
        for thread in threads:
            thread.stop()
        deadline_s = time.monotonic() + _JOIN_S
        left = [one for one in threads if not one.join(max(0.0, deadline_s - time.monotonic()))]
        self._threads_left = tuple(one.name for one in left)
        self._listeners.close()

    def _deliver(self, item: Delivery, feed: Feed) -> None:
        now_ns = self.clock.now_ns()
        key = key_of(item)
        source = self._inputs.get(key)
        if source is None:
            self._refuse(f"{feed.source.name} delivers for {key}, which the session does not have")
            return
        if item.timestamp_ns > now_ns + SOONEST_NS:
            feed.source.counts.dropped += 1
            self._refuse(
                f"{feed.source.name}: samples from the future are left out; see its clock and "
                "offset_s"
            )
            return
        source.arrived(now_ns)
        self._feed_of[key] = feed
        if not isinstance(item, CameraImage):
            stage = CAMERA if isinstance(item, CameraSample) else SENSOR
            self.latency.add(stage, now_ns - item.timestamp_ns)
            self._inbox.put(item)
        elif self._detection is not None:
            self._detection.offer(item)
        else:
            self._refuse(f"{feed.source.name} delivers images, and there is no detector")

    def _refuse(self, why: str) -> None:
        if why not in self._refused:
            self._refused.add(why)
            self.incidents.add(why)

    def _engine_failed(self, error: Exception) -> None:
        self._refuse(
            f"internal error: {type(error).__name__}: {error}. This is a fault of fusecap; please "
            "report it with the recording"
        )

    # What is shown

    def _note_changes(self, now_ns: int) -> None:
        """One incident for all that were lost since the last look, one for all that are back."""
        while self._engine.notes:
            self.incidents.add(self._engine.notes.popleft())
        self._listeners.close_broken()
        changes: dict[str, list[str]] = {}
        for key, source in self._inputs.items():
            feed = self._feed_of.get(key)
            source.gone = feed is not None and feed.gone
            change = source.change(now_ns)
            if change:
                changes.setdefault(change, []).append(f"{source.kind} '{source.name}'")
        for change, names in changes.items():
            self.incidents.add(f"{', '.join(names)}: {change}")

    def _make_status(self, now_ns: int) -> LiveStatus:
        self._seconds += 1
        if self._seconds % _ROLL_S == 0:
            self.latency.roll()
        solving = self._solving
        self._lateness.append(
            (solving.late + solving.skipped, solving.solves.total + solving.skipped)
        )
        (late_before, before), (late, instants) = self._lateness[0], self._lateness[-1]
        self._sent.append((now_ns, self._listeners.poses))
        (sent_before_ns, sent_before), (_, sent) = self._sent[0], self._sent[-1]
        return LiveStatus(
            elapsed_s=1e-9 * (now_ns - self._begun_ns),
            detections_per_s=self._detections_per_s(now_ns),
            solves_per_s=solving.solves.rate_hz(now_ns),
            packets_per_s=1e9 * (sent - sent_before) / max(now_ns - sent_before_ns, 1),
            late_share=(late - late_before) / max(instants - before, 1),
            sources=self._sources(now_ns),
            latency=self.latency.window(),
            streams=self._listeners.stream_statuses(),
            recording=self._listeners.recording_status(),
            incidents=self.incidents.all()[-_SHOWN:],
            cpu_share=self._load.recent_cpu_share(),
            memory_mb=self._load.memory_mb(),
        )

    def _sources(self, now_ns: int) -> tuple[SourceStatus, ...]:
        statuses = []
        for key, source in self._inputs.items():
            feed = self._feed_of.get(key)
            overtaken = 0
            if self._detection is not None and isinstance(key, int):
                overtaken = self._detection.overtaken[key]
            statuses.append(source.status(now_ns, overtaken, feed.note if feed else ""))
        return tuple(statuses)

    def _detections_per_s(self, now_ns: int) -> float:
        if self._detection is not None:
            return self._detection.rounds.rate_hz(now_ns)
        cameras = (one for one in self._inputs.values() if one.kind == "camera")
        return sum(camera.meter.rate_hz(now_ns) for camera in cameras)

    def _report(self) -> LiveReport:
        solving, detection = self._solving, self._detection
        elapsed_s = 1e-9 * (self._end_ns - self._begun_ns)
        instants = solving.solves.total
        cameras = [one for one in self._inputs.values() if one.kind == "camera"]
        detections = (
            sum(one.meter.total for one in cameras) if detection is None else detection.rounds.total
        )
        return LiveReport(
            simulated=self.setup.simulated,
            elapsed_s=elapsed_s,
            rate_hz=self.rate_hz,
            delay_s=self.delay_s,
            eager=self.eager,
            poses=self.setup.session.live.poses,
            instants=instants,
            skipped=solving.skipped,
            late_share=(solving.late + solving.skipped) / max(instants + solving.skipped, 1),
            complete_share=solving.complete / max(solving.looked, 1),
            solves_per_s=instants / elapsed_s,
            detections=detections,
            detections_per_s=detections / elapsed_s,
            detector_failures=detection.failures if detection else 0,
            packets_per_s=self._listeners.poses / elapsed_s,
            events_dropped=self._inbox.dropped,
            latency=self.latency.total(),
            subjects=subject_reports(solving.people, instants),
            inputs=self._sources(self._end_ns),
            sources=tuple(feed.report() for feed in self._feeds),
            streams=self._listeners.stream_statuses(),
            recordings=tuple(self._listeners.recorded),
            incidents=self.incidents.all(),
            incident_count=self.incidents.count,
            cpu_share=self._load.cpu_share(),
            memory_mb=self._load.memory_mb(),
            memory_peak_mb=self._load.peak_mb,
            threads_left=self._threads_left,
        )


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Short turns for threads, and no long pauses for garbage that came before the run."""
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(interval_s)
