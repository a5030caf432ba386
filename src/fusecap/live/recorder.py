"""Records a run while it goes on: a queue in memory and a thread that writes it to a file.

The run's threads only enqueue. Whatever befalls the file (the disk fills, is too slow, or goes)
ends the recording with a note, never the run; what was written until then opens. No event is ever
left out in between: a queue that runs over first loses pictures, and then ends the recording.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from fusecap.engine.engine import LiveStep
from fusecap.errors import InputError
from fusecap.live.devices.source import SessionClock
from fusecap.live.run import LiveRun
from fusecap.live.status import LiveStatus, RecordingStatus
from fusecap.recording.setup_json import setup_values
from fusecap.recording.writer import RecordingWriter
from fusecap.setup import SessionSetup
from fusecap.types import CameraImage, CameraSample, Estimate, Event

QUEUE_BYTES = 64 << 20
"""Held in memory when the disk does not follow; half a minute of 4 cameras and 26 sensors."""
IMAGE_BYTES = QUEUE_BYTES // 2
"""Of the queue, before pictures are left out."""
FLUSH_S = 0.5
SYNC_S = 1.0
"""How often the operating system is made to write, against power cuts."""
LOOK_S = 1.0
"""How often file and disk are looked at."""
MIN_FREE_BYTES = 50_000_000
"""To begin: about a minute of 4 cameras and 26 sensors."""
WARN_MINUTES = 5.0
"""Left on the disk, at the rate so far."""
JPEG_QUALITY = 80
_POLL_S = 0.05
_PACKETS_FIRST_S = 0.004
"""After an instant: its packets leave before it is written."""
_BATCH = 200
"""Items between two looks at the time."""
_ITEM_BYTES = 500
"""About what an event takes besides its arrays."""
_CLOSE_S = 10.0


class Recorder:
    """One recording, a `Listener` of a run. Raises `InputError` where the file cannot be begun."""

    def __init__(
        self,
        path: Path | str,
        setup: SessionSetup,
        clock: SessionClock,
        *,
        from_start: bool = True,
        images: bool = False,
        report: Callable[[str], None] | None = None,
        open_file: Callable[[Path], BinaryIO] | None = None,
    ) -> None:
        """Without `from_start` the run has taken events before; `report` hears of incidents."""
        self.path = Path(path)
        self.images_left_out = 0
        """Because the disk was too slow."""
        self._images = images
        self._report = report or (lambda what: None)
        self._problem = ""
        self._warned = False
        self._queue: deque[tuple[Callable[[], None], int]] = deque()
        self._queued_bytes = 0
        self._lock = threading.Lock()
        self._closing = threading.Event()
        self._solved = threading.Event()
        self._begun_s = self._ended_s = time.monotonic()
        self._bytes = 0
        self._file = (open_file or _new_file)(self.path)
        try:
            self._identity = _identity(os.stat(self.path))
            self._writer = RecordingWriter(
                self._file,
                setup_values(setup),
                cameras=setup.rig.names,
                unix_minus_session_ns=time.time_ns() - clock.now_ns(),
                from_start=from_start,
            )
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror or error}") from None
        self._thread = threading.Thread(target=self._run, name="fusecap-recorder", daemon=True)
        self._thread.start()

    # Listener

    def on_event(self, event: Event, arrival_ns: int) -> None:
        size = event.people.nbytes if isinstance(event, CameraSample) else 0
        self._put(lambda: self._writer.event(event, arrival_ns), size)

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        people: list[Estimate] = [one for one in step.people.values() if one is not None]
        if people:
            size = sum(5 * one.bone_rotation_in_world.nbytes for one in people)
            self._put(lambda: self._writer.poses(people, now_ns), size)
        self._solved.set()

    def on_image(self, image: CameraImage) -> None:
        if not self._images:
            return
        if self._queued_bytes + image.image.nbytes > IMAGE_BYTES:
            self.images_left_out += 1
            return
        self._put(lambda: self._write_image(image), image.image.nbytes)

    def on_status(self, status: LiveStatus) -> None:
        pass

    def close(self) -> None:
        """Write what is queued, and the end of the file."""
        self._closing.set()
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self._stop(f"the disk takes longer than {_CLOSE_S:g} s to write; the end is missing")

    def status(self) -> RecordingStatus:
        """How it goes."""
        going = self._thread.is_alive() and not self._problem
        return RecordingStatus(
            path=str(self.path),
            megabytes=1e-6 * self._bytes,
            seconds=(time.monotonic() if going else self._ended_s) - self._begun_s,
            problem=self._problem,
        )

    # The run's threads

    def _put(self, write: Callable[[], None], size: int) -> None:
        if self._problem:
            return
        size += _ITEM_BYTES
        with self._lock:
            self._queued_bytes += size
            self._queue.append((write, size))
        if self._queued_bytes > QUEUE_BYTES:
            self._stop("the disk is too slow: events were queued up faster than it writes")

    # The recorder's thread

    def _run(self) -> None:
        flushed_s = synced_s = looked_s = time.monotonic()
        try:
            while not self._problem:
                closing = self._wait()
                self._write_some()
                now_s = time.monotonic()
                if now_s - flushed_s >= FLUSH_S:
                    flushed_s = now_s
                    self._writer.flush()
                    self._bytes = self._file.tell()
                if now_s - synced_s >= SYNC_S:
                    synced_s = now_s
                    os.fsync(self._file.fileno())
                if now_s - looked_s >= LOOK_S:
                    looked_s = now_s
                    self._look()
                if closing and not self._queue:
                    break
            self._writer.finish(self._problem)
            self._bytes = self._file.tell()
        except OSError as error:
            self._stop(error.strerror or str(error))
        except Exception as error:  # a recording's trouble is its own
            self._stop(f"internal error: {type(error).__name__}: {error}")
        finally:
            self._ended_s = time.monotonic()
            self._queue.clear()
            with suppress(OSError):
                self._file.close()

    def _wait(self) -> bool:
        """Until shortly after an instant, when the solver has time; whether to close."""
        if not self._closing.is_set() and self._solved.wait(_POLL_S):
            self._solved.clear()
            self._closing.wait(_PACKETS_FIRST_S)
        return self._closing.is_set()

    def _write_some(self) -> None:
        for _ in range(min(len(self._queue), _BATCH)):
            write, size = self._queue.popleft()
            write()
            with self._lock:
                self._queued_bytes -= size

    def _write_image(self, image: CameraImage) -> None:
        import cv2

        done, jpeg = cv2.imencode(".jpg", image.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if done:
            self._writer.image(image.camera, image.timestamp_ns, jpeg.tobytes(), image.timestamp_ns)

    def _look(self) -> None:
        """Whether the file is still there, and for how long the disk will do."""
        try:
            there = _identity(os.stat(self.path)) == self._identity
        except OSError:
            there = False
        if not there:
            self._stop("the file was moved or deleted")
            return
        free = shutil.disk_usage(self.path.parent).free
        rate = self._bytes / (time.monotonic() - self._begun_s)
        minutes = free / max(rate, 1.0) / 60
        if minutes < WARN_MINUTES and not self._warned:
            self._warned = True
            self._report(
                f"recording {self.path.name}: the disk has {free / 1e6:.0f} MB left, "
                f"{minutes:.1f} minutes at the rate so far"
            )

    def _stop(self, problem: str) -> None:
        if not self._problem:
            self._problem = problem
            self._report(
                f"recording {self.path.name} has ended: {problem}; what was written until then is "
                "kept"
            )


class RecordSwitch:
    """One recording after the other, each in a file of its own."""

    def __init__(self, run: LiveRun, next_path: Callable[[], Path], *, images: bool) -> None:
        self._run = run
        self._next_path = next_path
        self._images = images
        self._recorder: Recorder | None = None
        self._lock = threading.Lock()

    def begin(self, path: Path | None = None) -> Path:
        """Record from now on; raises `InputError` where the file cannot be begun.

        A recording that is begun before the run replays to the same bits.
        """
        with self._lock:
            self._end()
            self._recorder = self._to(path) if path else self._to_next()
            self._run.add_listener(self._recorder)
            return self._recorder.path

    def _to(self, path: Path) -> Recorder:
        return Recorder(
            path,
            self._run.setup,
            self._run.clock,
            from_start=not self._run.begun,
            images=self._images,
            report=self._run.incidents.add,
        )

    def _to_next(self) -> Recorder:
        """By the usual name, with a number where another run has taken it."""
        usual = self._next_path()
        path, number = usual, 1
        while True:
            try:
                return self._to(path)
            except _NameTaken:
                number += 1
                path = usual.with_stem(f"{usual.stem}-{number}")

    def turn(self, on: bool) -> None:
        """As a button does: begin another recording, or end the one that goes on."""
        if on:
            self.begin()
        else:
            with self._lock:
                self._end()

    def _end(self) -> None:
        if self._recorder is not None:
            recorder, self._recorder = self._recorder, None
            self._run.remove_listener(recorder)


class _NameTaken(InputError):
    """There is such a file already."""


def _new_file(path: Path) -> BinaryIO:
    if path.parent.exists() and not path.parent.is_dir():
        raise InputError(f"cannot write {path}: {path.parent} is not a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(path.parent).free
        if free < MIN_FREE_BYTES:
            raise InputError(
                f"cannot record to {path}: the disk has {free / 1e6:.0f} MB left, expected "
                f"{MIN_FREE_BYTES / 1e6:.0f} or more; make room or choose another folder"
            )
        return path.open("xb")
    except FileExistsError:
        raise _NameTaken(f"{path} exists; choose another name for the recording") from None
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from None


def _identity(found: os.stat_result) -> tuple[int, int]:
    return found.st_dev, found.st_ino
