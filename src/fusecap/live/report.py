"""What a live run did, as a whole."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from fusecap.files import plain
from fusecap.live.feed import FeedReport
from fusecap.live.solving import PersonTally
from fusecap.live.status import (
    Incident,
    RecordingStatus,
    SourceStatus,
    StageLatency,
)
from fusecap.streams.output import StreamStatus


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectReport:
    """One person over a run."""

    tracked_share: float
    """Of instants: with a pose to send."""
    measured_share: float
    """Of instants: with a pose that something measured."""
    bone_sigma_deg: float
    """Expected error of bones' rotations: mean over instants with a pose of the median bone."""
    position_sigma_m: float
    """The same of joints' places."""
    found_anew: int
    """How often a pose that did not fit was replaced."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveReport:
    """A run from start to end."""

    simulated: bool
    elapsed_s: float
    rate_hz: float
    """That was asked for."""
    delay_s: float
    eager: bool
    poses: str
    """Which were sent: solved, ahead of pictures, or settled."""
    instants: int
    """Solved."""
    skipped: int
    """Left out because the solver was behind."""
    late_share: float
    """Of instants: solved more than half a period after they were due, or skipped."""
    complete_share: float
    """Of instants for which some camera looked: every one that did had samples on both sides; 0
    without any."""
    solves_per_s: float
    detections: int
    """Rounds of the detector, or frames of keypoints from outside, all cameras together."""
    detections_per_s: float
    detector_failures: int
    packets_per_s: float
    """Instants sent per second, per person: the mean of the streams."""
    events_dropped: int
    """Samples that came and that the solver did not get to."""
    latency: tuple[StageLatency, ...]
    subjects: Mapping[str, SubjectReport]
    inputs: tuple[SourceStatus, ...]
    """Cameras and sensors, as they were at the end."""
    sources: tuple[FeedReport, ...]
    streams: tuple[StreamStatus, ...]
    recordings: tuple[RecordingStatus, ...]
    incidents: tuple[Incident, ...]
    """The first and the last, oldest first."""
    incident_count: int
    cpu_share: float
    """Of one core, over the run; the process that sends streams included."""
    memory_mb: float
    """Resident, at the end; without that process."""
    memory_peak_mb: float
    threads_left: tuple[str, ...]
    """That had not ended two seconds after they were asked to."""

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is not finite becomes None."""
        return {"cores": os.cpu_count(), **plain(asdict(self))}


def subject_reports(people: Mapping[str, PersonTally], instants: int) -> dict[str, SubjectReport]:
    """Shares of all instants that were solved."""
    return {
        name: SubjectReport(
            tracked_share=tally.instants / max(instants, 1),
            measured_share=tally.measured / max(instants, 1),
            bone_sigma_deg=tally.bone_sigma_deg / max(tally.instants, 1),
            position_sigma_m=tally.position_sigma_m / max(tally.instants, 1),
            found_anew=tally.found_anew,
        )
        for name, tally in people.items()
    }
