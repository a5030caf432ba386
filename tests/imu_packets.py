"""Datagrams of sensors as their senders make them, built without our parsers."""

import struct

from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

UP = (0.0, 0.0, 9.81)


def osc_message(name="left_shank", seconds=1.5, quaternion=(1.0, 0.0, 0.0, 0.0), accel=UP):
    """By python-osc; seconds or accel None: left out."""
    builder = OscMessageBuilder(address="/fusecap/imu")
    builder.add_arg(name, "s")
    if seconds is not None:
        builder.add_arg(seconds, "d")
    for value in (*quaternion, *(accel or ())):
        builder.add_arg(float(value), "f")
    return builder.build()


def osc_bundle(messages, time=IMMEDIATELY):
    builder = OscBundleBuilder(time)
    for message in messages:
        builder.add_content(message)
    return builder.build()


def mvn(kind, items, *, counter=7, time_ms=1500, character=0, datagram=0x80):
    """`items`: (segment ID, numbers), after the published layout."""
    body = b"".join(struct.pack(f">i{len(v)}f", number, *v) for number, v in items)
    header = struct.pack(
        ">6sIBBIBBBBHH",
        b"MXTP" + kind,
        counter,
        datagram,
        len(items),
        time_ms,
        character,
        *(23, 0, 0, 0),
        len(body),
    )
    assert len(header) == 24
    return header + body


def mvn_segments(quaternions, **more):
    """Type 02; `quaternions` by segment ID."""
    return mvn(b"02", [(i, (10.0, 20.0, 90.0, *q)) for i, q in quaternions.items()], **more)


def mvn_trackers(orientations, free_accel=(0.0, 0.0, 0.0), **more):
    """Type 23, revision M and later."""
    magnetic = (0.5, 0.0, 0.8)
    return mvn(b"23", [(i, (*q, *free_accel, *magnetic)) for i, q in orientations.items()], **more)
