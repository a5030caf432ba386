"""Where a recording's poses and keypoints are, so that those of one instant can be read alone.

One pass over the file, in which no message is read but bodies; 40 bytes are kept of a pose.
"""

from __future__ import annotations

from array import array
from contextlib import suppress
from functools import lru_cache

from fusecap.body.shape import BodyShape
from fusecap.progress import Progress
from fusecap.recording.layout import BODY, EVENTS, KEYPOINTS, POSE, RecordedBody
from fusecap.recording.reader import Entry, EventNumbers, Item, Recording

_RECORDS_KEPT = 8
"""Unpacked; a run closes one twice a second."""


class Places:
    """Messages of one topic, in their order."""

    def __init__(self, schema: str) -> None:
        self.schema = schema
        self.times_ns = array("q")
        """Of the samples, on the session's clock."""
        self.numbers = array("q")
        self._records, self._starts, self._lengths = array("q"), array("q"), array("q")

    def add(self, entry: Entry, time_ns: int) -> None:
        """The next one."""
        self.times_ns.append(time_ns)
        self.numbers.append(entry.sequence)
        self._records.append(entry.record_at)
        self._starts.append(entry.start)
        self._lengths.append(len(entry.content))

    def at(self, row: int) -> tuple[int, int, int]:
        """Of which record, from where in it, how many bytes."""
        return self._records[row], self._starts[row], self._lengths[row]


class RecordingIndex:
    """Of a recording, whose `loss` it completes; raises `InputError`."""

    def __init__(
        self, recording: Recording, *, keypoints_hz: float = 0.0, progress: Progress | None = None
    ) -> None:
        """Keypoints of each camera up to so often."""
        self.poses: dict[str, Places] = {}
        """By name, in the order of their first appearance."""
        self.keypoints: dict[str, Places] = {}
        """By topic."""
        self.bodies: dict[str, BodyShape] = {}
        """The last of each person."""
        self._recording = recording
        self._unpacked = lru_cache(_RECORDS_KEPT)(recording.unpacked)
        numbers = EventNumbers()
        for entry in recording.entries(progress, numbers):
            time_ns = entry.publish_ns - recording.unix_minus_session_ns
            if entry.schema in EVENTS:
                with suppress(ValueError):
                    numbers.take(entry.sequence)
            if entry.schema == POSE:
                name = entry.topic.removeprefix("/pose/")
                self.poses.setdefault(name, Places(POSE)).add(entry, time_ns)
            elif entry.schema == BODY:
                body = recording.read(entry)
                if isinstance(body, RecordedBody):
                    self.bodies[body.name] = body.shape
            elif entry.schema == KEYPOINTS and keypoints_hz:
                places = self.keypoints.setdefault(entry.topic, Places(KEYPOINTS))
                if not places.times_ns or time_ns - places.times_ns[-1] >= 1e9 / keypoints_hz:
                    places.add(entry, time_ns)
        recording.loss.missing_events = numbers.missing

    def read(self, places: Places, row: int) -> Item | None:
        """A message; None for one that is malformed, or no longer there."""
        record_at, start, length = places.at(row)
        data = self._unpacked(record_at)
        return self._recording.read(
            Entry(
                schema=places.schema,
                topic="",
                sequence=places.numbers[row],
                log_ns=0,
                publish_ns=0,
                record_at=record_at,
                start=start,
                content=data[start : start + length],
            )
        )
