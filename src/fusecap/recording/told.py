"""What a finished recording tells of itself at its end: where messages are, and their times.

MCAP's own index says where in which chunk they are and when they were recorded; the times of what
they are about follow in attachments, one a topic. So poses and keypoints are found without a chunk
being unpacked. None of it is believed beyond that: whoever reads a message compares its time.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from jaxtyping import Int
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, MetadataIndex, Statistics
from mcap.writer import Writer

from fusecap.inputs import RECORDING, open_input
from fusecap.kernels.records import COLUMNS, find_records
from fusecap.recording.layout import BODY, END, EVENTS, KEYPOINTS, POSE
from fusecap.recording.reader import BROKEN, MAGIC, MAX_BYTES, RECORD, Said

INDEXED = (POSE, BODY, KEYPOINTS)
"""Schemas of the messages whose times are told."""
_TIMES = "fusecap times "
"""Before a topic: the name of an attachment."""
_FOOTER = struct.Struct("<BQQQI")
"""Opcode, length; first byte of the summary and of its offsets, its checksum."""
_FOOTER_LENGTH = 20
_CHUNK = struct.Struct("<QQQQI")
"""Its first and last time, its first byte and length; bytes of the next."""
_OF_CHANNEL = np.dtype([("channel", "<u2"), ("at", "<u8")])
_INDEX = struct.Struct("<BQHI")
"""Opcode, length, channel, bytes of the next."""
_OF_MESSAGE = np.dtype([("log_ns", "<u8"), ("start", "<u8")])


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """Its messages in their order."""

    schema: str
    name: str
    record_at: Int[np.ndarray, " n"]
    """In the file: of the chunk."""
    start: Int[np.ndarray, " n"]
    """In what the chunk unpacks to."""
    publish_ns: Int[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Told:
    """All that one recording tells."""

    topics: tuple[Topic, ...]
    note: str
    """Why the run ended before it was asked to."""


def add_times(writer: Writer, times_ns: Mapping[str, array[int]]) -> None:
    """Publish times by topic."""
    packer = zstandard.ZstdCompressor(write_checksum=True)
    for topic, times in times_ns.items():
        steps = np.diff(np.frombuffer(times, np.int64), prepend=0).astype("<i8")
        writer.add_attachment(
            0, 0, f"{_TIMES}{topic}", "application/zstd", packer.compress(steps.tobytes())
        )


def told_by(path: Path) -> Told | None:
    """None where the file does not tell all, or what it tells does not agree."""
    with open_input(path, RECORDING) as file:
        try:
            return _told(file)
        except (*BROKEN, zstandard.ZstdError, MemoryError):
            return None


def _told(file: BinaryIO) -> Told | None:
    said = Said()
    attached: dict[str, AttachmentIndex] = {}
    counts: Mapping[int, int] = {}
    chunks: list[memoryview] = []
    for opcode, content in _summary(file):
        match opcode:
            case Opcode.SCHEMA | Opcode.CHANNEL:
                said.hear(opcode, content)
            case Opcode.STATISTICS:
                counts = Statistics.read(_stream(content)).channel_message_counts
            case Opcode.CHUNK_INDEX:
                chunks.append(content)
            case Opcode.ATTACHMENT_INDEX:
                index = AttachmentIndex.read(_stream(content))
                attached[index.name] = index
            case Opcode.METADATA_INDEX:
                where = MetadataIndex.read(_stream(content))
                if where.name == END:
                    metadata = memoryview(_bytes(file, where.offset, where.length))
                    said.hear(Opcode.METADATA, metadata[RECORD.size :])
    channels = {n: names for n, names in said.channels.items() if names[0] in INDEXED}
    events = sum(counts.get(n, 0) for n, (schema, _) in said.channels.items() if schema in EVENTS)
    if events != said.events or len({topic for _, topic in channels.values()}) != len(channels):
        return None
    places = _places(file, chunks, list(channels))
    topics = []
    for channel, (schema, name) in channels.items():
        records = np.array([at for at, _ in places[channel]], np.int64)
        starts = [start for _, start in places[channel]]
        each = [len(some) for some in starts]
        if sum(each) != counts.get(channel, 0):
            return None
        topics.append(
            Topic(
                schema=schema,
                name=name,
                record_at=np.repeat(records, each),
                start=np.concatenate([np.empty(0, np.int64), *starts]),
                publish_ns=_times(file, attached[f"{_TIMES}{name}"], sum(each)),
            )
        )
    return Told(topics=tuple(topics), note=said.note)


def _summary(file: BinaryIO) -> Iterator[tuple[int, memoryview]]:
    """Its records; raises `ValueError` for a file without a whole one."""
    footer_at = file.seek(0, 2) - len(MAGIC) - _FOOTER.size
    footer = _bytes(file, footer_at, _FOOTER.size)
    opcode, length, start, _, checksum = _FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER_LENGTH) or file.read() != MAGIC:
        raise ValueError("no footer")
    data = _bytes(file, start, footer_at - start)
    if zlib.crc32(footer[:-4], zlib.crc32(data)) != checksum:
        raise ValueError("a summary that fails its checksum")
    content = np.frombuffer(data, np.uint8)
    none = np.empty((0, COLUMNS), np.int64)
    rows = np.zeros((find_records(content, Opcode.MESSAGE, 0, none), COLUMNS), np.int64)
    find_records(content, Opcode.MESSAGE, 0, rows)
    for opcode, first, end in rows[:, :3].tolist():
        yield opcode, memoryview(data)[first:end]


def _places(
    file: BinaryIO, chunks: list[memoryview], channels: list[int]
) -> dict[int, list[tuple[int, Int[np.ndarray, " n"]]]]:
    """By channel: per chunk where that is in the file, and where in it the messages are.

    Raises `ValueError` for indexes of more bytes than the file has.
    """
    left = file.seek(0, 2)
    found = {channel: [] for channel in channels}
    for chunk in chunks:
        _, _, record_at, length, size = _CHUNK.unpack_from(chunk)
        rows = np.frombuffer(chunk[_CHUNK.size : _CHUNK.size + size], _OF_CHANNEL)
        (index_length,) = struct.unpack_from("<Q", chunk, _CHUNK.size + size)
        left -= index_length
        if left < 0:
            raise ValueError("chunks that share an index")
        index_at = record_at + length
        index = _bytes(file, index_at, index_length)
        for channel, at in rows[np.isin(rows["channel"], channels)].tolist():
            opcode, _, whose, size = _INDEX.unpack_from(index, at - index_at)
            if opcode != Opcode.MESSAGE_INDEX or whose != channel:
                raise ValueError("no index of this channel")
            first = at - index_at + _INDEX.size
            starts = np.frombuffer(index[first : first + size], _OF_MESSAGE)["start"]
            found[channel].append((record_at, starts.astype(np.int64)))
    return found


def _times(file: BinaryIO, where: AttachmentIndex, count: int) -> Int[np.ndarray, " n"]:
    content = memoryview(_bytes(file, where.offset, where.length))[RECORD.size :]
    packed = Attachment.read(_stream(content)).data
    if zstandard.get_frame_parameters(packed).content_size != 8 * count or count > MAX_BYTES // 8:
        raise ValueError("times of other messages")
    steps = zstandard.ZstdDecompressor(max_window_size=MAX_BYTES).decompress(packed)
    return np.cumsum(np.frombuffer(steps, "<i8"), dtype=np.int64)


def _bytes(file: BinaryIO, at: int, count: int) -> bytes:
    """Raises `ValueError` where the file does not hold them."""
    if not 0 <= count <= MAX_BYTES or at < 0:
        raise ValueError(f"{count} bytes")
    file.seek(at)
    data = file.read(count)
    if len(data) != count:
        raise ValueError("beyond the file's end")
    return data


def _stream(content: memoryview) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
