"""Writes an MCAP log (https://mcap.dev); holds no clock.

Events are written in the order in which they are given, each with its number among all events, so
that a reader knows when one is missing. A chunk is on its way to the disk when `flush` returns:
whoever calls it twice a second loses half a second to a kill -9.
"""

from __future__ import annotations

import json
import zlib
from array import array
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from typing import Any, BinaryIO

import numpy as np
from mcap.writer import CompressionType, Writer

from fusecap.body.shape import BodyShape
from fusecap.recording import foxglove, layout
from fusecap.recording.layout import END, FORMAT, HEADER
from fusecap.recording.told import INDEXED, add_times
from fusecap.types import CameraSample, Command, Estimate, Event, ImuSample, Tick

SCENE_PERIOD_NS = 100_000_000
"""Of the scene for Foxglove."""
_SAME_BODY_M = 1e-4


class RecordingWriter:
    """One log. Raises `OSError` as the file does; what was flushed until then stays readable."""

    def __init__(
        self,
        file: BinaryIO,
        setup: Mapping[str, Any],
        *,
        cameras: Sequence[str],
        unix_minus_session_ns: int,
        from_start: bool = True,
    ) -> None:
        """`setup` is plain values, kept as they are; without `from_start` events came before."""
        self.events = 0
        self._cameras = tuple(cameras)
        self._unix_minus_session_ns = unix_minus_session_ns
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._bodies: dict[str, BodyShape] = {}
        self._times_ns: dict[str, array[int]] = {}
        """By topic; 8 bytes a pose and a picture."""
        self._scene_due_ns: int | None = None
        self._writer = Writer(file, compression=CompressionType.ZSTD)
        self._writer.start(library=f"fusecap {metadata.version('fusecap')}")
        values = json.dumps(setup)
        self._writer.add_metadata(
            HEADER,
            {
                "format": FORMAT,
                "made_by": f"fusecap {metadata.version('fusecap')}",
                "from_start": json.dumps(from_start),
                "unix_minus_session_ns": str(unix_minus_session_ns),
                "setup": values,
                "setup_crc32": str(zlib.crc32(values.encode())),
            },
        )
        self.flush()

    def event(self, event: Event, arrival_ns: int) -> None:
        """The next event; it arrived at this time of the session's clock."""
        sample_ns = arrival_ns
        match event:
            case CameraSample():
                topic = f"/camera/{self._cameras[event.camera]}/keypoints"
                schema, text = layout.KEYPOINTS, layout.keypoints_message(event)
                sample_ns = event.timestamp_ns
            case ImuSample():
                topic = f"/imu/{event.subject}/{event.bone}"
                schema, text = layout.IMU, layout.imu_message(event)
                sample_ns = event.timestamp_ns
            case Tick():
                topic, schema, text = "/tick", layout.TICK, layout.tick_message(event)
                sample_ns = event.timestamp_ns
            case Command():
                topic, schema = "/command", layout.COMMAND
                text = layout.command_message(event)
        self.events += 1
        self._write(topic, schema, text, arrival_ns, sample_ns)

    def poses(self, estimates: Iterable[Estimate], now_ns: int) -> None:
        """Everyone's pose after the tick that was the latest event."""
        estimates = tuple(estimates)
        for estimate in estimates:
            name, at_ns = estimate.name, estimate.timestamp_ns
            if not _same_body(self._bodies.get(name), estimate.shape):
                self._bodies[name] = estimate.shape
                body = layout.body_message(name, estimate.shape)
                self._write(f"/body/{name}", layout.BODY, body, now_ns, at_ns)
            pose = layout.pose_message(estimate)
            self._write(f"/pose/{name}", layout.POSE, pose, now_ns, at_ns)
        if estimates and (self._scene_due_ns is None or now_ns >= self._scene_due_ns):
            self._scene_due_ns = now_ns + SCENE_PERIOD_NS
            at_ns = estimates[0].timestamp_ns
            text = foxglove.scene_message(estimates, self._unix_ns(at_ns))
            self._write("/scene", foxglove.SCENE_SCHEMA, text, now_ns, at_ns)

    def image(self, camera: int, timestamp_ns: int, jpeg: bytes, now_ns: int) -> None:
        """A picture that went to the detector."""
        name = self._cameras[camera]
        text = foxglove.image_message(jpeg, name, self._unix_ns(timestamp_ns))
        self._write(f"/camera/{name}/image", foxglove.IMAGE_SCHEMA, text, now_ns, timestamp_ns)

    def flush(self) -> None:
        """Close the chunk and hand everything to the operating system."""
        self._writer.flush()

    def finish(self, note: str = "") -> None:
        """Indexes and footer; `note` says why it ends, where that was not asked for."""
        self._writer.flush()
        self._writer.add_metadata(END, {"events": str(self.events), "note": note})
        add_times(self._writer, self._times_ns)
        self._writer.finish()
        self._writer.flush()

    def _write(self, topic: str, schema: str, text: str, arrival_ns: int, sample_ns: int) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._writer.register_channel(topic, "json", self._schema(schema))
            self._channels[topic] = channel
            if schema in INDEXED:
                self._times_ns[topic] = array("q")
        publish_ns = self._unix_ns(sample_ns)
        if topic in self._times_ns:
            self._times_ns[topic].append(publish_ns)
        self._writer.add_message(
            channel,
            log_time=self._unix_ns(arrival_ns),
            data=text.encode(),
            publish_time=publish_ns,
            sequence=self.events & 0xFFFFFFFF,
        )

    def _schema(self, name: str) -> int:
        if name not in self._schemas:
            known = layout.SCHEMAS | foxglove.SCHEMAS
            self._schemas[name] = self._writer.register_schema(
                name, "jsonschema", json.dumps(known[name]).encode()
            )
        return self._schemas[name]

    def _unix_ns(self, session_ns: int) -> int:
        return max(0, session_ns + self._unix_minus_session_ns)


def _same_body(known: BodyShape | None, shape: BodyShape) -> bool:
    if known is None or known is shape:
        return known is shape
    return bool(np.abs(known.offsets_m - shape.offsets_m).max() < _SAME_BODY_M)
