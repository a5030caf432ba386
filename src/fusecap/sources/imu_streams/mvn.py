"""The network stream of Xsens MVN over UDP, after Xsens' published specification [1].

Big-endian, a header of 24 bytes, then one item per segment or tracker:

    0  6s  "MXTP" and the type        11  B  number of items
    6  I   sample counter             12  I  time code [ms]
    10 B   datagram counter, bit 7:   16  B  character
           the last of its sample     22  H  bytes that follow the header

Type 02, 32 bytes an item: segment ID, position [cm], quaternion w x y z of the *segment*.
Type 23, 44 bytes an item: ID of the segment that carries the tracker, quaternion w x y z of the
*tracker*, its acceleration without gravity [m/s2], magnetic field. Before revision M (June 2018)
68 bytes: local acceleration and angular velocity stand before the field. Both in a z-up world.

Items carry their IDs, so a sample that is split over several datagrams needs no reassembly, and a
datagram that is lost loses only its own items. Types of other contents (meta data 12, scale 13,
joint angles 20, ...) are passed over.

[1] "MVN real-time network streaming protocol specification", Xsens MV0305P, revision N, 2018.
"""

from __future__ import annotations

import re
import struct
from urllib.parse import unquote

import numpy as np

from fusecap.errors import nearest
from fusecap.sources.imu_files.track import specific_force
from fusecap.sources.live_address import LOOPBACK, address_options, listening, wrong_address
from fusecap.sources.live_sensor import (
    Packet,
    Refused,
    SensorAddress,
    SensorProtocol,
    SensorSample,
    checked_accel,
    checked_orientation,
)

MVN_PORT = 9763
SEGMENTS = (
    *("Pelvis", "L5", "L3", "T12", "T8", "Neck", "Head"),
    *("RightShoulder", "RightUpperArm", "RightForeArm", "RightHand"),
    *("LeftShoulder", "LeftUpperArm", "LeftForeArm", "LeftHand"),
    *("RightUpperLeg", "RightLowerLeg", "RightFoot", "RightToe"),
    *("LeftUpperLeg", "LeftLowerLeg", "LeftFoot", "LeftToe"),
)
"""In the order of their IDs, which count from 1 (MVN network streaming specification, 3.1)."""
KINDS = ("sensor", "segment")
"""What stands for a sensor: its own orientation (type 23), or its segment's (type 02)."""
_HEADER = struct.Struct(">6sIBBIBBBBHH")
_QUATERNION_AT = {"segment": 16, "sensor": 4}
_SIZES = {"segment": (32,), "sensor": (44, 68)}
_TYPES = {b"02": "segment", b"23": "sensor"}


def mvn_sensor_name(segment: str, character: int, kind: str) -> str:
    """As the session's address has it, so that a note can be copied there."""
    return f"{segment}?character={character}&data={kind}"


def mvn_packet(datagram: bytes) -> Packet:
    """Samples named by `mvn_sensor_name`; props and fingers are left out.

    The stamp is the time code, which moves only while MVN records or plays; the counter always.
    """
    refused: list[str] = []
    try:
        samples = _samples(datagram, refused)
    except Refused as error:
        return Packet(refused=(str(error),))
    return Packet(samples=samples, refused=tuple(refused))


def _samples(datagram: bytes, refused: list[str]) -> tuple[SensorSample, ...]:
    """Raises `Refused`; of items that cannot be used the reasons go to `refused`."""
    if len(datagram) < _HEADER.size:
        raise Refused(f"{len(datagram)} bytes, expected a header of {_HEADER.size}")
    name, counter, _, items, time_ms, character, *_, payload = _HEADER.unpack_from(datagram)
    if name[:4] != b"MXTP" or not name[4:].isdigit():
        raise Refused("does not start with MXTP and a type")
    kind = _TYPES.get(name[4:])
    if kind is None:
        return ()
    body = len(datagram) - _HEADER.size
    size, rest = divmod(body, items) if items else (0, body)
    if rest or size not in _SIZES[kind] or payload not in (0, body):
        raise Refused(f"{items} items and {payload} bytes announced, {body} bytes found")
    segments, orientations, free_accels = [], [], []
    for at in range(_HEADER.size, len(datagram), size):
        (identity,) = struct.unpack_from(">i", datagram, at)
        if not 1 <= identity <= len(SEGMENTS):
            continue
        segment = SEGMENTS[identity - 1]
        try:
            wxyz = struct.unpack_from(">4f", datagram, at + _QUATERNION_AT[kind])
            orientation = checked_orientation(wxyz)
            free_accel = np.full(3, np.nan)
            if kind == "sensor":
                free_accel = checked_accel(struct.unpack_from(">3f", datagram, at + 20))
        except Refused as error:
            refused.append(f"{segment}: {error}")
            continue
        segments.append(segment)
        orientations.append(orientation)
        free_accels.append(free_accel)
    if not segments:
        return ()
    accels = specific_force(np.array(orientations), np.array(free_accels))
    return tuple(
        SensorSample(
            sensor=mvn_sensor_name(segment, character, kind),
            stamp_ns=time_ms * 1_000_000,
            orientation_wxyz=orientation,
            accel_m_s2=accel,
            counter=counter,
        )
        for segment, orientation, accel in zip(segments, orientations, accels, strict=True)
    )


def _address(text: str) -> SensorAddress:
    example = f'live = "mvn://{LOOPBACK}:{MVN_PORT}/LeftForeArm"'
    parts, host, port = listening(text, example)
    segment = unquote(parts.path[1:])
    if segment not in SEGMENTS:
        raise wrong_address(text, f"no segment '{segment}'{nearest(segment, SEGMENTS)}", example)
    options = address_options(text, parts.query, ("character", "data"), example)
    kind = options.get("data", KINDS[0])
    if kind not in KINDS:
        raise wrong_address(text, f"data={kind}: expected {' or '.join(KINDS)}", example)
    character = options.get("character", "0")
    if not re.fullmatch(r"\d{1,3}", character) or int(character) > 255:
        raise wrong_address(text, f"character={character}: expected 0 to 255", example)
    return SensorAddress(
        protocol="mvn",
        host=host,
        port=port or MVN_PORT,
        sensor=mvn_sensor_name(segment, int(character), kind),
    )


PROTOCOL = SensorProtocol(parse=_address, packet=mvn_packet)
