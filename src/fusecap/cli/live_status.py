"""What `fusecap live` shows: a line per second, and a table at the end."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import TYPE_CHECKING

from fusecap.cli.terminal import console, err, note, one_line, styled, table_of

if TYPE_CHECKING:
    from fusecap.engine.engine import LiveStep
    from fusecap.live.report import LiveReport
    from fusecap.live.run import LiveRun
    from fusecap.live.status import LiveStatus, SourceStatus, StageLatency
    from fusecap.types import CameraImage, Event

_INCIDENTS = 30
"""Shown at the end."""
_SIGNS = {"fresh": "●", "late": "◐", "lost": "○", "waiting": "·"}
_COLOURS = {"fresh": "green", "late": "yellow", "lost": "red", "waiting": "dim"}


class LiveLine:
    """A `Listener` that shows the status on stderr: overwritten on a terminal, else a line each."""

    def __init__(self, run: LiveRun, *, quiet: bool) -> None:
        self._quiet = quiet
        self._told = 0.0
        self._live = None
        self._run = run
        if not quiet and err.is_terminal:
            self._live = one_line()

    def __enter__(self) -> LiveLine:
        if not self._quiet:
            self._run.add_listener(self)
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """Not shown."""

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """Not shown."""

    def on_image(self, image: CameraImage) -> None:
        """Not shown."""

    def on_status(self, status: LiveStatus) -> None:
        """Show it, and what has happened since the last one."""
        for incident in status.incidents:
            if incident.time_s > self._told:
                self._told = incident.time_s
                err.print(f"{incident.time_s:7.1f} s  {incident.what}", soft_wrap=True)
        if self._live is None:
            err.print(status_line(status), soft_wrap=True)
        else:
            text = styled(status_line(status), "\n", *_lights(status.sources))
            self._live.update(text, refresh=True)

    def close(self) -> None:
        """The table at the end says the rest."""


def status_line(status: LiveStatus) -> str:
    """Rates, latency, losses and load."""
    packet = _stage(status.latency, "exposure to packet") or _stage(
        status.latency, "exposure to pose"
    )
    parts = [
        f"{status.elapsed_s:6.0f} s",
        f"{status.detections_per_s:.0f} detections/s",
        f"{status.solves_per_s:.1f} solves/s",
    ]
    if status.streams:
        parts.append(f"{status.packets_per_s:.1f} packets/s")
    if packet is not None:
        parts.append(f"{packet.stage} {packet.p95_ms:.0f} ms p95")
    if status.late_share > 0:
        parts.append(f"{100 * status.late_share:.0f} % late")
    lights = [source.light.value for source in status.sources]
    counts = {light: lights.count(light) for light in _SIGNS if light in lights}
    parts.append("sources: " + ", ".join(f"{count} {light}" for light, count in counts.items()))
    if status.recording is not None:
        recording = status.recording
        parts.append(
            "recording has ended" if recording.problem else f"recorded {recording.megabytes:.1f} MB"
        )
    parts.append(f"{100 * status.cpu_share:.0f} % CPU, {status.memory_mb:.0f} MB")
    return "  ".join(parts)


def _lights(sources: Sequence[SourceStatus]) -> list[str | tuple[str, str]]:
    """Cameras one by one, sensors by subject; a sign as well as a colour."""
    groups: dict[str, list[SourceStatus]] = {}
    for source in sources:
        name = source.name if source.kind == "camera" else source.name.partition("/")[0]
        groups.setdefault(name, []).append(source)
    shown: list[str | tuple[str, str]] = []
    for name, members in groups.items():
        shown.append(f"{'  ' if shown else ''}{name} ")
        shown += [(_SIGNS[one.light.value], _COLOURS[one.light.value]) for one in members]
    return shown


def _stage(latency: Sequence[StageLatency], name: str) -> StageLatency | None:
    return next((stage for stage in latency if stage.stage == name), None)


def print_report(report: LiveReport) -> None:
    """Rates, people, latency, streams, and where files lie."""
    simulated = ("simulated ", "bold") if report.simulated else ""
    text = (
        f"{report.elapsed_s:.1f} s: {report.instants} instants solved "
        f"({report.solves_per_s:.2f}/s), {report.skipped} left out, "
        f"{100 * report.complete_share:.1f} % with samples of every camera on both sides; "
        f"{report.detections_per_s:.1f} detections/s; "
        f"{100 * report.cpu_share:.0f} % CPU, {report.memory_peak_mb:.0f} MB"
    )
    console.print(styled(simulated, text), soft_wrap=True)
    people = table_of("person", "tracked", "measured", "bones +- deg", "joints +- mm")
    for name, subject in report.subjects.items():
        people.add_row(
            name,
            f"{100 * subject.tracked_share:.1f} %",
            f"{100 * subject.measured_share:.1f} %",
            f"{subject.bone_sigma_deg:.1f}",
            f"{1e3 * subject.position_sigma_m:.0f}",
        )
    if report.subjects:
        console.print(people)
    latency = table_of("latency", "p50 ms", "p95 ms", "p99 ms", "count")
    for stage in report.latency:
        latency.add_row(
            stage.stage,
            f"{stage.p50_ms:.1f}",
            f"{stage.p95_ms:.1f}",
            f"{stage.p99_ms:.1f}",
            str(stage.count),
        )
    for column in latency.columns[1:]:
        column.justify = "right"
    if report.latency:
        console.print(latency)
    streams = table_of("to", "packets sent", "dropped", "refused", "failed")
    for stream in report.streams:
        streams.add_row(
            stream.to,
            str(stream.sent),
            str(stream.dropped),
            str(stream.refused),
            str(stream.failed),
        )
    if report.streams:
        console.print(streams)
    for stream in report.streams:
        if stream.remark:
            note(f"{stream.to}: {stream.remark}")
    for source in report.sources:
        lost = source.malformed + source.oversize
        if source.restarts or lost or source.note:
            note(
                f"{source.source}: opened again {source.restarts} times, {lost} packets refused"
                + (f"; {source.note}" if source.note else "")
            )
    for incident in report.incidents[:_INCIDENTS]:
        console.print(f"{incident.time_s:7.1f} s  {incident.what}", soft_wrap=True)
    if report.incident_count > _INCIDENTS:
        console.print(f"and {report.incident_count - _INCIDENTS} more incidents; --json holds more")
    for recording in report.recordings:
        console.print(
            f"wrote {recording.path} ({recording.megabytes:.1f} MB, {recording.seconds:.0f} s)",
            soft_wrap=True,
        )
        if recording.problem:
            note(f"{recording.path}: {recording.problem}")
