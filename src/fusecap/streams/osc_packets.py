"""Open Sound Control 1.0 packets: messages of ints, floats and strings, and bundles of messages."""

from __future__ import annotations

import functools
import struct
from collections.abc import Iterable

MAX_BYTES = 1472
"""Of a bundle: what one Ethernet frame of 1500 bytes holds after the headers of IP and UDP."""

_TAGS = {str: "s", int: "i", float: "f"}
_IMMEDIATELY = b"#bundle\0" + struct.pack(">q", 1)
_LENGTH = struct.Struct(">i")


def message(address: str, *arguments: str | int | float) -> bytes:
    """One message; ints are 32 bit, floats single precision."""
    tags = "".join([_TAGS[type(argument)] for argument in arguments])
    return _head(address, tags) + b"".join([_ENCODED[type(a)](a) for a in arguments])


def bundles(messages: Iterable[bytes], max_bytes: int = MAX_BYTES) -> list[bytes]:
    """Messages in their order, packed into as few bundles "immediately" as `max_bytes` allows."""
    packed: list[bytes] = []
    parts, size = [_IMMEDIATELY], len(_IMMEDIATELY)
    for content in messages:
        length = _LENGTH.size + len(content)
        if size + length > max_bytes and len(parts) > 1:
            packed.append(b"".join(parts))
            parts, size = [_IMMEDIATELY], len(_IMMEDIATELY)
        parts += [_LENGTH.pack(len(content)), content]
        size += length
    return [*packed, b"".join(parts)] if len(parts) > 1 else packed


@functools.lru_cache(maxsize=4096)
def _head(address: str, tags: str) -> bytes:
    return _padded(address) + _padded(f",{tags}")


def _padded(text: str) -> bytes:
    """Ends with one to four zeros, at a multiple of four bytes."""
    data = text.encode()
    return data + b"\0" * (4 - len(data) % 4)


_ENCODED = {str: _padded, int: struct.Struct(">i").pack, float: struct.Struct(">f").pack}
