"""A recorded session to a take: sort, then solve.

The first pass sorts and solves every instant, each alone, and learns the bodies of people nobody
measured. The second solves each subject again from the keypoints it was assigned, with one body
throughout, from the instant it was first seen rather than the one it was confirmed at: as a live
run would, in a short window, and then in one so long that its poses are those of the whole take.

Interrupted (Ctrl-C), either pass ends at the instant it had reached and the take holds what was
solved.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fusecap.associate.sensor_vote import SensorVote
from fusecap.body.shape import BodyShape
from fusecap.checks import check_measurements
from fusecap.errors import SessionError
from fusecap.files import plain
from fusecap.findings import Finding
from fusecap.pipeline import Pipeline, make_estimator, observation_of, worn_sensors
from fusecap.progress import Progress
from fusecap.setup import Setup, setup_of
from fusecap.solve.estimator import Estimator
from fusecap.solve.reprojection import Reprojection
from fusecap.solve.whole_motion import AHEAD, PIECE, Settled, WholeMotion
from fusecap.solve.window_solver import Workspace
from fusecap.sources.session import Session
from fusecap.sources.session_data import SessionData
from fusecap.take import Take, TakeBuilder, provenance
from fusecap.types import (
    Detections,
    Estimate,
    ImuReading,
    Observation,
    Status,
    TrackState,
    TrackUpdate,
)

SEEDING_WINDOW = 4
"""Instants that the second pass starts from together: where no camera sees the subject, an instant
alone would stay where it is, and a long window would not find out that people walk."""


@runtime_checkable
class Instants(Protocol):
    """Recorded measurements on the solve's instants."""

    def __len__(self) -> int: ...

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        ...

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        ...


class SessionInstants:
    """The instants `first` to `end` (excluded) of an opened session; all of them unless told."""

    def __init__(self, data: SessionData, first: int = 0, end: int | None = None) -> None:
        self._data = data
        self._instants = range(len(data.times_s))[first:end]

    def __len__(self) -> int:
        return len(self._instants)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        return self._data.detections(self._instants[instant])

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        row = self._instants[instant]
        return {imus.subject: imus.reading(row) for imus in self._data.imus}


SMALL_M = 0.75
"""Simulated, of 0.6 m: followed 71 % of the time, measured 4.3 % off."""


@dataclass(frozen=True, kw_only=True)
class SolveReport:
    """What a solve can say about itself; `as_json` is the `--json` output."""

    instants: int
    duration_s: float
    cameras: int
    subjects: dict[str, dict[str, float]]
    """Per subject: tracked_share (of all instants), bone_sigma_deg, position_sigma_m, height_m."""
    reprojection_px: dict[str, dict[str, float]]
    """Per camera, in its own pixels: median, p90, and how many keypoints were used."""
    solve_ms_median: float
    solve_ms_p99: float
    solves: int
    statuses: dict[str, int]
    elapsed_s: float
    interrupted: bool
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Plain values; NaN becomes None."""
        return plain(asdict(self))


@dataclass(frozen=True, kw_only=True)
class Solved:
    """A take and how it came about."""

    take: Take
    report: SolveReport


def solve_session(
    data: SessionData, *, progress: Progress | None = None, anyway: bool = False
) -> Solved:
    """Solve an opened session; what is odd about it is in the report's notes.

    Raises `SessionError` for what is an error to doctor, unless `anyway`.
    """
    found = check_measurements(data.session, data.rig, data.keypoints, data.samples, data.times_s)
    if not anyway:
        refuse_errors(data.session, [*data.findings, *found])
    odd = [finding for finding in found.sorted() if finding.severity != "info"]
    return solve_instants(
        setup_of(data.session, data.rig, data.landmarks),
        SessionInstants(data),
        progress=progress,
        session_sha256=data.content_hash,
        notes=tuple(str(finding) for finding in (*data.findings, *odd)),
    )


def refuse_errors(session: Session, findings: Sequence[Finding]) -> None:
    """Raises `SessionError` with what is an error, if anything is."""
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        listed = "\n".join(f"{session.path}: {finding}" for finding in errors)
        raise SessionError(f"{listed}\nto solve it all the same: fusecap solve --anyway")


def solve_instants(
    setup: Setup,
    instants: Instants,
    *,
    progress: Progress | None = None,
    session_sha256: str | None = None,
    simulated: bool = False,
    notes: tuple[str, ...] = (),
) -> Solved:
    """Both passes over recorded instants."""
    started = time.perf_counter()
    pipeline = Pipeline(_with_window(setup, 1))
    vote = SensorVote(setup.landmarks, worn_sensors(setup))
    tracked = _first_pass(pipeline, instants, vote, setup.rate_hz, progress)
    reprojection = Reprojection(setup.rig, setup.landmarks)
    builder = TakeBuilder(
        skeleton=setup.skeleton,
        rate_hz=setup.rate_hz,
        subject_names=_in_order([model.name for model in setup.subjects], tracked.shapes),
        provenance=provenance(
            options={"solver": asdict(setup.options), "cameras": list(setup.rig.names)},
            session_sha256=session_sha256,
            simulated=simulated,
        ),
    )
    second = _SecondPass(setup, pipeline, tracked)
    solve_s, statuses = [], Counter()
    interrupted = tracked.interrupted

    def keep(finished: Iterator[_Instant]) -> None:
        for instant in finished:
            people = instant.people.values()
            builder.add(instant.timestamp_ns, [estimate for estimate, _ in people])
            for estimate, observation in people:
                reprojection.add(estimate, observation.keypoints)

    try:
        for instant, updates in enumerate(tracked.updates):
            detections = instants.detections(instant)
            for estimate in second.step(detections, instants.readings(instant), updates):
                solve_s.append(estimate.solve_s)
                statuses[estimate.status.name.lower()] += 1
            keep(second.finished())
            if progress:
                progress("solving", instant + 1, len(tracked.updates))
    except KeyboardInterrupt:
        interrupted = True
    keep(second.rest())
    take = builder.build()
    solve_ms = np.array(solve_s or [np.nan]) * 1e3
    return Solved(
        take=take,
        report=SolveReport(
            instants=len(take.timestamps_ns),
            duration_s=len(take.timestamps_ns) / setup.rate_hz,
            cameras=len(setup.rig),
            subjects=describe_subjects(take),
            reprojection_px=reprojection.summary(),
            solve_ms_median=float(np.median(solve_ms)),
            solve_ms_p99=float(np.percentile(solve_ms, 99)),
            solves=len(solve_s),
            statuses=dict(statuses),
            elapsed_s=time.perf_counter() - started,
            interrupted=interrupted,
            notes=(*notes, *tracked.notes, *_small_people(take)),
        ),
    )


def _small_people(take: Take) -> list[str]:
    return [
        f"{name}: {height_m:.2f} m tall; people under {SMALL_M} m are followed with gaps and "
        "measured up to 5 % off: state height_m, or check the calibration's scale"
        for name, height_m in zip(take.subject_names, take.heights_m, strict=True)
        if height_m < SMALL_M
    ]


def _with_window(setup: Setup, window: int) -> Setup:
    return replace(setup, options=replace(setup.options, window=window))


@dataclass(frozen=True, kw_only=True)
class _Tracked:
    """What the first pass leaves: per instant the updates of people who became subjects."""

    updates: list[list[TrackUpdate]]
    shapes: dict[str, BodyShape]
    interrupted: bool
    notes: tuple[str, ...]


def _in_order(named: list[str], found: Collection[str]) -> list[str]:
    """Named subjects as the session lists them, then person1, person2, ... person10."""
    return named + sorted(set(found) - set(named), key=lambda name: (len(name), name))


def _first_pass(
    pipeline: Pipeline,
    instants: Instants,
    vote: SensorVote,
    rate_hz: float,
    progress: Progress | None,
) -> _Tracked:
    updates: list[tuple[TrackUpdate, ...]] = []
    names: dict[int, str] = {}
    notes: list[str] = []
    moved: list[tuple[int, Mapping[str, str]]] = []
    interrupted = False
    try:
        for instant in range(len(instants)):
            step = pipeline.step(instants.detections(instant), instants.readings(instant))
            updates.append(step.updates)
            notes += [f"{instant / rate_hz:.2f} s: {note}" for note in step.notes]
            moved += [(instant, step.paired_anew)] if step.paired_anew else []
            for update in step.updates:
                if update.state is not TrackState.TENTATIVE:
                    names[update.track_id] = update.name
            if progress:
                progress("sorting", instant + 1, len(instants))
    except KeyboardInterrupt:
        interrupted = True
    named = [_named(some, names) for some in updates]
    for instant, former in moved:
        rename_before(named, instant, former, instants, vote)
    return _Tracked(
        updates=_without_tails(named, instants),
        shapes={name: pipeline.estimator(name).shape for name in set(names.values())},
        interrupted=interrupted,
        notes=tuple(notes),
    )


def rename_before(
    updates: list[list[TrackUpdate]],
    instant: int,
    former: Mapping[str, str],
    instants: Instants,
    vote: SensorVote,
) -> None:
    """Who turned out at an instant to be somebody else was so before: back to when it began.

    That is the instant from which the new names, until then, fit the sensors better by most.
    Nothing changes where one of them was a bystander, of whom no instant was kept.
    """
    if not all(former.values()):
        return
    gain = most = 0.0
    since = instant
    for row in range(instant - 1, -1, -1):
        readings = instants.readings(row)
        points = {update.name: update.landmarks_in_world_m for update in updates[row]}
        for name, before in former.items():
            if name in readings and name in points and before in points:
                both = np.stack([points[name], points[before]])
                away = vote.away(both, name, readings[name])
                if away is not None and np.isfinite(away).all():
                    gain += float(away[0] - away[1])
        if gain >= most:
            most, since = gain, row
    now = {before: name for name, before in former.items()}
    for row in range(since, instant):
        updates[row] = [replace(u, name=now.get(u.name, u.name)) for u in updates[row]]


def _without_tails(updates: list[list[TrackUpdate]], instants: Instants) -> list[list[TrackUpdate]]:
    """Nobody is followed after the last instant in which a camera or a sensor told of them.

    Between two such instants motion bridges a gap; after the last nothing says where they are.
    """
    kept: list[list[TrackUpdate]] = []
    going_on: set[str] = set()
    for instant in range(len(updates) - 1, -1, -1):
        readings = instants.readings(instant)
        measured = {
            update.name
            for update in updates[instant]
            if (update.person >= 0).any() or _tells(readings.get(update.name))
        }
        here = {update.name for update in updates[instant]}
        going_on = (going_on & here) | measured
        kept.append([update for update in updates[instant] if update.name in going_on])
    return kept[::-1]


def _tells(reading: ImuReading | None) -> bool:
    return reading is not None and bool(np.isfinite(reading.bone_rotation_in_world).any())


def _named(updates: tuple[TrackUpdate, ...], names: Mapping[int, str]) -> list[TrackUpdate]:
    """Updates of tracks that were confirmed sooner or later, under the subject's name."""
    taken: dict[str, TrackUpdate] = {}
    for update in updates:
        name = names.get(update.track_id)
        if name is None or (update.state is TrackState.TENTATIVE and name in taken):
            continue
        taken[name] = TrackUpdate(
            track_id=update.track_id,
            name=name,
            state=update.state,
            person=update.person,
            landmarks_in_world_m=update.landmarks_in_world_m,
        )
    return list(taken.values())


@dataclass(slots=True)
class _Instant:
    """One instant of the second pass, open while some motion may still change it."""

    timestamp_ns: int
    people: dict[str, tuple[Estimate, Observation]] = field(default_factory=dict)
    """Each estimate with what it was solved from."""
    held: int = 0
    """By how many motions."""


class _Motion:
    """One subject's part of the second pass."""

    def __init__(self, estimator: Estimator, workspace: Workspace) -> None:
        self._estimator = estimator
        self._motion = WholeMotion(estimator.solver, workspace)
        self._held: deque[_Instant] = deque()

    def take(self, instant: _Instant, estimate: Estimate, observation: Observation) -> None:
        """The subject's next instant."""
        self._held.append(instant)
        instant.held += 1
        self._settle(self._motion.push(observation, estimate.theta))

    def end_before(self, timestamp_ns: int) -> None:
        """End a motion that an instant does not go on."""
        if self._held and not self._motion.goes_on(timestamp_ns):
            self.end()

    def end(self) -> None:
        """What is held gets its last poses."""
        self._settle(self._motion.end())

    def _settle(self, settled: list[Settled]) -> None:
        name = self._estimator.model.name
        for theta, sigmas in settled:
            instant = self._held.popleft()
            estimate, observation = instant.people[name]
            position, rotation = self._estimator.solver.posed(theta)
            last = replace(
                estimate,
                theta=theta,
                bone_position_in_world_m=position,
                bone_rotation_in_world=rotation,
                bone_sigma_deg=sigmas.bone_deg,
                position_sigma_m=sigmas.position_m,
            )
            instant.people[name] = (last, observation)
            instant.held -= 1


class _SecondPass:
    """Solves people from assignments that stand, each in a window of many instants."""

    def __init__(self, setup: Setup, pipeline: Pipeline, tracked: _Tracked) -> None:
        self._landmark_count = len(setup.landmarks.landmark_names)
        self._open: deque[_Instant] = deque()
        self._estimators: dict[str, Estimator] = {}
        self._motions: dict[str, _Motion] = {}
        seeding = _with_window(setup, min(setup.options.window, SEEDING_WINDOW))
        workspace = Workspace(setup.skeleton, PIECE + AHEAD) if setup.options.together else None
        for name, shape in tracked.shapes.items():
            estimator = self._estimators[name] = make_estimator(seeding, pipeline.model(name))
            estimator.set_shape(shape)
            if workspace is not None:
                self._motions[name] = _Motion(estimator, workspace)

    def step(
        self,
        detections: Detections,
        readings: Mapping[str, ImuReading],
        updates: Sequence[TrackUpdate],
    ) -> list[Estimate]:
        """One instant, every subject alone; see `finished`."""
        instant = _Instant(detections.timestamp_ns)
        for motion in self._motions.values():
            motion.end_before(instant.timestamp_ns)
        for update in updates:
            name = update.name
            observation = observation_of(
                update, detections, self._landmark_count, readings.get(name)
            )
            estimate = self._estimators[name].follow(
                update.track_id, observation, update.landmarks_in_world_m
            )
            if estimate is None:
                continue
            instant.people[name] = (estimate, observation)
            if name in self._motions and estimate.status is not Status.DIVERGED:
                self._motions[name].take(instant, estimate, observation)
        self._open.append(instant)
        return [estimate for estimate, _ in instant.people.values()]

    def finished(self) -> Iterator[_Instant]:
        """Instants whose poses are their last ones, in order."""
        while self._open and not self._open[0].held:
            yield self._open.popleft()

    def rest(self) -> Iterator[_Instant]:
        """All that are still open, once nothing more comes."""
        for motion in self._motions.values():
            motion.end()
        yield from self.finished()


def describe_subjects(take: Take) -> dict[str, dict[str, float]]:
    """As `SolveReport.subjects`."""
    return {name: _describe(take, s) for s, name in enumerate(take.subject_names)}


def _describe(take: Take, subject: int) -> dict[str, float]:
    tracked = take.tracked[subject]
    turn, place = take.bone_sigma_deg[subject, tracked], take.position_sigma_m[subject, tracked]
    return {
        "tracked_share": float(tracked.mean()) if tracked.size else 0.0,
        "bone_sigma_deg": float(np.median(turn)) if turn.size else float("nan"),
        "position_sigma_m": float(np.median(place)) if place.size else float("nan"),
        "height_m": float(take.heights_m[subject]),
    }
