"""What a live run's recording holds: how long, of whom, how steady, and whether it is whole."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fusecap.batch.replay import recorded_setup
from fusecap.checks import check_samples
from fusecap.findings import Finding, Findings
from fusecap.progress import Progress
from fusecap.recording.reader import RecordedEvent, RecordedPose, Recording
from fusecap.types import CameraSample, ImuSample, Tick

GAP_S = 0.2
"""A source that is silent for so long is worth a word."""


def diagnose_recording(path: Path | str, progress: Progress | None = None) -> list[Finding]:
    """What is in a recording, and what is not; raises `InputError` for another file."""
    recording = Recording(path)
    setup = recorded_setup(recording)
    cameras = {name: array("q") for name in setup.rig.names}
    sensors = {
        subject.name: {imu.bone: array("q") for imu in subject.imus}
        for subject in setup.session.subjects
        if subject.imus
    }
    ticks_ns: list[int] = []
    poses: dict[str, int] = {}
    commands = 0

    def samples() -> Iterator[CameraSample | ImuSample]:
        nonlocal commands
        for item in recording.items(progress):
            match item:
                case RecordedEvent(event=CameraSample() as sample):
                    cameras[setup.rig.names[sample.camera]].append(sample.timestamp_ns)
                    yield sample
                case RecordedEvent(event=ImuSample() as sample):
                    sensors[sample.subject][sample.bone].append(sample.timestamp_ns)
                    yield sample
                case RecordedEvent(event=Tick() as tick):
                    ticks_ns.extend([] if tick.ahead else [tick.timestamp_ns])
                case RecordedEvent():
                    commands += 1
                case RecordedPose():
                    poses[item.name] = poses.get(item.name, 0) + 1

    findings, checked = Findings(), check_samples(setup, samples())
    _whole(recording, findings)
    _contents(recording, ticks_ns, poses, commands, findings)
    for name, times_ns in cameras.items():
        _source(f"camera '{name}'", times_ns, findings)
    for subject, bones in sensors.items():
        for bone, times_ns in bones.items():
            _source(f"imu '{bone}' of '{subject}'", times_ns, findings)
    findings += checked
    return findings.sorted()


def _whole(recording: Recording, findings: Findings) -> None:
    loss, where = recording.loss, recording.path.name
    if not loss.finished:
        findings.add(
            "warning",
            where,
            f"was cut off: {loss.unread_bytes} bytes after the last whole record are lost",
            "what came before is read as usual",
        )
    if loss.note:
        findings.add("warning", where, f"ended before it was asked to: {loss.note}")
    if loss.damaged:
        findings.add(
            "warning",
            where,
            f"is damaged: {loss.missing_events} events missing, {loss.broken_chunks} broken "
            f"chunks, {loss.malformed} broken messages",
            "fusecap solve reads the rest; --as-live gives other poses after the damage",
        )
    if not recording.from_start:
        findings.add(
            "info",
            where,
            "was begun in mid-run",
            "fusecap solve takes it as it is; --as-live cannot give the very poses of the run",
        )


def _contents(
    recording: Recording,
    ticks_ns: list[int],
    poses: dict[str, int],
    commands: int,
    findings: Findings,
) -> None:
    where = recording.path.name
    if not ticks_ns:
        findings.add("error", where, "holds no solved instant", "there is nothing to solve again")
        return
    whom = ", ".join(f"'{name}' {count}" for name, count in poses.items()) or "of nobody"
    findings.add(
        "info",
        where,
        f"{_span_s(ticks_ns):.2f} s, {len(ticks_ns)} instants, poses {whom}, {commands} commands; "
        f"made by {recording.made_by}",
    )


def _source(where: str, times_ns: array[int], findings: Findings) -> None:
    if len(times_ns) < 2:
        findings.add("warning", where, f"{len(times_ns)} samples", "see whether it was connected")
        return
    intervals_s = np.diff(np.sort(np.array(times_ns, dtype=np.int64))) * 1e-9
    gaps = intervals_s[intervals_s > GAP_S]
    found = f"{len(times_ns)} samples, {1.0 / max(np.median(intervals_s), 1e-9):.1f} per second"
    if len(gaps):
        found += f", {len(gaps)} gaps over {GAP_S:g} s, the longest {gaps.max():.2f} s"
    findings.add("warning" if len(gaps) else "info", where, found)


def _span_s(times_ns: list[int]) -> float:
    return (max(times_ns) - min(times_ns)) * 1e-9
