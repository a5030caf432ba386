"""What every data set is brought to: measurements that the solver reads, and the truth about them.

World right-handed, y up, metres; frame i of everything was exposed at i / rate_hz.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.associate.options import TrackerOptions
from fusecap.batch.solve import solve_instants
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import landmarks_in_world
from fusecap.body.prior import load_prior
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions, Weights
from fusecap.sources.keypoint_files import read_keypoints
from fusecap.take import Take
from fusecap.types import Detections, ImuReading


@dataclass(frozen=True, kw_only=True, eq=False)
class LandmarkTruth:
    """Points of G people over T frames that lie where our landmarks of the same names do."""

    landmarks: LandmarkSet
    points_in_world_m: Float[np.ndarray, "g t j 3"]
    """NaN where unknown."""
    rotation_in_world: None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of the landmarks."""
        return self.landmarks.landmark_names

    def points_of(self, take: Take) -> Float[np.ndarray, "s t j 3"]:
        """Landmarks of a take's people [m]; NaN where untracked."""
        bones = self.landmarks.bones(take.skeleton)
        points = [
            landmarks_in_world(
                take.bone_position_in_world_m[subject],
                take.bone_rotation_in_world(subject),
                bones,
                self.landmarks.offsets_m(take.shape(subject)),
            )
            for subject in range(len(take.subject_names))
        ]
        shape = (-1, len(take.timestamps_ns), len(self.names), 3)
        return np.array(points).reshape(shape)

    def rotations_of(self, take: Take) -> None:
        """Points have none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoneTruth:
    """Joints and rotations of G people over T frames, under the names and axes of our bones."""

    names: tuple[str, ...]
    points_in_world_m: Float[np.ndarray, "g t j 3"]
    """NaN where unknown."""
    rotation_in_world: Float[np.ndarray, "g t j 3 3"]

    def on(self, skeleton: Skeleton) -> BoneTruth:
        """Only the bones that this skeleton has."""
        kept = [row for row, name in enumerate(self.names) if name in skeleton.bone_names]
        return BoneTruth(
            names=tuple(self.names[row] for row in kept),
            points_in_world_m=self.points_in_world_m[:, :, kept],
            rotation_in_world=self.rotation_in_world[:, :, kept],
        )

    def points_of(self, take: Take) -> Float[np.ndarray, "s t j 3"]:
        """Joints of a take's people [m]."""
        return take.bone_position_in_world_m[:, :, self._rows(take)]

    def rotations_of(self, take: Take) -> Float[np.ndarray, "s t j 3 3"]:
        """Rotations of a take's bones."""
        shape = (len(take.subject_names), len(take.timestamps_ns), len(self.names), 3, 3)
        rotations = np.full(shape, np.nan)
        for subject in range(len(rotations)):
            rotations[subject] = take.bone_rotation_in_world(subject)[:, self._rows(take)]
        return rotations

    def _rows(self, take: Take) -> list[int]:
        return [take.skeleton.bone(name) for name in self.names]


Truth = LandmarkTruth | BoneTruth


@dataclass(frozen=True, kw_only=True, eq=False)
class DatasetSequence:
    """One sequence of a data set; `Instants` for the solver."""

    name: str
    rate_hz: float
    frames: int
    rig: Rig
    landmarks: LandmarkSet
    views: tuple[Mapping[int, Float[np.ndarray, "n k 3"]], ...]
    """Per camera and frame everyone's keypoints; a frame that is not there shows nobody."""
    subjects: tuple[SubjectModel, ...] = ()
    """Who is known; empty: people are found."""
    imu: Mapping[str, Sequence[ImuReading]] = field(default_factory=dict)
    """Per subject and frame, in the order of its sites."""
    truth: Truth | None = None
    skeleton: Skeleton = PAPER21
    max_subjects: int | None = None
    floor: bool = True
    notes: tuple[str, ...] = ()
    """What is odd about the files and was dealt with."""

    def __len__(self) -> int:
        return self.frames

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        nobody = np.empty((0, len(self.landmarks.landmark_names), 3))
        return Detections(
            timestamp_ns=round(instant * 1e9 / self.rate_hz),
            people=tuple(view.get(instant, nobody) for view in self.views),
        )

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        return {name: readings[instant] for name, readings in self.imu.items()}

    def solve(self, progress: Progress | None = None) -> Take:
        """The take of the default solve."""
        weights = Weights() if self.floor else Weights(floor=0.0)
        setup = Setup(
            rig=self.rig,
            landmarks=self.landmarks,
            skeleton=self.skeleton,
            rate_hz=self.rate_hz,
            subjects=self.subjects,
            tracker=TrackerOptions(max_subjects=self.max_subjects),
            prior=load_prior(self.skeleton),
            options=SolverOptions(weights=weights),
        )
        return solve_instants(setup, self, progress=progress, notes=self.notes).whole_take


def read_views(
    folders: Mapping[str, Path], landmarks: LandmarkSet, rate_hz: float
) -> tuple[dict[int, np.ndarray], ...]:
    """OpenPose folders by camera name, each as a table of frames; raises `InputError`."""
    missing = [str(folder) for folder in folders.values() if not folder.is_dir()]
    if missing:
        raise InputError(
            f"{missing[0]}: no such folder; expected {landmarks.name} keypoints as OpenPose JSON, "
            "one file per frame (a data set's videos must be run through a detector first)"
        )
    tracks = [
        read_keypoints(folder, name=name, landmarks=landmarks, rate_hz=rate_hz)
        for name, folder in folders.items()
    ]
    return tuple(dict(zip(track.frames.tolist(), track.people, strict=True)) for track in tracks)


def last_frame(views: Sequence[Mapping[int, np.ndarray]]) -> int:
    """Number of frames that any view covers."""
    return 1 + max((max(view) for view in views if view), default=-1)
