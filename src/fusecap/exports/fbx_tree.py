"""Binary FBX as a tree of elements: read, changed, written again.

    element   end, properties, their bytes (uint32 each), len(name) (uint8), name, properties,
              elements, 13 zero bytes where there are elements
    property  a letter for the type, then the value; arrays: count, 1 for zlib, bytes (uint32 each)

Offsets are from the beginning of the file, so that writing computes them anew.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from fusecap.errors import InputError

_HEAD, _FOOT_BYTES = b"Kaydara FBX Binary  \x00\x1a\x00", 16
_LAST = bytes.fromhex("f85a8c6adef5d97eece90ce3758f290b")
_VERSIONS = range(7000, 7500)
"""Later ones have offsets of 64 bits."""
_RECORD = struct.Struct("<IIIB")
_END = b"\0" * _RECORD.size
_SIZES = {b"C": 1, b"B": 1, b"Y": 2, b"I": 4, b"F": 4, b"D": 8, b"L": 8}
_KINDS = {"i": "<i4", "l": "<i8", "f": "<f4", "d": "<f8"}
_ZLIB = struct.pack("<I", 1)
_MOST_BYTES = 1 << 32


@dataclass(slots=True)
class FbxElement:
    """One element; a property is its letter and its bytes as they stand in the file."""

    name: bytes
    properties: list[bytes]
    children: list[FbxElement] = field(default_factory=list)
    closed: bool = False
    """Whether zero bytes stand at its end even without children."""

    def child(self, name: bytes) -> FbxElement:
        """The first of that name."""
        return next(each for each in self.children if each.name == name)

    def named(self, name: bytes) -> Iterator[FbxElement]:
        """All of that name."""
        return (each for each in self.children if each.name == name)

    def text(self, index: int) -> bytes:
        """A property that is a string."""
        return self.properties[index][5:]

    def whole(self, index: int) -> int:
        """A property that is a whole number of 64 bits."""
        return struct.unpack("<q", self.properties[index][1:])[0]

    def number(self, index: int) -> float:
        """A property that is a float of 64 bits."""
        return struct.unpack("<d", self.properties[index][1:])[0]

    def numbers(self, index: int) -> np.ndarray:
        """A property that is an array of int32, int64, float32 or float64."""
        kind, packed = self.properties[index][:1].decode(), self.properties[index][13:]
        if self.properties[index][5:9] == _ZLIB:
            packed = zlib.decompress(packed)
        return np.frombuffer(packed, _KINDS[kind])


def text_property(text: bytes) -> bytes:
    """A string."""
    return b"S" + struct.pack("<I", len(text)) + text


def array_property(values: np.ndarray) -> bytes:
    """An array of int32, int64, float32 or float64."""
    letter = next(letter for letter, kind in _KINDS.items() if kind == values.dtype.str)
    packed = zlib.compress(np.ascontiguousarray(values).tobytes(), 1)
    head = struct.pack("<I", len(values)) + _ZLIB + struct.pack("<I", len(packed))
    return letter.encode() + head + packed


@dataclass(slots=True)
class FbxFile:
    """A whole file."""

    version: int
    elements: list[FbxElement]
    foot: bytes
    """Sixteen bytes that stand after the elements."""

    @classmethod
    def read(cls, data: bytes) -> FbxFile:
        """Raises `InputError` for another version than those from 7.0 up to 7.4."""
        if not data.startswith(_HEAD):
            raise InputError("expected binary FBX, found something else")
        try:
            version = struct.unpack_from("<I", data, len(_HEAD))[0]
            if version not in _VERSIONS:
                raise InputError(f"expected FBX 7.0 to 7.4, found version {version / 1000:g}")
            elements, at = _read_elements(data, len(_HEAD) + 4)
        except (struct.error, IndexError, StopIteration):
            raise InputError("the FBX file ends in its middle") from None
        return cls(version, elements, data[at : at + _FOOT_BYTES])

    def named(self, name: bytes) -> FbxElement:
        """The first element of that name."""
        return next(each for each in self.elements if each.name == name)

    def pieces(self) -> Iterator[bytes]:
        """The file's bytes; raises `InputError` beyond the 4 GB that offsets can say."""
        head = _HEAD + struct.pack("<I", self.version)
        sizes: dict[int, int] = {}
        at = len(head) + sum(_size(each, sizes) for each in self.elements) + len(_END)
        if at >= _MOST_BYTES:
            raise InputError("an FBX file of this take is larger than 4 GB: trim it, or write GLB")
        yield head
        at = len(head)
        for each in self.elements:
            yield from _written(each, at, sizes)
            at += sizes[id(each)]
        yield _END
        at += len(_END) + _FOOT_BYTES + 4
        yield self.foot + b"\0" * 4 + b"\0" * (16 - at % 16) + struct.pack("<I", self.version)
        yield b"\0" * 120 + _LAST


def _read_elements(data: bytes, at: int) -> tuple[list[FbxElement], int]:
    """Up to the zero bytes that end them, and what comes after these."""
    elements = []
    while True:
        end, count, _, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if end == 0:
            return elements, at
        element = FbxElement(data[at : at + length], [])
        at += length
        for _ in range(count):
            stop = at + 1 + _value_size(data, at)
            element.properties.append(data[at:stop])
            at = stop
        if at < end:
            element.children, at = _read_elements(data, at)
            element.closed = True
        elements.append(element)


def _value_size(data: bytes, at: int) -> int:
    letter = data[at : at + 1]
    if letter in _SIZES:
        return _SIZES[letter]
    if letter in (b"S", b"R"):
        return 4 + struct.unpack_from("<I", data, at + 1)[0]
    if letter in (b"f", b"d", b"l", b"i", b"b", b"c"):
        return 12 + struct.unpack_from("<I", data, at + 9)[0]
    raise InputError(f"an FBX property of the unknown type {letter!r}")


def _size(element: FbxElement, sizes: dict[int, int]) -> int:
    size = _RECORD.size + len(element.name) + sum(map(len, element.properties))
    size += sum(_size(child, sizes) for child in element.children)
    sizes[id(element)] = size + (len(_END) if element.closed or element.children else 0)
    return sizes[id(element)]


def _written(element: FbxElement, at: int, sizes: dict[int, int]) -> Iterator[bytes]:
    properties = b"".join(element.properties)
    count, name = len(element.properties), element.name
    yield _RECORD.pack(at + sizes[id(element)], count, len(properties), len(name)) + name
    yield properties
    at += _RECORD.size + len(name) + len(properties)
    for child in element.children:
        yield from _written(child, at, sizes)
        at += sizes[id(child)]
    if element.closed or element.children:
        yield _END
