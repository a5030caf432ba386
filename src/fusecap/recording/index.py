"""Where a recording's poses and samples are, so that those of one instant can be read alone.

A finished recording tells it of poses and keypoints at its end; of another one, and where all
events are wanted, all is unpacked once. 12 bytes are kept of a message.
"""

from __future__ import annotations

import struct
from array import array
from bisect import bisect_right
from collections.abc import Collection, Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Int
from mcap.opcode import Opcode

from fusecap.body.shape import BodyShape
from fusecap.progress import Progress
from fusecap.recording.layout import BODY, EVENTS, KEYPOINTS, POSE, RecordedBody
from fusecap.recording.reader import (
    MAX_BYTES,
    Entry,
    EventNumbers,
    Item,
    Loss,
    Messages,
    Recording,
)
from fusecap.recording.told import INDEXED, Topic, told_by

_RECORDS_KEPT = 8
"""Unpacked; a run closes one twice a second."""
_MESSAGE = struct.Struct("<BQHIQQ")
"""Opcode, length, channel, sequence, log time, publish time; the content follows."""
_BEFORE_CONTENT = _MESSAGE.size - 9
"""Of what the length counts."""


class Places:
    """Messages of one topic, in their order."""

    def __init__(self, schema: str) -> None:
        self.schema = schema
        self.times_ns = array("q")
        """Of the samples, on the session's clock."""
        self.broken: set[int] = set()
        """Rows that were read and found malformed, or not there."""
        self._starts = array("I")
        self._records, self._first = array("q"), array("q")

    def add(
        self,
        record_at: Int[np.ndarray, " n"],
        start: Int[np.ndarray, " n"],
        times_ns: Int[np.ndarray, " n"],
    ) -> None:
        """The next ones: of which record in the file, from where in it, when."""
        new = np.flatnonzero(np.diff(record_at, prepend=self._records[-1:] or [-1]))
        self._records.frombytes(record_at[new].tobytes())
        self._first.frombytes((new + len(self.times_ns)).tobytes())
        inside = (start >= 0) & (start < MAX_BYTES)
        self._starts.frombytes(np.where(inside, start, MAX_BYTES).astype(np.uint32).tobytes())
        self.times_ns.frombytes(times_ns.tobytes())

    def at(self, row: int) -> tuple[int, int]:
        """Of which record, from where in it."""
        return self._records[bisect_right(self._first, row) - 1], self._starts[row]


class RecordingIndex:
    """Of a recording, whose `loss` it completes; raises `InputError`.

    Damage to a recording that tells its own index shows when the messages there are read.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        keypoints_hz: float = 0.0,
        events: bool = False,
        progress: Progress | None = None,
    ) -> None:
        """Keypoints of each camera up to so often, or all `events`."""
        self.poses: dict[str, Places] = {}
        """By name, in the order of their first appearance."""
        self.keypoints: dict[str, Places] = {}
        """By topic."""
        self.events: dict[str, Places] = {}
        """By topic: samples, ticks and commands."""
        self.bodies: dict[str, BodyShape] = {}
        """The last of each person."""
        self._recording = recording
        self._keypoints_hz, self._all_events = keypoints_hz, events
        wanted = INDEXED if not events else (POSE, BODY, *EVENTS)
        self._unpacked = lru_cache(_RECORDS_KEPT)(recording.unpacked)
        bodies: dict[str, Places] = {}
        told = None if events else told_by(recording.path)
        self.read_whole = told is None
        """Else what is damaged within the file is not known yet."""
        if told is None:
            numbers = EventNumbers()
            for some in recording.messages(progress, numbers):
                for topic in _topics(some, numbers, wanted):
                    self._add(topic, bodies)
            recording.loss.missing_events = numbers.missing
        else:
            recording.loss = Loss(finished=True, note=told.note)
            for topic in told.topics:
                self._add(topic, bodies)
        for places in bodies.values():
            for row in reversed(range(len(places.times_ns))):
                body = self.read(places, row)
                if isinstance(body, RecordedBody):
                    self.bodies[body.name] = body.shape
                    break

    def _add(self, topic: Topic, bodies: dict[str, Places]) -> None:
        ahead_ns = self._recording.unix_minus_session_ns
        latest_ns = np.iinfo(np.int64).max + min(ahead_ns, 0)
        possible = (topic.publish_ns >= 0) & (topic.publish_ns <= latest_ns)
        rows = np.flatnonzero(possible)
        self._recording.loss.malformed += len(possible) - len(rows)
        if not len(rows):
            return
        times_ns = topic.publish_ns[rows] - ahead_ns
        if topic.schema == POSE:
            places = self.poses.setdefault(topic.name.removeprefix("/pose/"), Places(POSE))
        elif topic.schema == BODY:
            places = bodies.setdefault(topic.name, Places(BODY))
        elif self._all_events:
            places = self.events.setdefault(topic.name, Places(topic.schema))
        elif self._keypoints_hz:
            places = self.keypoints.setdefault(topic.name, Places(KEYPOINTS))
            kept = _apart(times_ns, 1e9 / self._keypoints_hz, places.times_ns[-1:])
            rows, times_ns = rows[kept], times_ns[kept]
        else:
            return
        places.add(topic.record_at[rows], topic.start[rows], times_ns)

    def read(self, places: Places, row: int) -> Item | None:
        """A message; None for one that is malformed, or is not there as the index says.

        `loss` counts such a one the first time.
        """
        if row in places.broken:
            return None
        record_at, start = places.at(row)
        data = self._unpacked(record_at)
        try:
            opcode, length, _, sequence, _, publish_ns = _MESSAGE.unpack_from(data, start)
        except struct.error:
            opcode = length = sequence = publish_ns = 0
        publish_ns -= self._recording.unix_minus_session_ns
        item = None
        if opcode == Opcode.MESSAGE and publish_ns == places.times_ns[row]:
            first = start + _MESSAGE.size
            item = self._recording.read(
                Entry(
                    schema=places.schema,
                    topic="",
                    sequence=sequence,
                    log_ns=0,
                    publish_ns=publish_ns,
                    record_at=record_at,
                    start=first,
                    content=data[first : first + length - _BEFORE_CONTENT],
                )
            )
        else:
            self._recording.loss.malformed += 1
        if item is None:
            places.broken.add(row)
        return item


def _topics(some: Messages, numbers: EventNumbers, schemas: Collection[str]) -> list[Topic]:
    """Those of these schemas, in the order of their first message; `numbers` takes events'."""
    channels, first, which = np.unique(some.channel, return_index=True, return_inverse=True)
    names = [some.names.get(channel, ("", "")) for channel in channels.tolist()]
    is_event = np.array([schema in EVENTS for schema, _ in names], dtype=bool)
    numbers.take_all(some.sequence[is_event[which]])
    topics: dict[tuple[str, str], list[int]] = {}
    for index in np.argsort(first).tolist():
        if names[index][0] in schemas:
            topics.setdefault(names[index], []).append(index)
    found = []
    for (schema, name), indices in topics.items():
        rows = np.flatnonzero(np.isin(which, indices))
        found.append(
            Topic(
                schema=schema,
                name=name,
                record_at=np.full(len(rows), some.record_at, np.int64),
                start=some.start[rows] - _MESSAGE.size,
                publish_ns=some.publish_ns[rows],
            )
        )
    return found


def _apart(times_ns: Int[np.ndarray, " n"], period_ns: float, last: Sequence[int]) -> list[int]:
    """Rows, each a period after the one before and the first after the `last` there was."""
    kept, before_ns = [], last[0] if last else None
    for row, time_ns in enumerate(times_ns.tolist()):
        if before_ns is None or time_ns - before_ns >= period_ns:
            kept.append(row)
            before_ns = time_ns
    return kept
