"""A recorded run once more, as it went: the same events in the same order, to the same poses.

The engine knows no clock, so what it makes of the events is what it made of them in the run, bit
for bit, on the same kind of machine with the same version. `Replay` compares.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from fusecap.batch.solve import Solved, SolveReport, SubjectSums
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.engine.engine import Engine, LiveStep
from fusecap.errors import InputError
from fusecap.interrupts import ctrl_c_held
from fusecap.progress import Progress
from fusecap.recording.index import RecordingIndex
from fusecap.recording.layout import SUFFIX
from fusecap.recording.reader import RecordedEvent, RecordedPose, Recording
from fusecap.recording.setup_json import setup_from_values
from fusecap.setup import SessionSetup
from fusecap.stored_take import StoredTake
from fusecap.take import BLOCK, Take, provenance, save_blocks, take_from_theta
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

    def steps(
        self, progress: Progress | None = None, last: int | None = None
    ) -> Iterator[LiveStep]:
        """Every solved instant; once. Nothing after the event of number `last`."""
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
                if item.number == last:
                    return
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
            recording=recording.path.name,
            simulated=again.setup.simulated,
        ),
    )
    solve_s: list[float] = []
    statuses, found_anew = Counter(), Counter()
    interrupted = False
    with ctrl_c_held() as stop:
        for step in again.steps(progress):
            if stop.asked:
                interrupted = True
                break
            people = [one for one in step.people.values() if one is not None]
            builder.add(step.timestamp_ns, people)
            for one in people:
                subjects.add(one)
            found_anew.update(step.found_anew)
            for estimate in step.step.estimates:
                solve_s.append(estimate.solve_s)
                statuses[estimate.status.name.lower()] += 1
    solve_ms = np.array(solve_s or [np.nan]) * 1e3
    report = SolveReport(
        instants=len(builder),
        duration_s=len(builder) / session.settings.rate_hz,
        cameras=len(again.setup.rig),
        subjects=subjects.as_report(len(builder), found_anew),
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


class RecordedMotion:
    """The poses of a run as they were sent, read from its recording as they are asked for.

    A body that changed in the run has its last shape throughout. Raises `InputError` without any.
    """

    def __init__(self, recording: Recording, index: RecordingIndex) -> None:
        self._index = index
        self._setup = recorded_setup(recording)
        session = self._setup.session
        names = [subject.name for subject in session.subjects]
        names += [name for name in index.poses if name not in names]
        self.subject_names = tuple(names)
        known = {name: np.array(index.poses[name].times_ns) for name in index.poses}
        times_ns = np.unique(np.concatenate([*known.values(), np.empty(0, np.int64)]))
        if len(times_ns) == 0:
            raise InputError(f"{recording.path} holds no pose; solve it with: fusecap solve")
        self.timestamps_ns: Int[np.ndarray, " t"] = times_ns
        self._rows = np.full((len(names), len(times_ns)), -1, dtype=np.int32)
        """Of each person's poses, the one at each instant; -1: none."""
        for name, times in known.items():
            self._rows[names.index(name), np.searchsorted(times_ns, times)] = np.arange(len(times))
        reference = BodyShape.from_height(session.skeleton, REFERENCE_HEIGHT_M)
        self._shapes = [index.bodies.get(name, reference) for name in names]

    def save(self, path: Path) -> None:
        """All of it as a take's file; raises `TakeError`."""
        count = len(self.timestamps_ns)
        blocks = (np.arange(at, min(at + BLOCK, count)) for at in range(0, count, BLOCK))
        save_blocks(self.at_frames([]), map(self.at_frames, blocks), path)

    @property
    def tracked(self) -> Bool[np.ndarray, "s t"]:
        """Whose pose was sent; a diverged one is found when it is read."""
        return np.asarray(self._rows >= 0)

    @property
    def time_s(self) -> Float[np.ndarray, " t"]:
        """Seconds since the first frame."""
        return (self.timestamps_ns - self.timestamps_ns[:1]) * 1e-9

    @property
    def heights_m(self) -> Float[np.ndarray, " s"]:
        """Statures."""
        return np.array([shape.height_m for shape in self._shapes])

    @property
    def skeleton(self) -> Skeleton:
        """Everybody's."""
        return self._setup.session.skeleton

    @property
    def provenance(self) -> dict[str, Any]:
        """What made the poses."""
        return provenance(
            options={"recorded": True, "cameras": list(self._setup.rig.names)},
            simulated=self._setup.simulated,
        )

    def shape(self, subject: int) -> BodyShape:
        """The body of one subject."""
        return self._shapes[subject]

    def at_frames(self, frames: Sequence[int] | Int[np.ndarray, " n"]) -> Take:
        """These frames alone, which rise."""
        frames = np.asarray(frames, dtype=np.int64)
        people, count = len(self.subject_names), len(frames)
        theta = np.full((people, count, self.skeleton.pose_size), np.nan)
        turn, place = np.full((2, people, count, self.skeleton.bone_count), np.nan)
        measured = np.zeros((people, count), dtype=bool)
        for at, frame in enumerate(frames):
            for subject, name in enumerate(self.subject_names):
                row = int(self._rows[subject, frame])
                pose = self._index.read(self._index.poses[name], row) if row >= 0 else None
                if isinstance(pose, RecordedPose) and not pose.diverged:
                    theta[subject, at] = pose.theta
                    turn[subject, at] = pose.bone_sigma_deg
                    measured[subject, at] = pose.measured
                    place[subject, at] = pose.position_sigma_m
        return take_from_theta(
            theta,
            self._shapes,
            timestamps_ns=self.timestamps_ns[frames],
            rate_hz=self._setup.session.settings.rate_hz,
            subject_names=self.subject_names,
            skeleton=self.skeleton,
            tracked=np.asarray(np.isfinite(theta).all(axis=2)),
            measured=measured,
            bone_sigma_deg=turn,
            position_sigma_m=place,
            provenance=self.provenance,
        )


@contextmanager
def opened_take(
    path: Path, tell: Callable[[str], None], progress: Progress | None = None
) -> Iterator[StoredTake]:
    """A take, which is checked and stays in its file, or the poses of a recording as sent.

    Those become a file that lasts as long as this; `tell` is told what of them is not there.
    """
    if path.suffix == SUFFIX:
        recording = Recording(path)
        motion = RecordedMotion(recording, RecordingIndex(recording, progress=progress))
        with TemporaryDirectory(prefix="fusecap-") as folder:
            copy = Path(folder) / "poses.npz"
            motion.save(copy)
            for text in loss_notes(recording):
                tell(text)
            with StoredTake(copy) as take:
                yield take
    else:
        with StoredTake(path) as take:
            take.check()
            yield take


def loss_notes(recording: Recording) -> tuple[str, ...]:
    """What a user should know about a recording that has been read to its end."""
    loss = recording.loss
    notes = []
    if not recording.from_start:
        notes.append("it was begun in mid-run: what the run knew before is not in it")
    if loss.damaged:
        notes.append(
            f"it is damaged: {loss.missing_events} events are missing ({loss.broken_chunks} broken "
            f"chunks, {loss.malformed} broken messages): poses after them can differ from those of "
            "the run, and are missing where they were sent"
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
