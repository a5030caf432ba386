"""A recorded session to a take, in two passes.

The first pass sorts and solves every instant as a live run would, and learns the bodies of people
nobody measured. The second solves each subject again from the keypoints it was assigned, with one
body throughout, and from the instant it was first seen rather than the one it was confirmed at.

Interrupted (Ctrl-C), either pass ends at the instant it had reached and the take holds what was
solved.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np

from fusecap.associate.paper import PaperSorter
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker, TrackerOptions
from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.body.prior import PosePrior, load_prior
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import SessionError
from fusecap.geometry.camera import Rig
from fusecap.pipeline import Pipeline, Sorter, observation_of
from fusecap.sinks.take import Take, TakeBuilder, provenance
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites
from fusecap.solve.reprojection import Reprojection
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_data import SessionData
from fusecap.types import Detections, Estimate, ImuReading, TrackState, TrackUpdate

Progress = Callable[[str, int, int], None]
"""Called with (what is being done, instants done, instants in all)."""


class Instants(Protocol):
    """Recorded measurements on the solve's instants."""

    def __len__(self) -> int: ...

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        ...

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        ...


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Who is in front of which cameras."""

    rig: Rig
    landmarks: LandmarkSet
    skeleton: Skeleton
    rate_hz: float
    subjects: tuple[SubjectModel, ...]
    sorter: Sorter | None
    """None without cameras."""
    prior: PosePrior
    options: SolverOptions


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
        return _without_nan(asdict(self))


@dataclass(frozen=True, kw_only=True)
class Solved:
    """A take and how it came about."""

    take: Take
    report: SolveReport


def solve_session(data: SessionData, *, progress: Progress | None = None) -> Solved:
    """Solve an opened session; raises `SessionError` where nothing can be solved."""
    scene = scene_of(data)
    return solve_instants(
        scene,
        SessionInstants(data),
        progress=progress,
        session_sha256=data.content_hash,
        notes=tuple(str(finding) for finding in data.findings),
    )


def solve_instants(
    scene: Scene,
    instants: Instants,
    *,
    progress: Progress | None = None,
    session_sha256: str | None = None,
    simulated: bool = False,
    notes: tuple[str, ...] = (),
) -> Solved:
    """Both passes over recorded instants."""
    started = time.perf_counter()
    with ThreadPoolExecutor() as pool:
        pipeline = Pipeline(
            rig=scene.rig,
            landmarks=scene.landmarks,
            skeleton=scene.skeleton,
            prior=scene.prior,
            sorter=scene.sorter,
            subjects=scene.subjects,
            options=scene.options,
            pool=pool,
        )
        tracked = _first_pass(pipeline, instants, progress)
        reprojection = Reprojection(scene.rig, scene.landmarks)
        builder = TakeBuilder(
            skeleton=scene.skeleton,
            rate_hz=scene.rate_hz,
            subject_names=[model.name for model in scene.subjects],
            provenance=provenance(
                options={"solver": asdict(scene.options), "cameras": list(scene.rig.names)},
                session_sha256=session_sha256,
                simulated=simulated,
            ),
        )
        second = _SecondPass(scene, pipeline, tracked)
        solve_s, statuses = [], Counter()
        interrupted = tracked.interrupted
        try:
            for instant, updates in enumerate(tracked.updates):
                detections = instants.detections(instant)
                estimates = second.step(detections, instants.readings(instant), updates, pool)
                builder.add(detections.timestamp_ns, [estimate for estimate, _ in estimates])
                for estimate, keypoints in estimates:
                    reprojection.add(estimate, keypoints)
                    solve_s.append(estimate.solve_s)
                    statuses[estimate.status.name.lower()] += 1
                if progress:
                    progress("solving", instant + 1, len(tracked.updates))
        except KeyboardInterrupt:
            interrupted = True
    take = builder.build()
    solve_ms = np.array(solve_s or [np.nan]) * 1e3
    return Solved(
        take=take,
        report=SolveReport(
            instants=len(take.timestamps_ns),
            duration_s=len(take.timestamps_ns) / scene.rate_hz,
            cameras=len(scene.rig),
            subjects={name: _describe(take, s) for s, name in enumerate(take.subject_names)},
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


def scene_of(data: SessionData, landmarks: LandmarkSet | None = None) -> Scene:
    """What a session file says about people, cameras and options, as the stages want it.

    `landmarks` are the session's own unless given.
    """
    session = data.session
    settings = session.settings
    options = solver_options(session)
    landmarks = landmarks or data.landmarks or LANDMARK_SETS["body25"]
    sites = {
        imus.subject: ImuSites(
            bone=tuple(session.skeleton.bone(name) for name in imus.bones),
            position_m=np.ascontiguousarray(imus.positions_in_bone_m, dtype=np.float64),
        )
        for imus in data.imus
    }
    subjects = tuple(
        SubjectModel(
            name=subject.name,
            shape=_shape(session.skeleton, subject, measurable=len(data.rig) > 1),
            sites=sites.get(subject.name, ImuSites.none()),
            start_m=subject.start_m,
        )
        for subject in session.subjects
    )
    return Scene(
        rig=data.rig,
        landmarks=landmarks,
        skeleton=session.skeleton,
        rate_hz=settings.rate_hz,
        subjects=subjects,
        sorter=make_sorter(
            data.rig,
            landmarks,
            subjects,
            associate=settings.associate,
            max_subjects=settings.max_subjects,
            volume_m=settings.volume_m,
        ),
        prior=load_prior(session.skeleton),
        options=options,
    )


def make_sorter(
    rig: Rig,
    landmarks: LandmarkSet,
    subjects: Sequence[SubjectModel],
    *,
    associate: str = "tracker",
    max_subjects: int | None = None,
    volume_m: tuple[float, float, float, float] | None = None,
) -> Sorter | None:
    """The sorter a session asks for; None without cameras."""
    if not len(rig):
        return None
    named = [Subject(name=model.name, start_m=model.start_m) for model in subjects]
    if associate == "paper":
        if len(rig) < 2:
            raise SessionError('associate = "paper" triangulates; it needs two cameras or more')
        return PaperSorter(rig, landmarks, named)
    if len(rig) == 1 and max_subjects is None and len(named) <= 1:
        max_subjects = 1
    return Tracker(
        rig, landmarks, TrackerOptions(max_subjects=max_subjects, volume_m=volume_m), named
    )


def solver_options(session: Session) -> SolverOptions:
    """Defaults with what `[estimator]` and `floor` change."""
    given = session.estimator
    weights = {name: w for name, w in given.weights.model_dump().items() if w is not None}
    if not session.settings.floor:
        weights["floor"] = 0.0
    named = {
        name: value
        for name in ("max_iterations", "function_tolerance", "floor_radius_m")
        if (value := getattr(given, name)) is not None
    }
    return SolverOptions(weights=Weights.named(**weights), **named)


def _shape(skeleton: Skeleton, subject: SubjectSettings, *, measurable: bool) -> BodyShape | None:
    """Measured, scaled, or None: to be estimated from two views or more."""
    if subject.height_m is None and not subject.bone_lengths_m and measurable:
        return None
    shape = BodyShape.from_height(skeleton, subject.height_m or REFERENCE_HEIGHT_M)
    return shape.with_lengths(subject.bone_lengths_m)


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
class _Tracked:
    """What the first pass leaves: per instant the updates of people who became subjects."""

    updates: list[list[TrackUpdate]]
    shapes: dict[str, BodyShape]
    interrupted: bool


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
    """Solves people from assignments that stand."""

    def __init__(self, scene: Scene, pipeline: Pipeline, tracked: _Tracked) -> None:
        self._landmark_count = len(scene.landmarks.landmark_names)
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
        pool: ThreadPoolExecutor,
    ) -> list[tuple[Estimate, np.ndarray]]:
        """Estimates, each with the keypoints (C, K, 3) it was solved from."""

        def solve(update: TrackUpdate) -> tuple[Estimate, np.ndarray] | None:
            estimator = self._estimators[update.name]
            observation = observation_of(
                update, detections, self._landmark_count, readings.get(update.name)
            )
            estimate = estimator.follow(update.track_id, observation, update.landmarks_in_world_m)
            return estimate and (estimate, observation.keypoints)

        return [solved for solved in pool.map(solve, updates) if solved]


def _describe(take: Take, subject: int) -> dict[str, float]:
    tracked = take.tracked[subject]
    quality = take.bone_quality[subject][tracked]
    return {
        "tracked_share": float(tracked.mean()) if tracked.size else 0.0,
        "mean_quality": float(quality.mean()) if quality.size else 0.0,
        "height_m": float(take.heights_m[subject]),
    }


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
