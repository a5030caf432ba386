"""What the speed of a solve is measured on: the demo's motion in front of any number of cameras.

Keypoints and IMUs carry the faults of docs/simulation.md. Every keypoint goes to the person it is
of, so a figure is about solving alone; `benchmarks/test_association_speed.py` times the sorting.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.motion_model import load_demo_motion
from fusecap.body.prior import PosePrior, load_prior
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulator import Person, Simulation, camera_ring, placed, simulate
from fusecap.solve.estimator import Estimator, SubjectModel
from fusecap.solve.options import SolverOptions
from fusecap.solve.pose_solver import ImuSites
from fusecap.types import Detections, Observation, TrackState, TrackUpdate

_HEIGHTS_M = (1.68, 1.82, 1.74, 1.60, 1.90, 1.75)
_PLACES_M = ((0.0, 0.0), (-1.2, 1.2), (1.2, -1.2), (-1.2, -1.2), (1.2, 1.2), (0.0, 1.8))


class Scene(NamedTuple):
    """A simulation, and what an estimator of its subjects needs."""

    simulation: Simulation
    models: tuple[SubjectModel, ...]
    prior: PosePrior

    def observations(self, subject: int = 0) -> list[Observation]:
        """Per frame: the subject's own keypoints and sensors."""
        simulation = self.simulation
        readings = simulation.imu_readings.get(self.models[subject].name)
        found = []
        for frame, detections in enumerate(simulation.detections):
            keypoints = np.full((len(simulation.rig), 25, 3), np.nan)
            keypoints[:, :, 2] = 0.0
            for camera, index in enumerate(self.update(frame, subject).person):
                if index >= 0:
                    keypoints[camera] = detections.people[camera][index]
            found.append(
                Observation(
                    timestamp_ns=detections.timestamp_ns,
                    keypoints=keypoints,
                    imu=readings[frame] if readings else None,
                )
            )
        return found

    def update(self, frame: int, subject: int) -> TrackUpdate:
        """What a sorter that makes no mistakes says."""
        whose = self.simulation.detected_person[frame]
        person = [int(np.argmax(view == subject)) if subject in view else -1 for view in whose]
        return TrackUpdate(
            track_id=subject,
            name=self.models[subject].name,
            state=TrackState.CONFIRMED,
            person=np.array(person),
            landmarks_in_world_m=np.full((25, 3), np.nan),
        )

    def estimator(self, *, window: int = 1) -> Estimator:
        """Of the first subject."""
        simulation = self.simulation
        return Estimator(
            self.models[0],
            rig=simulation.rig,
            landmarks=simulation.landmark_set,
            prior=self.prior,
            skeleton=self.models[0].shape.skeleton,
            options=SolverOptions(window=window),
        )


class KnownSorter:
    """A `Sorter` that tells everyone apart at no cost."""

    def __init__(self, scene: Scene) -> None:
        people = range(len(scene.models))
        self._updates = {
            detections.timestamp_ns: [scene.update(frame, subject) for subject in people]
            for frame, detections in enumerate(scene.simulation.detections)
        }

    def update(self, detections: Detections, predicted: object, now_ns: int) -> list[TrackUpdate]:
        return self._updates[now_ns]


def scene(
    *,
    cameras: int = 8,
    imu_bones: tuple[str, ...] = IMUS_13,
    people: int = 1,
    skeleton: Skeleton = PAPER21,
    frames: int = 720,
) -> Scene:
    """The shipped motion, 12 s at 60 Hz; from the third person on, its clips again elsewhere."""
    motion = load_demo_motion()
    persons, models = [], []
    for index in range(people):
        shape = BodyShape.from_height(skeleton, _HEIGHTS_M[index])
        theta = placed(
            motion.theta[index % 2, :frames],
            turn_rad=float(index),
            centre_m=_PLACES_M[index],
            scale=shape.height_m / REFERENCE_HEIGHT_M,
        )
        persons.append(
            Person(
                name=f"person{index}",
                shape=shape,
                theta=on_skeleton(theta, skeleton),
                imu_bones=imu_bones,
            )
        )
    simulation = simulate(
        persons,
        camera_ring(cameras, radius_m=5.0),
        landmark_set_named("body25"),
        rate_hz=motion.rate_hz,
        seed=0,
    )
    for person in persons:
        imus = simulation.imus.get(person.name)
        sites = ImuSites.none()
        if imus is not None:
            bones = tuple(skeleton.bone(name) for name in imus.bones)
            sites = ImuSites(bone=bones, position_m=np.ascontiguousarray(imus.position_in_bone_m))
        models.append(
            SubjectModel(
                name=person.name,
                shape=person.shape,
                sites=sites,
                start_m=(float(person.theta[0, 0]), float(person.theta[0, 2])),
            )
        )
    return Scene(simulation, tuple(models), load_prior(skeleton))


def on_skeleton(theta: np.ndarray, skeleton: Skeleton) -> np.ndarray:
    """Poses of `paper21` on another skeleton, bone by name; what it has more of stays at rest."""
    moved = np.zeros((len(theta), skeleton.pose_size))
    moved[:, :3] = theta[:, :3]
    for bone, name in enumerate(skeleton.bone_names):
        if name in PAPER21.bone_names:
            source = 3 + 3 * PAPER21.bone(name)
            moved[:, 3 + 3 * bone : 6 + 3 * bone] = theta[:, source : source + 3]
    return moved
