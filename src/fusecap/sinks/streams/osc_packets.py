"""Open Sound Control 1.0 packets: messages of ints, floats and strings, and bundles of messages."""

from __future__ import annotations

from collections.abc import Iterable

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder

MAX_BYTES = 1472
"""Of a bundle: what one Ethernet frame of 1500 bytes holds after the headers of IP and UDP."""

_TAGS = {str: "s", int: "i", float: "f"}
_HEADER_BYTES = 16
_LENGTH_BYTES = 4


def message(address: str, *arguments: str | int | float) -> OscMessage:
    """One message; ints are 32 bit, floats single precision."""
    builder = OscMessageBuilder(address)
    for argument in arguments:
        builder.add_arg(argument, _TAGS[type(argument)])
    return builder.build()


def bundles(messages: Iterable[OscMessage], max_bytes: int = MAX_BYTES) -> list[bytes]:
    """Messages in their order, packed into as few bundles "immediately" as `max_bytes` allows."""
    packed: list[bytes] = []
    builder, size = OscBundleBuilder(IMMEDIATELY), _HEADER_BYTES
    for content in messages:
        length = _LENGTH_BYTES + content.size
        if size + length > max_bytes and size > _HEADER_BYTES:
            packed.append(builder.build().dgram)
            builder, size = OscBundleBuilder(IMMEDIATELY), _HEADER_BYTES
        builder.add_content(content)
        size += length
    return [*packed, builder.build().dgram] if size > _HEADER_BYTES else packed
