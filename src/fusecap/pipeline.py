"""Where the stages meet: detections are assigned to people, people are solved.

    Detections ──sorter──▶ TrackUpdate ──▶ Observation ──estimator──▶ Estimate
         ▲                                                               │
         └───────────── landmarks predicted for the next instant ◀───────┘

`Pipeline.step` takes one instant and holds no clock, so a live run and its replay give the same
bits. Estimators of different people share nothing and may run on threads: the kernels do not hold
the GIL.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.prior import PosePrior
from fusecap.body.skeleton import Skeleton
from fusecap.errors import SessionError
from fusecap.geometry.camera import Rig
from fusecap.solve.estimator import Estimator, SubjectModel
from fusecap.solve.options import SolverOptions
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
class Cast(Protocol):
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


class Pipeline:
    """Sorts and solves one instant after the other."""

    def __init__(
        self,
        *,
        rig: Rig,
        landmarks: LandmarkSet,
        skeleton: Skeleton,
        prior: PosePrior,
        sorter: Sorter | None,
        subjects: Sequence[SubjectModel] = (),
        options: SolverOptions | None = None,
        pool: ThreadPoolExecutor | None = None,
    ) -> None:
        """Without a sorter (no camera) every subject is solved from its sensors alone.

        With a `pool` subjects are solved on its threads, to the same bits. A solve is so short that
        this pays only where solves are made longer (docs/benchmarks.md, "How it grows").
        """
        self._rig = rig
        self._landmarks = landmarks
        self._skeleton = skeleton
        self._prior = prior
        self._sorter = sorter
        self._options = options
        self._models = {model.name: model for model in subjects}
        self._pool = pool
        self._estimators: dict[str, Estimator] = {}
        self._removed: set[str] = set()
        self._looked_ns: int | None = None
        """When a camera last looked, at the latest at the first instant."""

    def step(self, detections: Detections, readings: Mapping[str, ImuReading]) -> Step:
        """One instant: `readings` holds, by subject name, what its sensors say."""
        updates = self._sort(detections, readings)
        followed = [update for update in updates if update.state is not TrackState.TENTATIVE]
        work = []
        for update in followed:
            observation = observation_of(
                update,
                detections,
                len(self._landmarks.landmark_names),
                readings.get(update.name),
            )
            work.append((self._estimator(update.name), update, observation))
        if self._pool is None or len(work) < 2:
            results = [_follow(*item) for item in work]
        else:
            results = list(self._pool.map(lambda item: _follow(*item), work))
        return Step(
            updates=tuple(updates),
            estimates=tuple(estimate for estimate in results if estimate is not None),
        )

    def make_estimator(self, model: SubjectModel) -> Estimator:
        """An estimator as this pipeline uses it."""
        return Estimator(
            model,
            rig=self._rig,
            landmarks=self._landmarks.of(model.name),
            prior=self._prior,
            skeleton=self._skeleton,
            options=self._options,
        )

    def estimator(self, name: str) -> Estimator:
        """The estimator of a subject that has been followed."""
        return self._estimators[name]

    def model(self, name: str) -> SubjectModel:
        """What is known about a subject; nothing about one the session does not name."""
        return self._models.get(name) or SubjectModel(name=name)

    def predicted(self, names: Iterable[str], now_ns: int) -> list[Float[np.ndarray, "k 3"]]:
        """Landmarks [m] expected at `now_ns` of those of these subjects that have a pose."""
        points = [self._estimators[n].predict(now_ns) for n in names if n in self._estimators]
        return [some for some in points if some is not None]

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
    def is_full(self) -> bool:
        """Everyone there is a place for is being followed; others are bystanders."""
        return isinstance(self._sorter, Cast) and self._sorter.is_full

    @staticmethod
    def _cast(sorter: Sorter) -> Cast:
        if isinstance(sorter, Cast):
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
            updates = self._sorter.update(detections, predicted, detections.timestamp_ns)
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
            person=np.full(len(self._rig), -1),
            landmarks_in_world_m=np.full((len(self._landmarks.landmark_names), 3), np.nan),
        )

    def _estimator(self, name: str) -> Estimator:
        if name not in self._estimators:
            self._estimators[name] = self.make_estimator(self.model(name))
        return self._estimators[name]


def _follow(estimator: Estimator, update: TrackUpdate, observation: Observation) -> Estimate | None:
    return estimator.follow(update.track_id, observation, update.landmarks_in_world_m)
