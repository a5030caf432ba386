"""Starts and ends recordings of a run, one at a time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from fusecap.live.recorder import Recorder
from fusecap.live.run import LiveRun


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
            self._recorder = Recorder(
                path or self._next_path(),
                self._run.setup,
                self._run.clock,
                from_start=not self._run.begun,
                images=self._images,
                report=self._run.incidents.add,
            )
            self._run.add_listener(self._recorder)
            return self._recorder.path

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
