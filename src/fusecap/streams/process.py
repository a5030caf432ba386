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
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import IO, Any

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
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.5, 30.0
"""Before a child that ended by itself is started again, twice as long each time."""
_STEADY_S = 60.0
"""A child that lived so long is started again as at first."""
_PROTOCOL = pickle.HIGHEST_PROTOCOL
_GONE = (OSError, EOFError, ValueError, pickle.UnpicklingError)
"""What a pipe says whose other end is gone, also in the middle of a message."""


class _Child:
    """One started process with its streams open; raises `InputError` where they cannot be."""

    def __init__(
        self,
        targets: Sequence[Target],
        cast: Cast,
        rate_hz: float,
        now_ns: Callable[[], int],
    ) -> None:
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "fusecap.streams.process"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                start_new_session=True,  # Ctrl-C and SIGHUP are for the parent, which then ends it
            )
        except OSError as error:
            raise InputError(
                f"the process for streams cannot be started: {error.strerror or error}"
            ) from error
        assert self._process.stdin is not None and self._process.stdout is not None
        self._to: IO[bytes] = self._process.stdin
        self._from: IO[bytes] = self._process.stdout
        try:
            self.tell((tuple(targets), cast, rate_hz, now_ns))
            opened = pickle.load(self._from)
        except _GONE:
            opened = "the process for streams did not start; look at its message above"
        if isinstance(opened, str):
            self.end()
            raise InputError(opened)
        self.addresses: tuple[dict[str, str], ...] = opened

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def tell(self, what: object) -> None:
        """Raises `OSError` where it is gone."""
        pickle.dump(what, self._to, _PROTOCOL)
        self._to.flush()

    def pass_on(self, packed: bytes) -> None:
        """What is pickled already; raises `OSError` where it is gone."""
        self._to.write(packed)
        self._to.flush()

    def reports(self) -> Iterator[tuple[list[tuple[int, int, int]], Any, tuple[int, ...]]]:
        """Until it ends."""
        with suppress(*_GONE):
            while (report := pickle.load(self._from)) is not None:
                yield report

    def end(self) -> int:
        """Waits a while for its end; the exit status."""
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._to, self._from):
            with suppress(OSError, ValueError):  # what waited for a child that is gone
                pipe.close()
        return self._process.returncode


class StreamProcess:
    """Hands instants to the child, and knows how each of its streams goes.

    A child that ends by itself is told of and started again, later each time that it does so soon.
    """

    def __init__(
        self,
        targets: Sequence[Target],
        cast: Cast,
        rate_hz: float,
        now_ns: Callable[[], int],
        on_sent: Callable[[int, int, int], None],
        report: Callable[[str], None],
    ) -> None:
        """`now_ns` is asked in the child; `on_sent` is told what `StreamOutput` tells.

        `report` hears of a child that ended and of one that took its place. Raises `InputError`
        where a stream cannot be opened.
        """
        self._start = partial(_Child, targets, cast, rate_hz, now_ns)
        self._child = self._start()
        self.addresses = self._child.addresses
        """Of each stream, the address per person where persons have addresses of their own."""
        self.gone = False
        """The child has ended by itself, and none has taken its place yet."""
        self._told = tuple(
            StreamStatus(to=str(target), sent=0, dropped=0, refused=0, failed=0, remark="")
            for target in targets
        )
        self._before, self._poses = self._told, (0,) * len(targets)
        self._poses_before = self._poses
        """What children that are gone had sent."""
        self._on_sent = on_sent
        self._report = report
        self._lost = 0
        self._queue: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._send, name="fusecap-streams", daemon=True),
            threading.Thread(target=self._attend, name="fusecap-streams-report", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def poses(self) -> tuple[int, ...]:
        """Of each stream, instants sent so far."""
        return tuple(map(sum, zip(self._poses_before, self._poses, strict=True)))

    def statuses(self) -> tuple[StreamStatus, ...]:
        """How each stream goes."""
        gone = "its process has ended and is started again"
        return tuple(
            StreamStatus(
                to=told.to,
                sent=before.sent + told.sent,
                dropped=before.dropped + told.dropped + self._lost,
                refused=before.refused + told.refused,
                failed=before.failed + told.failed,
                remark=gone if self.gone else told.remark,
            )
            for before, told in zip(self._before, self._told, strict=True)
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
            self._closing.set()
            self._changed.notify()
        for thread in self._threads:
            thread.join(_CLOSE_S)
        self._child.end()

    def _send(self) -> None:
        while (packed := self._next()) is not None:
            try:
                self._child.pass_on(packed)
            except (OSError, ValueError):  # it is gone, and whoever hears it starts another
                with self._changed:
                    self._lost += 1
        with suppress(OSError, ValueError):
            self._child.tell(None)

    def _next(self) -> bytes | None:
        with self._changed:
            while not (self._queue and not self.gone) and not self._closing.is_set():
                self._changed.wait()
            return self._queue.popleft() if self._queue and not self.gone else None

    def _attend(self) -> None:
        """Hears the child, and starts another where it ends."""
        pause_s = _FIRST_PAUSE_S
        while True:
            began_s = time.monotonic()
            for sent, told, poses in self._child.reports():
                self._told, self._poses = told, poses
                for times_ns in sent:
                    self._on_sent(*times_ns)
            if self._closing.is_set():
                return
            self.gone = True
            if time.monotonic() - began_s > _STEADY_S:
                pause_s = _FIRST_PAUSE_S
            self._report(
                f"streams: their process ended ({_how(self._child.end())}); it is started again"
            )
            self._before, self._told = self.statuses(), tuple(_zero(told) for told in self._told)
            self._poses_before, self._poses = self.poses, (0,) * len(self._poses)
            with self._changed:
                self._lost = 0
            while not self._closing.wait(pause_s):
                pause_s = min(2.0 * pause_s, _LONGEST_PAUSE_S)
                try:
                    self._child = self._start()
                except InputError as error:
                    self._report(f"streams: cannot be opened again yet ({error})")
                    continue
                break
            else:
                return
            with self._changed:
                self.gone = False
                self._changed.notify()
            self._report("streams: sent again")


def _zero(told: StreamStatus) -> StreamStatus:
    return StreamStatus(to=told.to, sent=0, dropped=0, refused=0, failed=0, remark="")


def _how(status: int) -> str:
    return f"killed by signal {-status}" if status < 0 else f"exit code {status}"


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
    with suppress(*_GONE):  # the parent is
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
