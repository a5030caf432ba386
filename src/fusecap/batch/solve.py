"""A recorded session to a take: sort, solve, then smooth.

The first pass sorts and solves every instant as a live run would, and learns the bodies of people
nobody measured. The second solves each subject again from the keypoints it was assigned, with one
body throughout, and from the instant it was first seen rather than the one it was confirmed at.
Then all instants of a subject are solved together (`fusecap.solve.window_solver`), which makes a
motion of poses; with no term between instants in the weights that is left out.

Interrupted (Ctrl-C), either pass ends at the instant it had reached and the take holds what was
solved.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape
from fusecap.files import plain
from fusecap.pipeline import Pipeline, observation_of
from fusecap.progress import Progress
from fusecap.setup import Setup, setup_of
from fusecap.solve.reprojection import Reprojection
from fusecap.solve.window_solver import WindowSolver
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


@dataclass(frozen=True, kw_only=True)
class SolveReport:
    """What a solve can say about itself; `as_json` is the `--json` output."""

    instants: int
    duration_s: float
    cameras: int
    subjects: dict[str, dict[str, float]]
    """Per subject: tracked_share (of all instants), mean_quality (0-1), height_m."""
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


def solve_session(data: SessionData, *, progress: Progress | None = None) -> Solved:
    """Solve an opened session; raises `SessionError` where nothing can be solved."""
    return solve_instants(
        setup_of(data.session, data.rig, data.landmarks),
        SessionInstants(data),
        progress=progress,
        session_sha256=data.content_hash,
        notes=tuple(str(finding) for finding in data.findings),
    )


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
    pipeline = Pipeline(setup)
    tracked = _first_pass(pipeline, instants, progress)
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
    times_ns: list[int] = []
    solve_s, statuses = [], Counter()
    interrupted = tracked.interrupted
    try:
        for instant, updates in enumerate(tracked.updates):
            detections = instants.detections(instant)
            times_ns.append(detections.timestamp_ns)
            for estimate in second.step(detections, instants.readings(instant), updates):
                solve_s.append(estimate.solve_s)
                statuses[estimate.status.name.lower()] += 1
            if progress:
                progress("solving", instant + 1, len(tracked.updates))
        if setup.options.weights.between_instants:
            second.smooth(progress)
    except KeyboardInterrupt:
        interrupted = True
    for timestamp_ns in times_ns:
        estimates = second.solved.get(timestamp_ns, [])
        builder.add(timestamp_ns, [estimate for estimate, _ in estimates])
        for estimate, observation in estimates:
            reprojection.add(estimate, observation.keypoints)
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
            notes=notes,
        ),
    )


@dataclass(frozen=True, kw_only=True)
class _Tracked:
    """What the first pass leaves: per instant the updates of people who became subjects."""

    updates: list[list[TrackUpdate]]
    shapes: dict[str, BodyShape]
    interrupted: bool


def _in_order(named: list[str], found: Collection[str]) -> list[str]:
    """Named subjects as the session lists them, then person1, person2, ... person10."""
    return named + sorted(set(found) - set(named), key=lambda name: (len(name), name))


def _first_pass(pipeline: Pipeline, instants: Instants, progress: Progress | None) -> _Tracked:
    updates: list[tuple[TrackUpdate, ...]] = []
    names: dict[int, str] = {}
    interrupted = False
    try:
        for instant in range(len(instants)):
            step = pipeline.step(instants.detections(instant), instants.readings(instant))
            updates.append(step.updates)
            for update in step.updates:
                if update.state is not TrackState.TENTATIVE:
                    names[update.track_id] = update.name
            if progress:
                progress("sorting", instant + 1, len(instants))
    except KeyboardInterrupt:
        interrupted = True
    return _Tracked(
        updates=[_named(some, names) for some in updates],
        shapes={name: pipeline.estimator(name).shape for name in set(names.values())},
        interrupted=interrupted,
    )


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


class _SecondPass:
    """Solves people from assignments that stand, then each one's instants together."""

    def __init__(self, setup: Setup, pipeline: Pipeline, tracked: _Tracked) -> None:
        self.solved: dict[int, list[tuple[Estimate, Observation]]] = {}
        """By timestamp, each estimate with what it was solved from."""
        self._landmark_count = len(setup.landmarks.landmark_names)
        self._estimators = {}
        for name, shape in tracked.shapes.items():
            estimator = pipeline.make_estimator(pipeline.model(name))
            estimator.set_shape(shape)
            self._estimators[name] = estimator

    def step(
        self,
        detections: Detections,
        readings: Mapping[str, ImuReading],
        updates: Sequence[TrackUpdate],
    ) -> list[Estimate]:
        """One instant, every subject alone."""
        solved = []
        for update in updates:
            observation = observation_of(
                update, detections, self._landmark_count, readings.get(update.name)
            )
            estimate = self._estimators[update.name].follow(
                update.track_id, observation, update.landmarks_in_world_m
            )
            if estimate is not None:
                solved.append((estimate, observation))
        self.solved[detections.timestamp_ns] = solved
        return [estimate for estimate, _ in solved]

    def smooth(self, progress: Progress | None) -> None:
        """Replace the poses by those of the motion that they belong to; one subject at a time."""
        for done, (name, estimator) in enumerate(self._estimators.items()):
            if progress:
                progress("smoothing", done, len(self._estimators))
            rows = [
                (times_ns, index)
                for times_ns, people in self.solved.items()
                for index, (estimate, _) in enumerate(people)
                if estimate.name == name and estimate.status is not Status.DIVERGED
            ]
            own = [self.solved[times_ns][index] for times_ns, index in rows]
            if not own:
                continue
            theta = WindowSolver(estimator.solver).smooth(
                np.stack([estimate.theta for estimate, _ in own]),
                [observation for _, observation in own],
            )
            position, rotation = forward_kinematics(estimator.shape, theta)
            for k, ((times_ns, index), (estimate, observation)) in enumerate(
                zip(rows, own, strict=True)
            ):
                smoothed = replace(
                    estimate,
                    theta=theta[k],
                    bone_position_in_world_m=position[k],
                    bone_rotation_in_world=rotation[k],
                )
                self.solved[times_ns][index] = (smoothed, observation)
        if progress:
            progress("smoothing", len(self._estimators), len(self._estimators))


def describe_subjects(take: Take) -> dict[str, dict[str, float]]:
    """As `SolveReport.subjects`."""
    return {name: _describe(take, s) for s, name in enumerate(take.subject_names)}


def _describe(take: Take, subject: int) -> dict[str, float]:
    tracked = take.tracked[subject]
    quality = take.bone_quality[subject][tracked]
    return {
        "tracked_share": float(tracked.mean()) if tracked.size else 0.0,
        "mean_quality": float(quality.mean()) if quality.size else 0.0,
        "height_m": float(take.heights_m[subject]),
    }
