"""Where a recording's poses and keypoints are, so that those of one instant can be read alone.

One pass over the file, in which no message is read but bodies; 40 bytes are kept of a pose.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Int

from fusecap.body.shape import BodyShape
from fusecap.progress import Progress
from fusecap.recording.layout import BODY, EVENTS, KEYPOINTS, POSE, RecordedBody
from fusecap.recording.reader import Entry, EventNumbers, Item, Messages, Recording

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

    def add(
        self, some: Messages, rows: Int[np.ndarray, " n"], times_ns: Int[np.ndarray, " n"]
    ) -> None:
        """The next ones, at these times."""
        lengths = some.end[rows] - some.start[rows]
        self.times_ns.frombytes(times_ns.tobytes())
        self.numbers.frombytes(some.sequence[rows].tobytes())
        self._records.frombytes(np.full(len(rows), some.record_at).tobytes())
        self._starts.frombytes(some.start[rows].tobytes())
        self._lengths.frombytes(lengths.tobytes())

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
        for some in recording.messages(progress, numbers):
            self._add(some, numbers, keypoints_hz)
        recording.loss.missing_events = numbers.missing

    def _add(self, some: Messages, numbers: EventNumbers, keypoints_hz: float) -> None:
        channels, first, which = np.unique(some.channel, return_index=True, return_inverse=True)
        names = [some.names.get(channel, ("", "")) for channel in channels.tolist()]
        is_event = np.array([schema in EVENTS for schema, _ in names], dtype=bool)
        numbers.take_all(some.sequence[is_event[which]])
        topics: dict[tuple[str, str], list[int]] = {}
        for index in np.argsort(first).tolist():
            topics.setdefault(names[index], []).append(index)
        ahead_ns = self._recording.unix_minus_session_ns
        latest_ns = np.iinfo(np.int64).max + min(ahead_ns, 0)
        possible = (some.publish_ns >= 0) & (some.publish_ns <= latest_ns)
        for (schema, topic), indices in topics.items():
            if schema not in (POSE, BODY, KEYPOINTS):
                continue
            ours = np.isin(which, indices)
            rows = np.flatnonzero(ours & possible)
            self._recording.loss.malformed += int(ours.sum()) - len(rows)
            if not len(rows):
                continue
            times_ns = some.publish_ns[rows] - ahead_ns
            if schema == POSE:
                name = topic.removeprefix("/pose/")
                self.poses.setdefault(name, Places(POSE)).add(some, rows, times_ns)
            elif schema == BODY:
                for body in map(self._recording.read, map(some.entry, rows.tolist())):
                    if isinstance(body, RecordedBody):
                        self.bodies[body.name] = body.shape
            elif keypoints_hz:
                places = self.keypoints.setdefault(topic, Places(KEYPOINTS))
                kept = _apart(times_ns, 1e9 / keypoints_hz, places.times_ns[-1:])
                places.add(some, rows[kept], times_ns[kept])

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


def _apart(times_ns: Int[np.ndarray, " n"], period_ns: float, last: Sequence[int]) -> list[int]:
    """Rows, each a period after the one before and the first after the `last` there was."""
    kept, before_ns = [], last[0] if last else None
    for row, time_ns in enumerate(times_ns.tolist()):
        if before_ns is None or time_ns - before_ns >= period_ns:
            kept.append(row)
            before_ns = time_ns
    return kept
