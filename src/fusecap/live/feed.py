"""A source in a thread of its own, opened again for as long as the run goes."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from fusecap.live.devices.source import Delivery, Source, SourceLost
from fusecap.live.health import Incidents

FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class FeedReport:
    """What became of one source."""

    source: str
    received: int
    dropped: int
    malformed: int
    oversize: int
    restarts: int
    """How often it was opened again."""
    note: str


class Feed:
    """Runs one source; a device that is lost is tried again after 0.5 s, 1 s, ... 5 s."""

    def __init__(
        self,
        source: Source,
        deliver: Callable[[Delivery, Feed], None],
        incidents: Incidents,
        *,
        first_pause_s: float = FIRST_PAUSE_S,
    ) -> None:
        self.source = source
        self.restarts = 0
        self.gone = False
        """The device is not there now."""
        self.trouble = ""
        """Why not."""
        self._deliver = deliver
        self._incidents = incidents
        self._first_pause_s = first_pause_s
        self._any = False
        self._stopping = threading.Event()
        self._thread = threading.Thread(
            target=self._run, name=f"fusecap-source {source.name}", daemon=True
        )

    @property
    def name(self) -> str:
        """Of the source."""
        return self.source.name

    def start(self) -> None:
        """Begin to deliver."""
        self._thread.start()

    def stop(self) -> None:
        """Ask the source to end; does not wait."""
        self._stopping.set()

    def join(self, timeout_s: float) -> bool:
        """Whether the thread has ended by then."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    @property
    def finished(self) -> bool:
        """There is no more to come."""
        return not self._thread.is_alive()

    @property
    def note(self) -> str:
        """What a user should know about it now."""
        return self.trouble or self.source.counts.note

    def report(self) -> FeedReport:
        """What became of it so far."""
        counts = self.source.counts
        return FeedReport(
            source=self.source.name,
            received=counts.received,
            dropped=counts.dropped,
            malformed=counts.malformed,
            oversize=counts.oversize,
            restarts=self.restarts,
            note=self.note,
        )

    def _run(self) -> None:
        pause_s = self._first_pause_s
        while not self._stopping.is_set():
            self._any = False
            try:
                self.source.run(self._arrived, self._stopping)
                return
            except SourceLost as error:
                why = str(error)
            except Exception as error:  # whatever a driver raises must not end the run
                why = f"{type(error).__name__}: {error}"
            if self._any:
                pause_s = self._first_pause_s
            if self._any or why != self.trouble:
                self._incidents.add(f"{self.source.name} failed: {why}; trying again")
            self.gone, self.trouble = True, why
            self._stopping.wait(pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            self.restarts += not self._stopping.is_set()

    def _arrived(self, item: Delivery) -> None:
        if not self._any:
            self._any = True
            if self.gone:
                self._incidents.add(f"{self.source.name} is back")
                self.gone, self.trouble = False, ""
        self._deliver(item, self)
