"""All streams of a run in one process of their own, so that encoding costs the solver nothing.

Python computes on one thread at a time: what four streams encode, a few milliseconds per instant,
would come out of the time between a sample and its pose. So the solver's thread only packs an
instant's poses; a thread passes them on to a child, which sends them to one stream after the other.
The child tells four times a second what it has sent and when; both processes read one clock.

    python -m fusecap.live.stream_process        the child; pickles on stdin and stdout
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import IO

from fusecap.engine.engine import LiveStep
from fusecap.errors import InputError
from fusecap.live.devices.source import SessionClock
from fusecap.live.latency import LatencyBook
from fusecap.live.outputs import StreamOutput
from fusecap.live.status import LiveStatus, StreamStatus
from fusecap.streams.person_pose import pose_of_estimate
from fusecap.streams.streams import Cast, open_stream
from fusecap.streams.target import Target
from fusecap.types import CameraImage, Event

QUEUE = 3
"""Instants that the child may lie behind before the oldest is lost."""
_REPORT_S = 0.25
_CLOSE_S = 4.0
_PROTOCOL = pickle.HIGHEST_PROTOCOL


class StreamProcess:
    """A `Listener` that hands instants to the child; its `outputs` say how each stream goes."""

    def __init__(
        self,
        targets: Sequence[Target],
        cast: Cast,
        rate_hz: float,
        clock: SessionClock,
        latency: LatencyBook,
    ) -> None:
        """Raises `InputError` where a stream cannot be opened."""
        self.outputs = tuple(RemoteOutput(target) for target in targets)
        self._latency = latency
        self._lost = 0
        self._queue: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fusecap.live.stream_process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._to: IO[bytes] = self._process.stdin
        self._from: IO[bytes] = self._process.stdout
        try:
            pickle.dump((tuple(targets), cast, rate_hz, clock), self._to, _PROTOCOL)
            self._to.flush()
            opened = pickle.load(self._from)
        except (OSError, EOFError):
            opened = "the process for streams did not start; look at its message above"
        if isinstance(opened, str):
            self._end()
            raise InputError(opened)
        for output, where in zip(self.outputs, opened, strict=True):
            output.addresses = where
        self._threads = [
            threading.Thread(target=self._send, name="fusecap-streams", daemon=True),
            threading.Thread(target=self._hear, name="fusecap-streams-report", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """Streams send poses only."""

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """Leave the instant's poses for the child."""
        packed = pickle.dumps((step.timestamp_ns, dict(step.people), now_ns), _PROTOCOL)
        with self._changed:
            if len(self._queue) >= QUEUE:
                self._queue.popleft()
                self._lost += 1
            self._queue.append(packed)
            self._changed.notify()

    def on_image(self, image: CameraImage) -> None:
        """Streams send poses only."""

    def on_status(self, status: LiveStatus) -> None:
        """Streams send poses only."""

    def close(self) -> None:
        """Send what waits, and end the child."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        for thread in self._threads:
            thread.join(_CLOSE_S)
        self._end()

    def _send(self) -> None:
        with suppress(OSError):  # it is gone, and whoever hears it says so
            while (packed := self._next()) is not None:
                self._to.write(packed)
                self._to.flush()
            pickle.dump(None, self._to, _PROTOCOL)
            self._to.flush()

    def _next(self) -> bytes | None:
        with self._changed:
            while not self._queue and not self._closing:
                self._changed.wait()
            return self._queue.popleft() if self._queue else None

    def _hear(self) -> None:
        try:
            while (report := pickle.load(self._from)) is not None:
                sent, told = report
                for times_ns in sent:
                    self._latency.sent(*times_ns)
                for output, now in zip(self.outputs, told, strict=True):
                    output.learn(*now, lost=self._lost)
        except (OSError, EOFError, pickle.UnpicklingError):
            for output in self.outputs:
                output.gone = True

    def _end(self) -> None:
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._to, self._from):
            with suppress(OSError):  # what waited for a child that is gone
                pipe.close()


class RemoteOutput:
    """How one stream of the child goes; `Sending`, and a listener that has nothing to do."""

    def __init__(self, target: Target) -> None:
        self.addresses: dict[str, str] = {}
        self.gone = False
        """The child has ended by itself."""
        self.poses = 0
        self._poses_per_s = 0.0
        self._lost = 0
        self._status = StreamStatus(
            to=str(target), sent=0, dropped=0, refused=0, failed=0, remark=""
        )

    @property
    def poses_per_s(self) -> float:
        """Instants sent, over the last seconds."""
        return 0.0 if self.gone else self._poses_per_s

    def where(self) -> dict[str, str]:
        """Address per person, where persons have addresses of their own."""
        return self.addresses

    def stream_status(self) -> StreamStatus:
        """How it goes."""
        status = self._status
        return StreamStatus(
            to=status.to,
            sent=status.sent,
            dropped=status.dropped + self._lost,
            refused=status.refused,
            failed=status.failed,
            remark="its process has ended; start the run again" if self.gone else status.remark,
        )

    def learn(self, status: StreamStatus, poses: int, poses_per_s: float, *, lost: int) -> None:
        """What the child tells."""
        self._status, self.poses, self._poses_per_s, self._lost = status, poses, poses_per_s, lost

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """The child's."""

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """The child's."""

    def on_image(self, image: CameraImage) -> None:
        """The child's."""

    def on_status(self, status: LiveStatus) -> None:
        """The child's."""

    def close(self) -> None:
        """The child's."""


class _Sent(LatencyBook):
    """Keeps when instants were sent, for the parent."""

    def __init__(self) -> None:
        super().__init__()
        self._sent: deque[tuple[int, int, int]] = deque(maxlen=4096)

    def sent(self, timestamp_ns: int, taken_ns: int, sent_ns: int) -> None:
        self._sent.append((timestamp_ns, taken_ns, sent_ns))

    def taken(self) -> list[tuple[int, int, int]]:
        """Those since the last call."""
        return [self._sent.popleft() for _ in range(len(self._sent))]


def _child(source: IO[bytes], sink: IO[bytes]) -> None:
    """Opens the streams, feeds them until the parent ends, and reports."""
    targets, cast, rate_hz, clock = pickle.load(source)
    sent, outputs = _Sent(), list[StreamOutput]()
    try:
        for target in targets:
            opened = partial(open_stream, target, rate_hz=rate_hz)
            outputs.append(StreamOutput(opened, cast, clock, sent))
    except InputError as error:
        _tell(sink, str(error))
        _close(outputs)
        return
    _tell(sink, [output.where() for output in outputs])
    ended = threading.Event()

    def report() -> None:
        last = False
        while not last:
            last = ended.wait(_REPORT_S)
            told = [(o.stream_status(), o.poses, o.poses_per_s) for o in outputs]
            _tell(sink, (sent.taken(), told))

    reporting = threading.Thread(target=report, daemon=True)
    reporting.start()
    with suppress(EOFError):  # the parent is gone
        while (instant := pickle.load(source)) is not None:
            timestamp_ns, people, handed_ns = instant
            poses = {name: each and pose_of_estimate(each) for name, each in people.items()}
            for output in outputs:
                output.send(poses, timestamp_ns, handed_ns)
    _close(outputs)
    ended.set()
    reporting.join()
    _tell(sink, None)


def _close(outputs: Sequence[StreamOutput]) -> None:
    for output in outputs:
        output.close()


def _tell(sink: IO[bytes], what: object) -> None:
    with suppress(OSError):  # the parent is gone
        pickle.dump(what, sink, _PROTOCOL)
        sink.flush()


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then ends this
    with os.fdopen(os.dup(sys.stdout.fileno()), "wb") as reports:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a library prints is no report
        _child(sys.stdin.buffer, reports)
