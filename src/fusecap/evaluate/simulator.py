"""A simulated capture: motion with known truth, seen by cameras and worn IMUs with stated faults.

    motion ── forward kinematics ──▶ truth
                                     ├─ landmarks, cameras, occlusion, KeypointNoise ──▶ Detections
                                     └─ bones, mounting, ImuNoise ──▶ ImuReading

Everything random comes from one seed; each camera and each subject's IMUs draw from a stream of
their own, so changing one leaves the others as they were. docs/simulation.md lists every fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.errors import InputError
from fusecap.evaluate.imu_noise import ImuNoise, SimulatedImus, measure
from fusecap.evaluate.keypoint_noise import KeypointNoise, body_capsules, detect, together
from fusecap.geometry.camera import Camera, Rig
from fusecap.sinks.take import Take, provenance, take_from_theta
from fusecap.types import Detections, ImuReading


@dataclass(frozen=True, kw_only=True)
class Person:
    """Someone in the scene; a bystander is one who is not to be tracked."""

    name: str
    shape: BodyShape
    theta: Float[np.ndarray, "t p"]
    imu_bones: tuple[str, ...] = ()
    bystander: bool = False


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What the pipeline is given, and the truth."""

    name: str
    rig: Rig
    landmark_set: LandmarkSet
    people: tuple[Person, ...]
    rate_hz: float
    truth: Take
    """The subjects, without bystanders."""
    detections: tuple[Detections, ...]
    """Per frame."""
    detected_person: tuple[tuple[Int[np.ndarray, " _"], ...], ...]
    """Per frame and camera: whose each detection is, an index into `people`, or -1."""
    imus: dict[str, SimulatedImus]
    """Per subject that wears any."""
    volume_m: tuple[float, float, float, float] | None = None
    """Capture volume: x_min, x_max, z_min, z_max."""
    seed: int = 0
    keypoint_noise: KeypointNoise = field(default_factory=KeypointNoise)
    imu_noise: ImuNoise = field(default_factory=ImuNoise)

    @property
    def subjects(self) -> tuple[Person, ...]:
        """Everyone who is to be tracked, in the order of `truth`."""
        return tuple(person for person in self.people if not person.bystander)

    @cached_property
    def imu_readings(self) -> dict[str, tuple[ImuReading, ...]]:
        """Per subject and frame, in the order of its `imus[...].bones`."""
        return {name: imus.readings() for name, imus in self.imus.items()}


def simulate(
    people: Sequence[Person],
    rig: Rig,
    landmark_set: LandmarkSet,
    *,
    rate_hz: float,
    seed: int,
    keypoint_noise: KeypointNoise | None = None,
    imu_noise: ImuNoise | None = None,
    name: str = "simulation",
    volume_m: tuple[float, float, float, float] | None = None,
) -> Simulation:
    """Capture `people` in motion, all over the same frames; the same seed gives the same bits."""
    keypoint_noise = keypoint_noise or KeypointNoise()
    imu_noise = imu_noise or ImuNoise()
    lengths = {len(person.theta) for person in people}
    if len(lengths) != 1:
        raise InputError(f"simulated people need motions of one length; got {sorted(lengths)}")
    frames = lengths.pop()
    timestamps_ns = np.round(np.arange(frames) * (1e9 / rate_hz)).astype(np.int64)
    streams = np.random.default_rng(seed).spawn(1 + len(rig) + len(people))

    landmarks, capsules, imus = [], [], {}
    for stream, person in zip(streams[1 + len(rig) :], people, strict=True):
        position, rotation = forward_kinematics(person.shape, person.theta)
        bones = landmark_set.bones(person.shape.skeleton)
        offsets = landmark_set.offsets_m(person.shape)
        bias = keypoint_noise.landmark_bias_m * streams[0].standard_normal(offsets.shape)
        landmarks.append(landmarks_in_world(position, rotation, bones, offsets + bias))
        capsules.append(body_capsules(person.shape, position, rotation))
        if person.imu_bones:
            imus[person.name] = measure(
                stream, person.shape, position, rotation, person.imu_bones, imu_noise, rate_hz
            )
    seen = [
        detect(
            stream,
            camera,
            landmark_set,
            np.stack(landmarks, axis=1),
            np.array([person.shape.height_m for person in people]),
            together(capsules),
            keypoint_noise,
            rate_hz,
        )
        for stream, camera in zip(streams[1 : 1 + len(rig)], rig.cameras, strict=True)
    ]
    subjects = [person for person in people if not person.bystander]
    return Simulation(
        name=name,
        rig=rig,
        landmark_set=landmark_set,
        people=tuple(people),
        rate_hz=rate_hz,
        truth=take_from_theta(
            np.stack([person.theta for person in subjects]),
            [person.shape for person in subjects],
            timestamps_ns=timestamps_ns,
            rate_hz=rate_hz,
            subject_names=tuple(person.name for person in subjects),
            skeleton=subjects[0].shape.skeleton,
            provenance=provenance(options={"seed": seed}, simulated=True),
        ),
        detections=tuple(
            Detections(
                timestamp_ns=int(timestamps_ns[frame]),
                people=tuple(view[frame][0] for view in seen),
            )
            for frame in range(frames)
        ),
        detected_person=tuple(tuple(view[frame][1] for view in seen) for frame in range(frames)),
        imus=imus,
        volume_m=volume_m,
        seed=seed,
        keypoint_noise=keypoint_noise,
        imu_noise=imu_noise,
    )


def camera_ring(
    count: int,
    *,
    radius_m: float = 4.5,
    height_m: float = 2.4,
    target_height_m: float = 0.9,
    size_px: tuple[int, int] = (1920, 1080),
    focal_px: float = 1150.0,
) -> Rig:
    """Cameras evenly spaced on a circle, all looking at its axis; the first stands at 45 degrees.

    At 45 degrees from +z towards +x, so that four stand in the corners of a room.
    """
    cameras = []
    matrix = np.array(
        [
            [focal_px, 0.0, (size_px[0] - 1) / 2],
            [0.0, focal_px, (size_px[1] - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    for index in range(count):
        angle = np.pi / 4 + 2 * np.pi * index / count
        centre = np.array([radius_m * np.sin(angle), height_m, radius_m * np.cos(angle)])
        forward = np.array([0.0, target_height_m, 0.0]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cameras.append(
            Camera(
                name=f"cam{index + 1}",
                size_px=size_px,
                matrix=matrix,
                distortion=np.zeros(5),
                rotation=rotation,
                translation=-rotation @ centre,
            )
        )
    return Rig(cameras=tuple(cameras))


def placed(
    theta: Float[np.ndarray, "t p"],
    *,
    turn_rad: float = 0.0,
    centre_m: tuple[float, float] | None = None,
    scale: float = 1.0,
) -> Float[np.ndarray, "t p"]:
    """A motion turned about up, with the middle of its path at x, z = `centre_m`, or kept there.

    `scale` is the stature of the body over that of the one the motion was made for.
    """
    turn = Rotation.from_rotvec([0.0, turn_rad, 0.0])
    middle = (theta[:, :3].min(axis=0) + theta[:, :3].max(axis=0)) / 2 * [1.0, 0.0, 1.0]
    new_middle = middle if centre_m is None else np.array([centre_m[0], 0.0, centre_m[1]])
    moved = theta.copy()
    moved[:, :3] = turn.apply(theta[:, :3] - middle) * scale + new_middle
    moved[:, 3:6] = (turn * Rotation.from_rotvec(theta[:, 3:6])).as_rotvec()
    return moved
