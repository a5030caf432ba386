"""Where the stages meet: detections are assigned to people, people are solved.

    Detections ──sorter──▶ TrackUpdate ──▶ Observation ──estimator──▶ Estimate
         ▲                                                               │
         └───────────── landmarks predicted for the next instant ◀───────┘

`Pipeline.step` takes one instant and holds no clock, so a live run and its replay give the same
bits. Estimators of different people share nothing and may run on threads: the kernels do not hold
the GIL.
"""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from fusecap.associate.paper import PaperSorter
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from fusecap.believable import believable_detections, believable_reading, checked_moment
from fusecap.errors import SessionError
from fusecap.geometry.camera import Camera
from fusecap.setup import Setup
from fusecap.solve.estimator import Estimator, SubjectModel
from fusecap.types import Detections, Estimate, ImuReading, Observation, TrackState, TrackUpdate

BLIND_START_S = 2.0
"""For so long sensors wait for a camera that says where their subject is."""


class Sorter(Protocol):
    """Assigns the people of one instant to tracks; holds no clock."""

    def update(
        self,
        detections: Detections,
        predicted: Mapping[int, Float[np.ndarray, "k 3"]],
        now_ns: int,
    ) -> list[TrackUpdate]:
        """What each track was given; `predicted` are landmarks [m] by track id."""
        ...


@runtime_checkable
class OpenSorter(Protocol):
    """A sorter whose subjects may change in the middle."""

    def reinitialise(self, name: str = "") -> None:
        """Find a subject, or without a name everybody, anew."""
        ...

    def add_subject(self, name: str = "") -> None:
        """Make room for one more person; raises `SessionError` where that cannot be."""
        ...

    def remove_subject(self, name: str) -> None:
        """Follow a subject no longer."""
        ...

    @property
    def is_full(self) -> bool:
        """Everyone there is a place for is being followed."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What one instant gave."""

    updates: tuple[TrackUpdate, ...]
    estimates: tuple[Estimate, ...]
    renumbered: Mapping[int, int] = field(default_factory=dict)
    """Of people who turned out to be others than was thought: by the track id they had until now
    the one that they have."""
    renumbered_since_ns: int | None = None
    """When these went astray; None where sensors' readings must tell."""
    returned: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    """Of newcomers who turned out to be subjects that nobody saw: by the track id they had, the
    subject's, and since when [ns]."""
    found_anew: Mapping[str, int] = field(default_factory=dict)
    """By name, whose pose did not fit and was found anew, and since when [ns] it was wrong."""
    bystanders: tuple[TrackUpdate, ...] = ()
    """Who is no subject but may be one of those who wear sensors."""
    notes: tuple[str, ...] = ()
    """What a user should know, in words."""


def observation_of(
    update: TrackUpdate, detections: Detections, landmarks: int, imu: ImuReading | None
) -> Observation:
    """The keypoints that `update` assigned, camera by camera, with the subject's sensors."""
    keypoints = np.full((len(detections.people), landmarks, 3), np.nan)
    keypoints[:, :, 2] = 0.0
    for camera, person in enumerate(update.person):
        if person >= 0:
            keypoints[camera] = detections.people[camera][person]
    return Observation(timestamp_ns=detections.timestamp_ns, keypoints=keypoints, imu=imu)


def worn_sensors(setup: Setup) -> dict[str, tuple[str, ...]]:
    """Per subject that wears any, the bones of its sensors, in the order of its readings."""
    bones = setup.skeleton.bone_names
    return {
        model.name: tuple(bones[bone] for bone in model.sites.bone)
        for model in setup.subjects
        if model.sites.bone
    }


def _own_sorter(setup: Setup) -> Sorter | None:
    """As the setup asks for it; None without cameras."""
    if not len(setup.rig):
        return None
    sensors = worn_sensors(setup)
    named = [
        Subject(name=model.name, start_m=model.start_m, sensors=sensors.get(model.name, ()))
        for model in setup.subjects
    ]
    if setup.associate == "paper":
        return PaperSorter(setup.rig, setup.landmarks, named)
    options = setup.tracker
    if len(setup.rig) == 1 and options.max_subjects is None and len(named) <= 1:
        options = replace(options, max_subjects=1)
    return Tracker(setup.rig, setup.landmarks, options, named)


def make_estimator(setup: Setup, model: SubjectModel) -> Estimator:
    """An estimator as a pipeline of this setup uses it."""
    return Estimator(
        model,
        rig=setup.rig,
        landmarks=setup.landmarks.of(model.name),
        prior=setup.prior,
        skeleton=setup.skeleton,
        options=setup.options,
    )


class Pipeline:
    """Sorts and solves one instant after the other."""

    def __init__(
        self, setup: Setup, *, sorter: Sorter | None = None, pool: ThreadPoolExecutor | None = None
    ) -> None:
        """People are sorted as the setup says, or by a `sorter` of one's own.

        With a `pool` subjects are solved on its threads, to the same bits; what that brings is in
        docs/benchmarks.md, "How it grows".
        """
        self._setup = setup
        self._sorter = sorter or _own_sorter(setup)
        self._models = {model.name: model for model in setup.subjects}
        self._pool = pool
        self._estimators: dict[str, Estimator] = {}
        self._removed: set[str] = set()
        self._now_ns: int | None = None
        self._looked_ns: int | None = None
        """When a camera last looked, at the latest at the first instant."""
        nobody = np.empty((0, len(setup.landmarks.landmark_names), 3))
        self._detections = Detections(timestamp_ns=0, people=(nobody,) * len(setup.rig))
        self._step = Step(updates=(), estimates=())

    def step(self, detections: Detections, readings: Mapping[str, ImuReading]) -> Step:
        """One instant: `readings` holds, by subject name, what its sensors say.

        Raises `InputError` for arrays of another shape, crowds, and a time that is not after the
        last one's, with everything as it was before.
        """
        landmarks = len(self._setup.landmarks.landmark_names)
        checked_moment(detections.timestamp_ns, self._now_ns)
        detections = believable_detections(detections, len(self._setup.rig), landmarks)
        readings = {
            name: believable_reading(reading, len(self.model(name).sites.bone))
            for name, reading in readings.items()
            if name in self._models
        }
        self._now_ns = detections.timestamp_ns
        updates = self._sort(detections, readings)
        followed = [update for update in updates if update.state is not TrackState.TENTATIVE]
        work = []
        for update in followed:
            observation = observation_of(
                update,
                detections,
                landmarks,
                readings.get(update.name),
            )
            work.append((self.estimator(update.name), update, observation))
        if self._pool is None or len(work) < 2:
            results = [_follow(*item) for item in work]
        else:
            results = list(self._pool.map(lambda item: _follow(*item), work))
        self._detections = detections
        tracker = self._sorter if isinstance(self._sorter, Tracker) else None
        since = {u.name: self._estimators[u.name].found_anew_since_ns for u in followed}
        found_anew = {name: since_ns for name, since_ns in since.items() if since_ns is not None}
        self._step = Step(
            updates=tuple(updates),
            estimates=tuple(estimate for estimate in results if estimate is not None),
            renumbered=tracker.renumbered if tracker else {},
            renumbered_since_ns=tracker.renumbered_since_ns if tracker else None,
            returned=dict(tracker.returned) if tracker else {},
            found_anew=found_anew,
            bystanders=tuple(tracker.bystanders) if tracker else (),
            notes=tuple(tracker.notes) if tracker else (),
        )
        return self._step

    def ahead(self, now_ns: int, readings: Mapping[str, ImuReading]) -> list[Estimate]:
        """Those of the last step at a later instant, which no picture has reached yet."""
        views, landmarks = len(self._setup.rig), len(self._setup.landmarks.landmark_names)
        unseen = np.full((views, landmarks, 3), np.nan)
        unseen[:, :, 2] = 0.0
        found = [
            self._estimators[last.name].ahead(
                Observation(timestamp_ns=now_ns, keypoints=unseen, imu=readings.get(last.name))
            )
            for last in self._step.estimates
            if last.name in self._estimators
        ]
        return [estimate for estimate in found if estimate is not None]

    def settled(self, lag_s: float) -> list[Estimate]:
        """Those of the last step so long before it, as what came since corrects them."""
        found = [
            self._estimators[last.name].settled(lag_s)
            for last in self._step.estimates
            if last.name in self._estimators
        ]
        return [estimate for estimate in found if estimate is not None]

    def estimator(self, name: str) -> Estimator:
        """A subject's; a new one for whoever is not followed, or found anew and not seen since."""
        if name not in self._estimators:
            self._estimators[name] = make_estimator(self._setup, self.model(name))
        return self._estimators[name]

    def model(self, name: str) -> SubjectModel:
        """As `Setup.model`."""
        return self._setup.model(name)

    def expected(self, now_ns: int) -> list[Float[np.ndarray, "m k 3"]]:
        """Per camera the people expected at `now_ns`: x, y [px], confidence; NaN, NaN, 0 unknown.

        Everyone followed is predicted in the world and projected into every view, also into those
        that had lost them; projections may lie outside the image. Detections that belong to nobody
        (newcomers, bystanders, false ones) are expected where they were, unless there is no place
        for anybody else.
        """
        names = {update.track_id: update.name for update in self._step.updates}
        followed = {estimate.track_id for estimate in self._step.estimates}
        known = (self._estimators.get(names[track_id]) for track_id in sorted(followed))
        points = [some.predict(now_ns) for some in known if some is not None]
        expected = []
        for index, camera in enumerate(self._setup.rig.cameras):
            people = self._detections.people[index]
            taken = {u.person[index].item() for u in self._step.updates if u.track_id in followed}
            others = range(0 if self._is_full else len(people))
            free = [n for n in others if n not in taken]
            projected = [_projected(camera, point) for point in points if point is not None]
            visible = [p[None] for p in projected if _is_in_view(camera, p)]
            expected.append(np.concatenate([*visible, people[free]]))
        return expected

    def reinitialise(self, name: str = "") -> None:
        """Find a subject, or without a name everybody, anew: place, pose and unmeasured body.

        Raises `SessionError`, as the other two do, where the sorter's subjects cannot change.
        """
        if self._sorter is not None:
            self._cast(self._sorter).reinitialise(name)
        for gone in [name] if name else list(self._estimators):
            self._estimators.pop(gone, None)

    def add_subject(self, name: str = "") -> None:
        """Make room for one more person; without cameras only for one who was removed."""
        if self._sorter is not None:
            self._cast(self._sorter).add_subject(name)
        elif name not in self._removed:
            raise SessionError("without cameras nobody new is found; name someone who was removed")
        self._removed.discard(name)

    def remove_subject(self, name: str) -> None:
        """Follow a subject no longer, not by its sensors either."""
        if self._sorter is not None:
            self._cast(self._sorter).remove_subject(name)
        self._estimators.pop(name, None)
        self._removed.add(name)

    @property
    def _is_full(self) -> bool:
        """Everyone there is a place for is being followed; others are bystanders."""
        return isinstance(self._sorter, OpenSorter) and self._sorter.is_full

    @staticmethod
    def _cast(sorter: Sorter) -> OpenSorter:
        if isinstance(sorter, OpenSorter):
            return sorter
        raise SessionError('associate = "paper" follows those it began with; use "tracker"')

    def _sort(
        self, detections: Detections, readings: Mapping[str, ImuReading]
    ) -> list[TrackUpdate]:
        updates = []
        if self._sorter is not None:
            predicted = {}
            for estimator in self._estimators.values():
                points = estimator.predict(detections.timestamp_ns)
                if points is not None:
                    predicted[estimator.track_id] = points
            if isinstance(self._sorter, Tracker):
                self._sorter.hear(readings)
            updates = self._sorter.update(detections, predicted, detections.timestamp_ns)
            if isinstance(self._sorter, Tracker):
                back = {number for number, _ in self._sorter.returned.values()}
                for update in updates:
                    if update.track_id in self._sorter.renumbered.values():
                        self._estimators.pop(update.name, None)
                    elif update.track_id in back and update.name in self._estimators:
                        self._estimators[update.name].restart()
        sorted_names = {update.name for update in updates}
        if self._looked_ns is None or detections.looked is None or any(detections.looked):
            self._looked_ns = detections.timestamp_ns
        blind_s = (detections.timestamp_ns - self._looked_ns) * 1e-9
        for index, name in enumerate(self._models):
            # Sensors go on where no camera sees their subject, and begin where no camera looks.
            started = self._sorter is None or name in self._estimators or blind_s > BLIND_START_S
            wanted = name not in sorted_names and name not in self._removed
            if wanted and started and name in readings:
                updates.append(self._unseen(index, name))
        return updates

    def _unseen(self, index: int, name: str) -> TrackUpdate:
        known = self._estimators.get(name)
        return TrackUpdate(
            track_id=known.track_id if known else index,
            name=name,
            state=TrackState.COASTING,
            person=np.full(len(self._setup.rig), -1),
            landmarks_in_world_m=np.full((len(self._setup.landmarks.landmark_names), 3), np.nan),
        )


def _projected(camera: Camera, points_m: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    pixels = camera.project(points_m)
    return np.concatenate([pixels, np.isfinite(pixels).all(axis=1, keepdims=True)], axis=1)


def _is_in_view(camera: Camera, person: Float[np.ndarray, "k 3"]) -> bool:
    xy = person[np.isfinite(person[:, 0]), :2]
    inside = np.all((xy >= -0.5) & (xy <= np.array(camera.size_px) - 0.5), axis=1)
    return bool(inside.any())


def _follow(estimator: Estimator, update: TrackUpdate, observation: Observation) -> Estimate | None:
    return estimator.follow(update.track_id, observation, update.landmarks_in_world_m)
