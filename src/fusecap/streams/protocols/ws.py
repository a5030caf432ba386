"""Messages for browsers and scripts: JSON text, or the same numbers in binary.

A client first gets the cast, as JSON text in either form, and again whenever it changes:

    {"type": "cast", "format": "fusecap stream 1", "rate_hz": 60, "units": {...}, "people":
     [{"name": "anna", "height_m": 1.68, "skeleton": "paper21", "bones": [...],
       "parents": [-1, 0, ...], "offsets_m": [[x, y, z], ...]}]}

Then one message per instant. As text:

    {"type": "frame", "time_s": 1.5, "timestamp_ns": 1500000000, "people": {"anna":
     {"position_m": [[x, y, z], ...], "rotation_wxyz": [[w, x, y, z], ...], "quality": [...]}}}

In binary, little-endian: `FCS1`, uint32 number of people that follow, int64 timestamp_ns, float64
time_s; then per person uint32 index in the cast, uint32 number of bones B, and B times 8 float32:
x y z [m], w x y z, quality. Only who is tracked is there. World axes and units are ours.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.shape import BodyShape
from fusecap.geometry.quaternions import to_wxyz
from fusecap.streams.door import Door
from fusecap.streams.person_pose import StreamFrame
from fusecap.streams.stream import Cast, StreamProtocol
from fusecap.streams.target import Target
from fusecap.streams.transports import Counts, WebSocketServer

FORMAT = "fusecap stream 1"
MAGIC = b"FCS1"
UNITS = {
    "position_m": "metres, the joint at the bone's root, in the world",
    "rotation_wxyz": "unit quaternion world_from_bone",
    "quality": "0-1; 0 where the pose is a guess",
    "world": "right-handed, y up, floor at y = 0; bones parallel to it in the T-pose facing +z",
}


def cast_message(people: Iterable[tuple[str, BodyShape]], rate_hz: float) -> str:
    """Who is in the stream, in the order of the binary form's indices."""
    return json.dumps(
        {
            "type": "cast",
            "format": FORMAT,
            "rate_hz": rate_hz,
            "units": UNITS,
            "people": [
                {
                    "name": name,
                    "height_m": round(shape.height_m, 4),
                    "skeleton": shape.skeleton.name,
                    "bones": shape.skeleton.bone_names,
                    "parents": shape.skeleton.parents,
                    "offsets_m": np.round(shape.offsets_m, 5).tolist(),
                }
                for name, shape in people
            ],
        }
    )


def frame_text(frame: StreamFrame) -> str:
    """One instant as JSON."""
    people = {
        pose.name: {
            "position_m": np.round(pose.bone_position_in_world_m, 5).tolist(),
            "rotation_wxyz": np.round(
                to_wxyz(Rotation.from_matrix(pose.bone_rotation_in_world)), 6
            ).tolist(),
            "quality": np.round(pose.bone_quality, 3).tolist(),
        }
        for pose in frame.tracked
    }
    return json.dumps(
        {
            "type": "frame",
            "time_s": round(frame.time_s, 6),
            "timestamp_ns": frame.timestamp_ns,
            "people": people,
        },
        separators=(",", ":"),
    )


def frame_bytes(frame: StreamFrame) -> bytes:
    """One instant in binary."""
    order = list(frame.people)
    parts = [struct.pack("<4sIqd", MAGIC, len(frame.tracked), frame.timestamp_ns, frame.time_s)]
    for pose in frame.tracked:
        values = np.concatenate(
            [
                pose.bone_position_in_world_m,
                to_wxyz(Rotation.from_matrix(pose.bone_rotation_in_world)),
                pose.bone_quality[:, None],
            ],
            axis=1,
        )
        parts += [
            struct.pack("<II", order.index(pose.name), len(values)),
            values.astype("<f4").tobytes(),
        ]
    return b"".join(parts)


class WebSocketStream:
    """Everyone to every client."""

    def __init__(self, target: Target, cast: Cast, rate_hz: float) -> None:
        self.target = target
        self.counts = Counts()
        self._server = WebSocketServer(
            target.host, target.port, self.counts, Door(token=target.token)
        )
        self._rate_hz = rate_hz
        self.set_cast(cast)

    def send(self, frame: StreamFrame) -> None:
        wants = self._server.wants
        if wants:
            self._server.publish(
                frame_text(frame) if False in wants else None,
                frame_bytes(frame) if True in wants else None,
            )

    def set_cast(self, cast: Cast) -> None:
        """Tells every client."""
        self._server.publish_cast(cast_message(cast.items(), self._rate_hz))

    def remark(self) -> str:
        if not self._server.clients_ever:
            return f"no client has connected; open {self.target.address}, or /binary there"
        if self.counts.dropped:
            return "a client is too slow and misses frames"
        return ""

    def where(self) -> dict[str, str]:
        return {"everyone": self.target.address}

    def close(self) -> None:
        self._server.close()


PROTOCOL = StreamProtocol(open=WebSocketStream, port=8765, serves=True)
