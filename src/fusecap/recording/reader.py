"""Reads the MCAP log of a live run, also one that was cut off or damaged.

Reading goes from record to record and stops at the first that the file does not hold whole; a
chunk that fails its checksum is left out. Events carry their number among all events, so whatever
is missing is known. Nothing in a file is executed, and no length in it is believed beyond the size
of the file, or 256 MiB for what a chunk unpacks to; all chunks together may unpack to a hundred
times the file.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from jaxtyping import Float, Int
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema

from fusecap.errors import InputError, MotionError
from fusecap.inputs import RECORDING, open_input
from fusecap.kernels.records import COLUMNS, find_records
from fusecap.progress import Progress
from fusecap.recording.layout import DECODERS, END, FORMAT, HEADER, Known, RecordedBody
from fusecap.types import Event

MAX_BYTES = 256 << 20
"""Of one record, and of what a chunk unpacks to."""
MAX_RATIO = 100
"""Of what all chunks unpack to, `MAX_BYTES` aside, to the file; a run's is about 3."""
MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
_BETWEEN = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)
_TOLD = (*_BETWEEN, Opcode.MESSAGE, Opcode.CHUNK)
_NAME = 1000
"""Of a schema or a channel: so much is kept."""
_MESSAGE = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time; the content follows."""
BROKEN = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    OverflowError,
    RecursionError,
    struct.error,
    McapError,
)
"""What parsing bytes that are not what they should be may raise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A message that has not been read yet."""

    schema: str
    topic: str
    sequence: int
    log_ns: int
    publish_ns: int
    record_at: int
    """In the file: of the chunk that holds it, or of the message itself."""
    start: int
    """Of its content, in what the record unpacks to."""
    content: memoryview


@dataclass(frozen=True, slots=True, kw_only=True)
class Messages:
    """Some that follow each other, unread."""

    names: Mapping[int, tuple[str, str]]
    """Schema and topic by channel; a channel without them means nothing."""
    record_at: int
    data: memoryview
    """What the record unpacks to."""
    channel: Int[np.ndarray, " n"]
    sequence: Int[np.ndarray, " n"]
    log_ns: Int[np.ndarray, " n"]
    publish_ns: Int[np.ndarray, " n"]
    start: Int[np.ndarray, " n"]
    """Of the content, in `data`."""
    end: Int[np.ndarray, " n"]

    def entry(self, row: int) -> Entry:
        """One of them."""
        schema, topic = self.names.get(int(self.channel[row]), ("", ""))
        start = int(self.start[row])
        return Entry(
            schema=schema,
            topic=topic,
            sequence=int(self.sequence[row]),
            log_ns=int(self.log_ns[row]),
            publish_ns=int(self.publish_ns[row]),
            record_at=self.record_at,
            start=start,
            content=self.data[start : int(self.end[row])],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedEvent:
    """One event and when it was taken."""

    event: Event
    number: int
    """Among all events of the run's recording, from 1."""
    arrival_ns: int
    """On the session's clock."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedPose:
    """One person's pose as it was sent."""

    name: str
    number: int
    """Of the tick it belongs to, among all events."""
    timestamp_ns: int
    theta: Float[np.ndarray, " p"]
    bone_sigma_deg: Float[np.ndarray, " b"]
    position_sigma_m: Float[np.ndarray, " b"]
    diverged: bool
    measured: bool


Item = RecordedEvent | RecordedPose | RecordedBody


@dataclass(kw_only=True)
class Loss:
    """What a file no longer holds; complete once all items have been read."""

    finished: bool = False
    """Has its footer: it was closed, not cut off."""
    note: str = ""
    """Why the recording ended before it was asked to."""
    unread_bytes: int = 0
    """At the end, after the last whole record."""
    broken_chunks: int = 0
    malformed: int = 0
    """Messages, or what tells of them, that do not follow the format."""
    missing_events: int = 0
    """By their numbers; those after the end cannot be known."""

    @property
    def whole(self) -> bool:
        """No event is missing among those that were read."""
        return self.missing_events == 0

    @property
    def damaged(self) -> bool:
        """Something within the file is missing or broken."""
        return bool(self.missing_events or self.malformed or self.broken_chunks)


class Recording:
    """A log whose header has been read; raises `InputError` for anything else."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.loss = Loss()
        """Of the latest reading."""
        header = self._header()
        found = header.get("format", "")
        if found != FORMAT:
            raise InputError(
                f"{self.path} is a '{found}', this version reads '{FORMAT}'; update fusecap"
            )
        try:
            self.made_by = header["made_by"]
            self.from_start = header["from_start"] == "true"
            """Whether it holds the run from its first event."""
            self.unix_minus_session_ns = int(np.int64(int(header["unix_minus_session_ns"])))
            if zlib.crc32(header["setup"].encode()) != int(header["setup_crc32"]):
                raise ValueError("what the run knew fails its checksum")
            self.setup: Mapping[str, Any] = json.loads(header["setup"])
            """Plain values: what the run knew before the first event."""
            self._known = Known.of(self.setup)
        except BROKEN as error:
            raise InputError(f"{self.path}: its header is damaged ({error!r})") from None

    def items(self, progress: Progress | None = None) -> Iterator[Item]:
        """Everything in the order in which it was recorded; `loss` counts what is not there."""
        numbers = EventNumbers()
        for entry in self.entries(progress, numbers):
            item = self.read(entry, numbers)
            if item is not None:
                yield item
        self.loss.missing_events = numbers.missing

    def entries(
        self, progress: Progress | None = None, numbers: EventNumbers | None = None
    ) -> Iterator[Entry]:
        """Every message, unread; `loss` counts what is not there. Fails as `messages`."""
        for some in self.messages(progress, numbers):
            for row in range(len(some.start)):
                yield some.entry(row)

    def messages(
        self, progress: Progress | None = None, numbers: EventNumbers | None = None
    ) -> Iterator[Messages]:
        """All of them, some at a time; `loss` counts what is not there.

        Raises `InputError` for a file that unpacks to `MAX_RATIO` times its size.
        """
        self.loss = loss = Loss()
        said = Said()
        most = MAX_BYTES + MAX_RATIO * self.path.stat().st_size
        unpacked = 0
        with self._opened() as file:
            for record_at, opcode, payload in self._records(file, loss, progress):
                if opcode not in _TOLD:
                    continue
                try:
                    data = unpacked_record(opcode, payload)
                    unpacked += len(data)
                    if unpacked > most:
                        raise InputError(
                            f"{self.path}: unpacks to more than {most} bytes, {MAX_RATIO} times "
                            "its size; no run leaves such a recording"
                        )
                    yield from _messages_in(record_at, data, said, loss)
                except (*BROKEN, zstandard.ZstdError, MemoryError):
                    loss.broken_chunks += 1
        loss.note = said.note
        if numbers is not None:
            numbers.state(said.events)

    def read(self, entry: Entry, numbers: EventNumbers | None = None) -> Item | None:
        """What a message says, None for one of another kind; what is malformed is counted."""
        decode = DECODERS.get(entry.schema)
        if decode is None:
            self.loss.malformed += not entry.schema
            return None
        try:
            decoded = decode(json.loads(bytes(entry.content)), self._known)
            if isinstance(decoded, Event):
                if numbers is not None:
                    numbers.take(entry.sequence)
                return RecordedEvent(
                    event=decoded,
                    number=entry.sequence,
                    arrival_ns=entry.log_ns - self.unix_minus_session_ns,
                )
            if isinstance(decoded, RecordedBody):
                return decoded
            return RecordedPose(number=entry.sequence, **decoded)
        except (*BROKEN, MotionError, InputError):
            self.loss.malformed += 1
            return None

    def unpacked(self, record_at: int) -> memoryview:
        """The record that an entry names; empty where it is no longer there."""
        with self._opened() as file:
            file.seek(record_at)
            head = file.read(RECORD.size)
            try:
                opcode, length = RECORD.unpack(head)
                if length > MAX_BYTES:
                    raise ValueError("a record that is too long")
                return unpacked_record(opcode, file.read(length))
            except (*BROKEN, zstandard.ZstdError, MemoryError):
                return memoryview(b"")

    def sha256(self) -> str:
        """Of the file."""
        with self._opened() as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _header(self) -> dict[str, str]:
        with self._opened() as file:
            try:
                for _, opcode, payload in self._records(file, Loss(), None):
                    if opcode == Opcode.METADATA:
                        record = Metadata.read(ReadDataStream(BytesIO(payload)))
                        if record.name == HEADER:
                            return record.metadata
                    if opcode == Opcode.CHUNK:
                        break
            except BROKEN:
                pass
        raise InputError(
            f"{self.path} holds no recording of fusecap: an MCAP log without its header, or cut "
            "off before it"
        )

    def _opened(self) -> BufferedReader:
        return open_input(self.path, RECORDING)

    def _records(
        self, file: BinaryIO, loss: Loss, progress: Progress | None
    ) -> Iterator[tuple[int, int, bytes]]:
        """Place, opcode and content of every record that is there whole, up to the data's end."""
        size = self.path.stat().st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{self.path} is not an MCAP log: its first bytes are others")
        at = len(MAGIC)
        while len(head := file.read(RECORD.size)) == RECORD.size:
            opcode, length = RECORD.unpack(head)
            if opcode == Opcode.DATA_END and length == 4:
                loss.finished = True
                return
            if length > min(MAX_BYTES, size - at - RECORD.size):
                break
            yield at, opcode, file.read(length)
            at += RECORD.size + length
            if progress is not None:
                progress(f"reading {self.path.name}", at, size)
        loss.unread_bytes = size - at


class Said:
    """What the records between the messages say."""

    def __init__(self) -> None:
        self.note = ""
        self.events = 0
        self._schemas: dict[int, str] = {}
        self.channels: dict[int, tuple[str, str]] = {}
        """Schema and topic of each, so far."""

    def hear(self, opcode: int, content: memoryview) -> None:
        stream = ReadDataStream(BytesIO(content))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self._schemas[schema.id] = schema.name[:_NAME]
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            found = self._schemas.get(channel.schema_id, ""), channel.topic[:_NAME]
            self.channels[channel.id] = found
        elif opcode == Opcode.METADATA:
            end = Metadata.read(stream)
            if end.name == END:
                self.note = end.metadata.get("note", "")
                events = end.metadata.get("events", "")
                if events.isdecimal() and len(events) < 19:
                    self.events = int(events)


class EventNumbers:
    """Which event numbers have come; in the file they start again after 2**32."""

    def __init__(self) -> None:
        self._count = 0
        self._last = 0
        self._stated = 0

    def take(self, number: int) -> None:
        """One has come; raises `ValueError` for one that is not after the last."""
        ahead = (number - self._last) & 0xFFFFFFFF
        if not 0 < ahead < 0x80000000:
            raise ValueError("an event twice")
        self._last += ahead
        self._count += 1

    def take_all(self, numbers: Int[np.ndarray, " n"]) -> None:
        """Those that have come, in their order; one that is not after the last is left out."""
        ahead = np.diff(numbers, prepend=self._last) & 0xFFFFFFFF
        if ((ahead > 0) & (ahead < 0x80000000)).all():
            self._last += int(ahead.sum())
            self._count += len(ahead)
            return
        for number in numbers.tolist():
            with suppress(ValueError):
                self.take(number)

    def state(self, count: int) -> None:
        """So many events were recorded in all."""
        self._stated = count

    @property
    def missing(self) -> int:
        """Events that did not come."""
        return max(self._last, self._stated) - self._count


def _messages_in(record_at: int, data: memoryview, said: Said, loss: Loss) -> Iterator[Messages]:
    """Those of one record, after `said` has heard it; raises `ValueError` after what is whole."""
    content = np.frombuffer(data, np.uint8)
    none = np.empty((0, COLUMNS), np.int64)
    rows = np.zeros((find_records(content, Opcode.MESSAGE, _MESSAGE.size, none), COLUMNS), np.int64)
    find_records(content, Opcode.MESSAGE, _MESSAGE.size, rows)
    for opcode, start, end in rows[np.isin(rows[:, 0], _BETWEEN), :3].tolist():
        try:
            said.hear(opcode, data[start:end])
        except BROKEN:
            loss.malformed += 1
    _, start, end, channel, sequence, log_ns, publish_ns = rows[rows[:, 0] == Opcode.MESSAGE].T
    yield Messages(
        names=said.channels,
        record_at=record_at,
        data=data,
        channel=channel,
        sequence=sequence,
        log_ns=log_ns,
        publish_ns=publish_ns,
        start=start + _MESSAGE.size,
        end=end,
    )
    if len(data) != (rows[-1, 2] if len(rows) else 0):
        raise ValueError("a record longer than its chunk")


def unpacked_record(opcode: int, content: bytes) -> memoryview:
    """Records one after the other: those that a chunk holds, or the record itself."""
    if opcode != Opcode.CHUNK:
        return memoryview(RECORD.pack(opcode, len(content)) + content)
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    size = chunk.uncompressed_size
    data = chunk.data
    if chunk.compression == "zstd":
        stated = zstandard.get_frame_parameters(data).content_size
        if max(size, stated) > MAX_BYTES:
            raise ValueError(f"a chunk of {max(size, stated)} bytes")
        data = zstandard.ZstdDecompressor(max_window_size=MAX_BYTES).decompress(data, size)
    elif chunk.compression:
        raise ValueError(f"compressed with '{chunk.compression}'")
    if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a chunk that fails its checksum")
    return memoryview(data)
