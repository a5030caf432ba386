"""Who is in front of which cameras: a session's settings as the stages want them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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
from fusecap.pipeline import Sorter
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_data import SessionData
from fusecap.types import Detections, ImuReading


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


def scene_of(data: SessionData, landmarks: LandmarkSet | None = None) -> Scene:
    """What a session file says about people, cameras and options, as the stages want it.

    `landmarks` are the session's own unless given.
    """
    landmarks = landmarks or data.landmarks or LANDMARK_SETS["body25"]
    sites = {
        imus.subject: ImuSites(
            bone=tuple(data.session.skeleton.bone(name) for name in imus.bones),
            position_m=np.ascontiguousarray(imus.positions_in_bone_m, dtype=np.float64),
        )
        for imus in data.imus
    }
    return scene_before(data.session, data.rig, landmarks, sites)


def scene_before(
    session: Session,
    rig: Rig,
    landmarks: LandmarkSet,
    sites: Mapping[str, ImuSites] | None = None,
) -> Scene:
    """`scene_of` before measurements are there; `sites` are the subjects' sensors by name."""
    settings = session.settings
    sites = sites or {}
    subjects = tuple(
        SubjectModel(
            name=subject.name,
            shape=_shape(session.skeleton, subject, measurable=len(rig) > 1),
            sites=sites.get(subject.name, ImuSites.none()),
            start_m=subject.start_m,
        )
        for subject in session.subjects
    )
    return Scene(
        rig=rig,
        landmarks=landmarks,
        skeleton=session.skeleton,
        rate_hz=settings.rate_hz,
        subjects=subjects,
        sorter=make_sorter(
            rig,
            landmarks,
            subjects,
            associate=settings.associate,
            max_subjects=settings.max_subjects,
            volume_m=settings.volume_m,
        ),
        prior=load_prior(session.skeleton),
        options=solver_options(session),
    )


def sites_of(session: Session) -> dict[str, ImuSites]:
    """Where the sensors of everyone who wears some sit, by subject."""
    return {
        subject.name: ImuSites(
            bone=tuple(session.skeleton.bone(imu.bone) for imu in subject.imus),
            position_m=np.array([imu.position_m for imu in subject.imus], dtype=np.float64),
        )
        for subject in session.subjects
        if subject.imus
    }


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
