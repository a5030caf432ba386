"""Samples in Open Sound Control 1.0 [1], over UDP, alone or in bundles.

    /fusecap/imu  NAME  [seconds]  qw qx qy qz  [ax ay az]

NAME is a string, the time a double (`d`) on the sender's clock, everything else floats or doubles.
Without a time the bundle's time tag counts, unless it says "immediately"; then the arrival. Other
messages are passed over. This one message has a parser of its own because in python-osc 1.9 a
bundle of 20 bytes, whose one element has a negative size, is read forever.

[1] https://opensoundcontrol.stanford.edu/spec-1_0.html
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from urllib.parse import unquote

import numpy as np

from fusecap.sources.live_address import IMU_EXAMPLE, listening, wrong_address
from fusecap.sources.live_sensor import (
    Packet,
    Refused,
    SensorAddress,
    SensorProtocol,
    SensorSample,
    checked_accel,
    checked_orientation,
    checked_stamp_ns,
)

ADDRESS = "/fusecap/imu"
MAX_NAME_BYTES = 200
MAX_NESTING = 4
MAX_FLOAT_SECONDS = 4096.0
"""Beyond this a 32-bit time has steps of half a millisecond."""
_BUNDLE = b"#bundle\0"
_IMMEDIATELY = 1


def osc_packet(datagram: bytes) -> Packet:
    """Everything usable in one datagram, up to where it stops following the layout."""
    samples: list[SensorSample] = []
    refused: list[str] = []
    try:
        for message, tag_ns in _messages(memoryview(datagram), None, 0):
            try:
                sample = _sample(message, tag_ns)
            except Refused as error:
                refused.append(str(error))
                continue
            if sample is not None:
                samples.append(sample)
    except Refused as error:
        refused.append(str(error))
    return Packet(samples=tuple(samples), refused=tuple(refused))


def _messages(
    packet: memoryview, tag_ns: int | None, depth: int
) -> Iterator[tuple[memoryview, int | None]]:
    """Each message with the time tag of its bundle; raises `Refused`."""
    if bytes(packet[:8]) != _BUNDLE:
        yield packet, tag_ns
        return
    if depth == MAX_NESTING:
        raise Refused(f"bundles in bundles, more than {MAX_NESTING} deep")
    if len(packet) < 16:
        raise Refused("a bundle is cut short")
    tag_ns = _time_tag_ns(struct.unpack_from(">Q", packet, 8)[0])
    at = 16
    while at < len(packet):
        if at + 4 > len(packet):
            raise Refused("a bundle is cut short")
        size = struct.unpack_from(">i", packet, at)[0]
        at += 4
        if size <= 0 or size % 4 or size > len(packet) - at:
            raise Refused(f"an element of {size} bytes where {len(packet) - at} are left")
        yield from _messages(packet[at : at + size], tag_ns, depth + 1)
        at += size


def _time_tag_ns(tag: int) -> int | None:
    """Since 1900; None for "immediately"."""
    if tag <= _IMMEDIATELY:
        return None
    return (tag >> 32) * 1_000_000_000 + ((tag & 0xFFFFFFFF) * 1_000_000_000 >> 32)


def _sample(packet: memoryview, tag_ns: int | None) -> SensorSample | None:
    """None for a message of another address; raises `Refused`."""
    address, at = _string(packet, 0, "the address")
    if not address.startswith("/"):
        raise Refused("neither a message nor a bundle")
    if address != ADDRESS:
        return None
    tags, at = _string(packet, at, "the type tags")
    if not tags.startswith(",s") or len(tags) > 2 + 8 or tags.strip(",sfd"):
        raise Refused(f"types '{tags[:20]}', expected a name and 4 to 8 floats or doubles")
    name, at = _string(packet, at, "the name")
    if not name:
        raise Refused("the name is empty")
    kinds = tags[2:]
    try:
        numbers = struct.unpack_from(">" + kinds, packet, at)
    except struct.error:
        raise Refused(f"cut short: types '{tags}'") from None
    if at + struct.calcsize(">" + kinds) != len(packet):
        raise Refused(f"longer than its types '{tags}'")
    stamp_ns = tag_ns
    if len(numbers) in (5, 8):
        if kinds[0] == "f" and not abs(numbers[0]) <= MAX_FLOAT_SECONDS:
            raise Refused("the time is a float, too coarse for its size; send a double")
        stamp_ns = checked_stamp_ns(numbers[0])
        numbers = numbers[1:]
    if len(numbers) not in (4, 7):
        raise Refused(f"{len(numbers)} numbers, expected [seconds] qw qx qy qz [ax ay az]")
    return SensorSample(
        sensor=name,
        stamp_ns=stamp_ns,
        orientation_wxyz=checked_orientation(numbers[:4]),
        accel_m_s2=checked_accel(numbers[4:]) if len(numbers) == 7 else np.full(3, np.nan),
    )


def _string(packet: memoryview, at: int, what: str) -> tuple[str, int]:
    """A zero-terminated string that is filled up to four bytes, and what comes after it."""
    head = bytes(packet[at : at + MAX_NAME_BYTES + 1])
    end = head.find(0)
    after = at + (end // 4 + 1) * 4
    if end < 0 or after > len(packet):
        raise Refused(f"{what} does not end")
    try:
        return head[:end].decode("utf-8"), after
    except UnicodeDecodeError:
        raise Refused(f"{what} is no text") from None


def _address(text: str) -> SensorAddress:
    parts, host, port = listening(text, IMU_EXAMPLE)
    sensor = unquote(parts.path[1:])
    if port is None or not sensor or parts.query:
        raise wrong_address(text, "expected a host, a port and the sensor's name", IMU_EXAMPLE)
    return SensorAddress(protocol="osc", host=host, port=port, sensor=sensor)


PROTOCOL = SensorProtocol(parse=_address, packet=osc_packet)
