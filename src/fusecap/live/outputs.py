"""A stream that takes part in a live run: in a thread of its own, so that no receiver slows anyone.

The solver leaves the newest instant and goes on. A stream that is slow, or whose receiver stalls,
misses instants, which are counted; the others do not notice.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

import numpy as np

from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.live.health import Meter
from fusecap.live.latency import LatencyBook
from fusecap.live.source import SessionClock
from fusecap.live.status import LiveStatus, StreamStatus
from fusecap.live.streams import Cast, Stream
from fusecap.online.setup import LiveSetup
from fusecap.online.step import LiveStep
from fusecap.sinks.streams.person_pose import PersonPose, StreamFrame, pose_of_estimate
from fusecap.types import CameraImage, Event

QUEUE = 3
"""Instants that a stream may lie behind before it loses the oldest."""
_NEWS_EVERY_NS = 1_000_000_000
"""Between two announcements that a body is now measured otherwise."""
_SAME_BODY_M = 0.002
_CLOSE_S = 1.5


def first_cast(setup: LiveSetup) -> Cast:
    """The session's people with the bodies known so far, before anyone is found."""
    skeleton = setup.session.skeleton
    return {
        subject.name: BodyShape.from_height(
            skeleton, subject.height_m or REFERENCE_HEIGHT_M
        ).with_lengths(subject.bone_lengths_m)
        for subject in setup.session.subjects
    }


class StreamOutput:
    """A `Listener` that sends every instant to one stream."""

    def __init__(
        self,
        open_stream: Callable[[Cast], Stream],
        cast: Cast,
        clock: SessionClock,
        latency: LatencyBook,
    ) -> None:
        """Raises what opening the stream raises."""
        self._cast = dict(cast)
        self._stream = open_stream(dict(cast))
        self._clock = clock
        self._latency = latency
        self._meter = Meter()
        self._missed = 0
        self._trouble = ""
        self._told_ns = clock.now_ns()
        self._queue: deque[tuple[LiveStep, int]] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(
            target=self._run, name=f"fusecap-stream {self._stream.target}", daemon=True
        )
        self._thread.start()

    @property
    def poses(self) -> int:
        """Instants sent so far."""
        return self._meter.total

    @property
    def poses_per_s(self) -> float:
        """Instants sent, over the last seconds."""
        return self._meter.rate_hz(self._clock.now_ns())

    def where(self) -> dict[str, str]:
        """Address per person, where persons have addresses of their own."""
        return self._stream.where()

    def stream_status(self) -> StreamStatus:
        """How it goes."""
        counts = self._stream.counts
        return StreamStatus(
            to=str(self._stream.target),
            sent=counts.sent,
            dropped=counts.dropped + self._missed,
            refused=counts.refused,
            failed=counts.failed,
            remark=self._trouble or self._stream.remark(),
        )

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """Streams send poses only."""

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """Leave the instant for the stream's thread."""
        with self._changed:
            if len(self._queue) >= QUEUE:
                self._queue.popleft()
                self._missed += 1
            self._queue.append((step, now_ns))
            self._changed.notify()

    def on_image(self, image: CameraImage) -> None:
        """Streams send poses only."""

    def on_status(self, status: LiveStatus) -> None:
        """Streams send poses only."""

    def close(self) -> None:
        """Send what waits, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(_CLOSE_S)
        if not self._thread.is_alive():
            self._stream.close()

    def _run(self) -> None:
        while (next_one := self._next()) is not None:
            step, handed_ns = next_one
            try:
                self._send(step, handed_ns)
            except Exception as error:  # one stream's trouble is its own
                self._stream.counts.failed += 1
                self._trouble = f"{type(error).__name__}: {error}"

    def _next(self) -> tuple[LiveStep, int] | None:
        with self._changed:
            while not self._queue and not self._closing:
                self._changed.wait()
            return self._queue.popleft() if self._queue else None

    def _send(self, step: LiveStep, handed_ns: int) -> None:
        poses = {
            name: None if estimate is None else pose_of_estimate(estimate)
            for name, estimate in step.people.items()
        }
        self._update_cast(poses)
        frame = StreamFrame(
            time_s=1e-9 * step.timestamp_ns,
            timestamp_ns=step.timestamp_ns,
            people={name: poses.get(name) for name in self._cast},
        )
        self._stream.send(frame)
        now_ns = self._clock.now_ns()
        self._meter.add(now_ns)
        self._latency.sent(step.timestamp_ns, handed_ns, now_ns)
        self._trouble = ""

    def _update_cast(self, poses: dict[str, PersonPose | None]) -> None:
        """Tell the stream of people who are new or gone at once, of new bodies once a second."""
        cast = {
            name: pose.shape if pose is not None else self._cast.get(name)
            for name, pose in poses.items()
        }
        known = {name: shape for name, shape in cast.items() if shape is not None}
        if list(known) == list(self._cast):
            now_ns = self._clock.now_ns()
            if now_ns - self._told_ns < _NEWS_EVERY_NS:
                return
            if all(_alike(shape, self._cast[name]) for name, shape in known.items()):
                return
            self._told_ns = now_ns
        self._cast = known
        self._stream.set_cast(dict(known))


def _alike(a: BodyShape, b: BodyShape) -> bool:
    return a is b or bool(np.all(np.abs(a.offsets_m - b.offsets_m) < _SAME_BODY_M))
