"""Whether what a run takes in contradicts itself: once, when it has come for a while."""

from __future__ import annotations

import threading
from collections.abc import Callable

from fusecap.checks import check_samples
from fusecap.engine.engine import LiveStep
from fusecap.live.status import LiveStatus
from fusecap.setup import SessionSetup
from fusecap.types import CameraImage, CameraSample, Event, ImuSample

CHECKED_S = 10.0
"""So much of the run is looked at, from its first sample on."""
_JOIN_S = 2.0


class InputCheck:
    """A listener that reports what the checks of recorded sessions find in the samples.

    They take a second or two of Python, so on a thread of their own.
    """

    def __init__(
        self, setup: SessionSetup, report: Callable[[str], None], span_s: float = CHECKED_S
    ) -> None:
        self._setup = setup
        self._report = report
        self._span_ns = round(1e9 * span_s)
        self._samples: list[CameraSample | ImuSample] = []
        self._first_ns: int | None = None
        self._thread: threading.Thread | None = None

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """Keep a sample, until they last for long enough."""
        if self._thread is not None or not isinstance(event, CameraSample | ImuSample):
            return
        self._samples.append(event)
        if self._first_ns is None:
            self._first_ns = arrival_ns
        elif arrival_ns - self._first_ns >= self._span_ns:
            self._thread = threading.Thread(target=self._check, name="input check", daemon=True)
            self._thread.start()

    def _check(self) -> None:
        for finding in check_samples(self._setup, self._samples).sorted():
            if finding.severity != "info":
                self._report(str(finding))
        self._samples.clear()

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """Nothing to do."""

    def on_image(self, image: CameraImage) -> None:
        """Nothing to do."""

    def on_status(self, status: LiveStatus) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Wait for a moment where the check is not done."""
        if self._thread is not None:
            self._thread.join(_JOIN_S)
