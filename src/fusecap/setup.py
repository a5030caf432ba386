"""What poses depend on besides measurements, as values.

A `SessionSetup` is a session with its calibration and offsets read: what a live run begins with and
a recording stores. A `Setup` is what the stages need of it, and what a `Pipeline` is built from. A
setup holds nothing that changes, so solving twice from one gives the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fusecap.associate.options import TrackerOptions
from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.body.prior import PosePrior, load_prior
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import SessionError
from fusecap.geometry.camera import Rig
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites
from fusecap.sources.offset_files import read_offsets
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_cameras import common_landmarks, open_rig


@dataclass(frozen=True, kw_only=True)
class Setup:
    """Who is in front of which cameras, and how they are sorted and solved."""

    rig: Rig
    """Empty without cameras: subjects are solved from their sensors alone."""
    landmarks: LandmarkSet
    skeleton: Skeleton
    prior: PosePrior
    rate_hz: float
    subjects: tuple[SubjectModel, ...] = ()
    """Who is known; others are found."""
    options: SolverOptions = field(default_factory=SolverOptions)
    associate: str = "tracker"
    """Or "paper", its Algorithm 1."""
    tracker: TrackerOptions = field(default_factory=TrackerOptions)

    def __post_init__(self) -> None:
        if not 0 < self.rate_hz <= 1e6:
            raise SessionError(f"rate_hz is {self.rate_hz}; expected a number of Hz")
        if self.associate not in ("tracker", "paper"):
            raise SessionError(f"associate = {self.associate!r}; expected 'tracker' or 'paper'")
        if self.associate == "paper" and len(self.rig) == 1:
            raise SessionError('associate = "paper" triangulates; it needs two cameras or more')

    def model(self, name: str) -> SubjectModel:
        """What is known about a subject; nothing about one that is not named."""
        known = (model for model in self.subjects if model.name == name)
        return next(known, None) or SubjectModel(name=name)


@dataclass(frozen=True, kw_only=True)
class SessionSetup:
    """Everything that poses of a live run depend on besides its events."""

    session: Session
    """Its settings, subjects with their sensors, and the solver's options; files are not opened."""
    rig: Rig
    """In the order of the session's cameras; empty without any."""
    landmarks: LandmarkSet
    """What the keypoints are, with the session's offsets."""
    simulated: bool = False


def session_setup(
    session: Session, landmark_set: LandmarkSet | None = None, *, simulated: bool = False
) -> SessionSetup:
    """Opens calibration and offsets; `landmark_set` is the detector's, where one is in the loop.

    Raises `SessionError` for cameras without a calibration or with different keypoints.
    """
    rig, _ = open_rig(session)
    if landmark_set is None:
        landmarks = common_landmarks(session) or LANDMARK_SETS["body25"]
    elif session.settings.landmark_offsets is None:
        landmarks = landmark_set
    else:
        offsets = read_offsets(session.settings.landmark_offsets, landmark_set.name)
        landmarks = landmark_set.calibrated(offsets)
    return SessionSetup(session=session, rig=rig, landmarks=landmarks, simulated=simulated)


def setup_of(session: Session, rig: Rig, landmarks: LandmarkSet | None) -> Setup:
    """What a session says about people and options, in front of these cameras."""
    settings = session.settings
    return Setup(
        rig=rig,
        landmarks=landmarks or LANDMARK_SETS["body25"],
        skeleton=session.skeleton,
        prior=load_prior(session.skeleton),
        rate_hz=settings.rate_hz,
        subjects=tuple(
            SubjectModel(
                name=subject.name,
                shape=_shape(session.skeleton, subject, measurable=len(rig) > 1),
                sites=ImuSites(
                    bone=tuple(session.skeleton.bone(imu.bone) for imu in subject.imus),
                    position_m=np.array([imu.position_m for imu in subject.imus]).reshape(-1, 3),
                ),
                start_m=subject.start_m,
            )
            for subject in session.subjects
        ),
        options=solver_options(session),
        associate=settings.associate,
        tracker=TrackerOptions(max_subjects=settings.max_subjects, volume_m=settings.volume_m),
    )


def solver_options(session: Session) -> SolverOptions:
    """Defaults with what `[estimator]` and `floor` change."""
    given = session.estimator
    weights = {name: w for name, w in given.weights.model_dump().items() if w is not None}
    if not session.settings.floor:
        weights["floor"] = 0.0
    named = {
        name: value
        for name in ("window", "max_iterations", "function_tolerance", "floor_radius_m")
        if (value := getattr(given, name)) is not None
    }
    return SolverOptions(weights=Weights.named(**weights), **named)


def _shape(skeleton: Skeleton, subject: SubjectSettings, *, measurable: bool) -> BodyShape | None:
    """Measured, scaled, or None: to be estimated from two views or more."""
    if subject.height_m is None and not subject.bone_lengths_m and measurable:
        return None
    shape = BodyShape.from_height(skeleton, subject.height_m or REFERENCE_HEIGHT_M)
    return shape.with_lengths(subject.bone_lengths_m)
