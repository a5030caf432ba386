"""All streams of a live run in one process of their own, so that encoding costs the solver nothing.

Python computes on one thread at a time: what four streams encode, a few milliseconds per instant,
would come out of the time between a sample and its pose. So the solver's thread only packs an
instant's poses; a thread passes them on to a child, which sends them to one stream after the other.
The child tells four times a second what it has sent and when; both processes read one clock.

    python -m fusecap.streams.process        the child; pickles on stdin and stdout
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import IO

from fusecap.errors import InputError
from fusecap.streams.output import StreamOutput, StreamStatus
from fusecap.streams.person_pose import PersonPose
from fusecap.streams.stream import Cast, open_stream
from fusecap.streams.target import Target

QUEUE = 3
"""Instants that the child may lie behind before the oldest is lost."""
_REPORT_S = 0.25
_SENT = 4096
"""Instants between two reports, at most."""
_CLOSE_S = 4.0
_PROTOCOL = pickle.HIGHEST_PROTOCOL


class StreamProcess:
    """Hands instants to the child, and knows how each of its streams goes."""

    def __init__(
        self,
        targets: Sequence[Target],
        cast: Cast,
        rate_hz: float,
        now_ns: Callable[[], int],
        on_sent: Callable[[int, int, int], None],
    ) -> None:
        """`now_ns` is asked in the child; `on_sent` is told what `StreamOutput` tells.

        Raises `InputError` where a stream cannot be opened.
        """
        self.addresses: tuple[dict[str, str], ...]
        """Of each stream, the address per person where persons have addresses of their own."""
        self.poses = (0,) * len(targets)
        """Of each stream, instants sent so far."""
        self.gone = False
        """The child has ended by itself."""
        self._told = tuple(
            StreamStatus(to=str(target), sent=0, dropped=0, refused=0, failed=0, remark="")
            for target in targets
        )
        self._on_sent = on_sent
        self._lost = 0
        self._queue: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", "fusecap.streams.process"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        self._to: IO[bytes] = self._process.stdin
        self._from: IO[bytes] = self._process.stdout
        try:
            pickle.dump((tuple(targets), cast, rate_hz, now_ns), self._to, _PROTOCOL)
            self._to.flush()
            opened = pickle.load(self._from)
        except (OSError, EOFError):
            opened = "the process for streams did not start; look at its message above"
        if isinstance(opened, str):
            self._end()
            raise InputError(opened)
        self.addresses = opened
        self._threads = [
            threading.Thread(target=self._send, name="fusecap-streams", daemon=True),
            threading.Thread(target=self._hear, name="fusecap-streams-report", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def statuses(self) -> tuple[StreamStatus, ...]:
        """How each stream goes."""
        gone = "its process has ended; start the run again"
        return tuple(
            replace(
                told,
                dropped=told.dropped + self._lost,
                remark=gone if self.gone else told.remark,
            )
            for told in self._told
        )

    def send(
        self, poses: Mapping[str, PersonPose | None], timestamp_ns: int, handed_ns: int
    ) -> None:
        """Leave an instant's poses for the child; returns at once."""
        packed = pickle.dumps((dict(poses), timestamp_ns, handed_ns), _PROTOCOL)
        with self._changed:
            if len(self._queue) >= QUEUE:
                self._queue.popleft()
                self._lost += 1
            self._queue.append(packed)
            self._changed.notify()

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
                sent, self._told, self.poses = report
                for times_ns in sent:
                    self._on_sent(*times_ns)
        except (OSError, EOFError, pickle.UnpicklingError):
            self.gone = True

    def _end(self) -> None:
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._to, self._from):
            with suppress(OSError):  # what waited for a child that is gone
                pipe.close()


def _child(source: IO[bytes], sink: IO[bytes]) -> None:
    """Opens the streams, feeds them until the parent ends, and reports."""
    targets, cast, rate_hz, now_ns = pickle.load(source)
    sent = deque[tuple[int, int, int]](maxlen=_SENT)
    outputs = list[StreamOutput]()

    def on_sent(timestamp_ns: int, handed_ns: int, sent_ns: int) -> None:
        sent.append((timestamp_ns, handed_ns, sent_ns))

    try:
        for target in targets:
            opened = partial(open_stream, target, rate_hz=rate_hz)
            outputs.append(StreamOutput(opened, cast, now_ns, on_sent))
    except InputError as error:
        _tell(sink, str(error))
        _close(outputs)
        return
    _tell(sink, tuple(output.where() for output in outputs))
    ended = threading.Event()

    def report() -> None:
        last = False
        while not last:
            last = ended.wait(_REPORT_S)
            _tell(
                sink,
                (
                    [sent.popleft() for _ in range(len(sent))],
                    tuple(output.status() for output in outputs),
                    tuple(output.poses for output in outputs),
                ),
            )

    reporting = threading.Thread(target=report, daemon=True)
    reporting.start()
    with suppress(EOFError):  # the parent is gone
        while (instant := pickle.load(source)) is not None:
            for output in outputs:
                output.send(*instant)
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
