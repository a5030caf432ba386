"""Who takes part in a run (recorder, streams, viewer) and how each of them fares."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from fusecap.engine.engine import LiveStep
from fusecap.live.status import LiveStatus, RecordingStatus
from fusecap.streams.output import StreamStatus
from fusecap.types import CameraImage, Event


@runtime_checkable
class Listener(Protocol):
    """Takes part in a run: recorder, streams, viewer.

    Every call must return at once. One that raises is left out from then on. `on_event` and
    `on_step` come from the solver's thread, `on_image` from the detector's, the others from that of
    the run.
    """

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """What the engine has just taken, in this order, and when it arrived."""
        ...

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """An instant has been solved."""
        ...

    def on_image(self, image: CameraImage) -> None:
        """Goes to the detector now."""
        ...

    def on_status(self, status: LiveStatus) -> None:
        """Once a second."""
        ...

    def close(self) -> None:
        """The run is over, or the listener is no longer wanted; may wait for a moment."""
        ...


@runtime_checkable
class Sending(Protocol):
    """A listener that sends poses on."""

    def stream_statuses(self) -> Sequence[StreamStatus]:
        """How each of its streams goes."""
        ...

    @property
    def poses(self) -> float:
        """Instants sent so far."""
        ...


@runtime_checkable
class RecordingListener(Protocol):
    """A listener that writes a file."""

    def status(self) -> RecordingStatus:
        """How it goes."""
        ...


class Listeners:
    """Those of a run; one that raises is left out, and never ends the run."""

    def __init__(self, listeners: Sequence[Listener], report: Callable[[str], None]) -> None:
        """`report` hears of failures."""
        self.recorded: list[RecordingStatus] = []
        """How recordings went that have ended."""
        self._listeners = tuple(listeners)
        self._broken: list[Listener] = []
        self._report = report
        self._changing = threading.Lock()

    def add(self, listener: Listener) -> None:
        """Takes part from the next event on."""
        with self._changing:
            self._listeners = (*self._listeners, listener)

    def remove(self, listener: Listener) -> None:
        """Takes no more part, and is closed."""
        self._leave_out(listener)
        self._close(listener)

    def tell(self, method: str, *args: object) -> None:
        """Call everyone's `method`."""
        for listener in self._listeners:
            try:
                getattr(listener, method)(*args)
            except Exception as error:  # a broken listener must not end the run
                self._report(
                    f"{type(listener).__name__} failed and is left out: "
                    f"{type(error).__name__}: {error}"
                )
                self._leave_out(listener)
                self._broken.append(listener)

    def close_broken(self) -> None:
        """Close those that have raised since the last call."""
        while self._broken:
            self._close(self._broken.pop())

    def close(self) -> None:
        """The run is over."""
        for listener in self._listeners:
            self._close(listener)

    @property
    def poses(self) -> float:
        """Instants sent so far, the mean of those who send."""
        sent = [sender.poses for sender in self._senders]
        return sum(sent) / len(sent) if sent else 0.0

    def stream_statuses(self) -> tuple[StreamStatus, ...]:
        """How each stream goes."""
        return tuple(one for sender in self._senders for one in sender.stream_statuses())

    def recording_status(self) -> RecordingStatus | None:
        """Of the recording that was begun last and goes on."""
        going = [status for one in self._listeners if (status := _recording(one))]
        return going[-1] if going else None

    @property
    def _senders(self) -> list[Sending]:
        return [one for one in self._listeners if isinstance(one, Sending)]

    def _leave_out(self, listener: Listener) -> None:
        with self._changing:
            self._listeners = tuple(one for one in self._listeners if one is not listener)

    def _close(self, listener: Listener) -> None:
        try:
            listener.close()
        except Exception as error:  # the others are still to be closed
            self._report(
                f"{type(listener).__name__} did not close: {type(error).__name__}: {error}"
            )
        if (status := _recording(listener)) is not None:
            self.recorded.append(status)


def _recording(listener: Listener) -> RecordingStatus | None:
    status = listener.status() if isinstance(listener, RecordingListener) else None
    return status if isinstance(status, RecordingStatus) else None
