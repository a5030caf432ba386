"""How a live run goes: what its status line, its viewer and its report show."""

from __future__ import annotations

import enum
from dataclasses import dataclass

from fusecap.streams.output import StreamStatus


class Light(enum.Enum):
    """Of a source."""

    WAITING = "waiting"
    """Nothing has come yet."""
    FRESH = "fresh"
    LATE = "late"
    """Nothing for longer than 0.1 s and three of its periods."""
    LOST = "lost"
    """Nothing for a second, or its device is gone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceStatus:
    """One camera or one sensor."""

    name: str
    """Of the camera; of a sensor, "subject/bone"."""
    kind: str
    """"camera" or "imu"."""
    light: Light
    rate_hz: float
    """Over the last seconds."""
    age_s: float
    """Since the last item; infinite before the first."""
    received: int
    dropped: int
    """Images overtaken by newer ones before the detector was free; samples late or double."""
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class StageLatency:
    """Of one stage, over the last seconds (in the report: the whole run)."""

    stage: str
    p50_ms: float
    p95_ms: float
    p99_ms: float
    count: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingStatus:
    """The file that is being written."""

    path: str
    megabytes: float
    seconds: float
    problem: str = ""
    """Why it has stopped, e.g. a full disk; empty while all is well."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Incident:
    """Something that happened: a camera lost, a disk full, a person found."""

    time_s: float
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveStatus:
    """At one moment."""

    elapsed_s: float
    detections_per_s: float
    """Instants that went through the detector, or frames from outside, all cameras together."""
    solves_per_s: float
    """Instants."""
    packets_per_s: float
    """Poses sent, per person."""
    late_share: float
    """Of instants that came after their time, or were left out because of it."""
    sources: tuple[SourceStatus, ...]
    latency: tuple[StageLatency, ...]
    streams: tuple[StreamStatus, ...]
    recording: RecordingStatus | None
    incidents: tuple[Incident, ...]
    """The latest, oldest first."""
    cpu_share: float
    """Of one core; 1.5 is one and a half cores. Like memory without the process of the streams."""
    memory_mb: float
