"""A recorded run once more, as it went: the same events in the same order, to the same poses.

The engine knows no clock, so what it makes of the events is what it made of them in the run, bit
for bit, on the same kind of machine with the same version. `Replay` compares.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fusecap.batch.solve import Solved, SolveReport, SubjectSums
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.engine.engine import Engine, LiveStep
from fusecap.errors import InputError
from fusecap.progress import Progress
from fusecap.recording.layout import SUFFIX, RecordedBody
from fusecap.recording.reader import RecordedEvent, RecordedPose, Recording
from fusecap.recording.setup_json import setup_from_values
from fusecap.setup import SessionSetup
from fusecap.stored_take import load_take
from fusecap.take import Take, provenance, take_from_theta
from fusecap.take_builder import TakeBuilder
from fusecap.types import Estimate


def recorded_setup(recording: Recording) -> SessionSetup:
    """What the run knew before its first event; raises `InputError`."""
    return setup_from_values(recording.setup, recording.path)


class Replay:
    """The events of a recording through an engine of its own."""

    def __init__(self, recording: Recording) -> None:
        self.setup = recorded_setup(recording)
        self.engine = Engine(self.setup)
        self.poses = 0
        """That were recorded and belong to an instant of this replay."""
        self.equal = 0
        """Of these, the ones that are the same here, to the last bit."""
        self.failures = 0
        """Events that the engine refused with an error; it did so in the run as well."""
        self._recording = recording

    def steps(self, progress: Progress | None = None) -> Iterator[LiveStep]:
        """Every solved instant; once."""
        number, people = 0, {}
        for item in self._recording.items(progress):
            if isinstance(item, RecordedEvent):
                step = None
                try:
                    step = self.engine.take(item.event)
                except Exception:  # as in the run, where one bad event does not end it
                    self.failures += 1
                if step is not None:
                    number, people = item.number, step.people
                    yield step
            elif isinstance(item, RecordedPose) and item.number == number:
                self.poses += 1
                self.equal += _same(item, people.get(item.name))

    def note(self) -> str:
        """How the poses compare with those of the run."""
        return f"{self.equal} of {self.poses} poses are equal to those recorded, bit for bit"


def replay(recording: Recording, progress: Progress | None = None) -> Iterator[LiveStep]:
    """Every solved instant of the run once more."""
    return Replay(recording).steps(progress)


def solve_as_live(recording: Recording, progress: Progress | None = None) -> tuple[Solved, Replay]:
    """The replay as a take, people as they were sent: held and blended poses are in it."""
    started = time.perf_counter()
    again = Replay(recording)
    session = again.setup.session
    names = [subject.name for subject in session.subjects]
    subjects = SubjectSums(names)
    builder = TakeBuilder(
        skeleton=session.skeleton,
        rate_hz=session.settings.rate_hz,
        subject_names=names,
        provenance=provenance(
            options={"as_live": True, "cameras": list(again.setup.rig.names)},
            session_sha256=recording.sha256(),
            simulated=again.setup.simulated,
        ),
    )
    solve_s: list[float] = []
    statuses = Counter()
    interrupted = False
    try:
        for step in again.steps(progress):
            people = [one for one in step.people.values() if one is not None]
            builder.add(step.timestamp_ns, people)
            for one in people:
                subjects.add(one)
            for estimate in step.step.estimates:
                solve_s.append(estimate.solve_s)
                statuses[estimate.status.name.lower()] += 1
    except KeyboardInterrupt:
        interrupted = True
    solve_ms = np.array(solve_s or [np.nan]) * 1e3
    report = SolveReport(
        instants=len(builder),
        duration_s=len(builder) / session.settings.rate_hz,
        cameras=len(again.setup.rig),
        subjects=subjects.as_report(len(builder)),
        reprojection_px={},
        solve_ms_median=float(np.median(solve_ms)),
        solve_ms_p99=float(np.percentile(solve_ms, 99)),
        solves=len(solve_s),
        statuses=dict(statuses),
        elapsed_s=time.perf_counter() - started,
        interrupted=interrupted,
        notes=(*loss_notes(recording), again.note()),
    )
    return Solved(builder=builder, report=report), again


def recorded_take(recording: Recording, progress: Progress | None = None) -> Take:
    """The poses as they were recorded, without solving again; raises `InputError` without any.

    A body that changed in the run has its last shape throughout.
    """
    setup = recorded_setup(recording)
    session = setup.session
    times_ns: list[int] = []
    rows: dict[str, list[tuple[int, RecordedPose]]] = {s.name: [] for s in session.subjects}
    shapes: dict[str, BodyShape] = {}
    for item in recording.items(progress):
        if isinstance(item, RecordedBody):
            shapes[item.name] = item.shape
        elif isinstance(item, RecordedPose):
            if times_ns and item.timestamp_ns < times_ns[-1]:
                continue
            if not times_ns or item.timestamp_ns > times_ns[-1]:
                times_ns.append(item.timestamp_ns)
            if not item.diverged:
                rows.setdefault(item.name, []).append((len(times_ns) - 1, item))
    if not times_ns:
        raise InputError(f"{recording.path} holds no pose; solve it with: fusecap solve")
    skeleton = session.skeleton
    reference = BodyShape.from_height(skeleton, REFERENCE_HEIGHT_M)
    theta = np.full((len(rows), len(times_ns), skeleton.pose_size), np.nan)
    turn, place = np.full((2, len(rows), len(times_ns), skeleton.bone_count), np.nan)
    for subject, poses in enumerate(rows.values()):
        for row, pose in poses:
            theta[subject, row] = pose.theta
            turn[subject, row] = pose.bone_sigma_deg
            place[subject, row] = pose.position_sigma_m
    return take_from_theta(
        theta,
        [shapes.get(name, reference) for name in rows],
        timestamps_ns=np.array(times_ns, dtype=np.int64),
        rate_hz=session.settings.rate_hz,
        subject_names=tuple(rows),
        skeleton=skeleton,
        tracked=np.asarray(np.isfinite(theta).all(axis=2)),
        bone_sigma_deg=turn,
        position_sigma_m=place,
        provenance=provenance(
            options={"recorded": True, "cameras": list(setup.rig.names)},
            simulated=setup.simulated,
        ),
    )


def open_take(path: Path, progress: Progress | None = None) -> Take:
    """A solved take (.npz), or the poses of a live run as they were recorded (.mcap)."""
    return recorded_take(Recording(path), progress) if path.suffix == SUFFIX else load_take(path)


def loss_notes(recording: Recording) -> tuple[str, ...]:
    """What a user should know about a recording that has been read to its end."""
    loss = recording.loss
    notes = []
    if not recording.from_start:
        notes.append("it was begun in mid-run: what the run knew before is not in it")
    if loss.missing_events:
        notes.append(
            f"{loss.missing_events} events are missing ({loss.broken_chunks} broken chunks, "
            f"{loss.malformed} broken messages): poses after them can differ from those of the run"
        )
    if loss.note:
        notes.append(f"it ended early: {loss.note}")
    elif not loss.finished:
        notes.append(
            f"it was cut off: {loss.unread_bytes} bytes after the last whole record are lost"
        )
    return tuple(notes)


def _same(recorded: RecordedPose, estimate: Estimate | None) -> bool:
    return (
        estimate is not None
        and recorded.timestamp_ns == estimate.timestamp_ns
        and recorded.theta.tobytes() == estimate.theta.tobytes()
        and recorded.bone_sigma_deg.tobytes() == estimate.bone_sigma_deg.tobytes()
        and recorded.position_sigma_m.tobytes() == estimate.position_sigma_m.tobytes()
    )
