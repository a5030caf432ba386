"""A simulated capture: motion with known truth, seen by cameras and worn IMUs with stated faults.

    motion ── forward kinematics ──▶ truth
                                     ├─ landmarks, cameras, occlusion, KeypointNoise ──▶ CameraView
                                     └─ bones, mounting, ImuNoise ──▶ ImuReading

Everything random comes from one seed; each camera and each subject's IMUs draw from a stream of
their own, and `Simulation.subset` leaves cameras and IMUs out of a capture that was made, so that
what remains is bit for bit the same. docs/simulation.md lists every fault.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.errors import InputError
from fusecap.evaluate.imu_noise import ImuNoise, SimulatedImus, measure
from fusecap.evaluate.keypoint_noise import (
    KeypointNoise,
    body_capsules,
    detect,
    detector_bias,
    together,
)
from fusecap.evaluate.rig_noise import RigNoise, believed
from fusecap.geometry.camera import Camera, Rig
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.synchronizer import people_at
from fusecap.take import Take, provenance, take_from_theta
from fusecap.types import Detections, ImuReading


@dataclass(frozen=True, kw_only=True)
class Person:
    """Someone in the scene; a bystander is one who is not to be tracked."""

    name: str
    shape: BodyShape
    """The true one; a solver may be told less."""
    theta: Float[np.ndarray, "t p"]
    imu_bones: tuple[str, ...] = ()
    bystander: bool = False


@dataclass(frozen=True, kw_only=True)
class CameraTiming:
    """When a camera exposes: its frame n at n / rate + offset on the scene's clock."""

    rate_hz: float
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate_hz) and self.rate_hz > 0):
            raise InputError(f"a camera's rate is {self.rate_hz:g} Hz; expected more than zero")
        if not (np.isfinite(self.offset_s) and self.offset_s >= 0):
            raise InputError(f"a camera's offset is {self.offset_s:g} s; expected zero or more")

    def times_s(self, duration_s: float) -> Float[np.ndarray, " f"]:
        """Of the frames up to `duration_s`."""
        count = int(np.floor((duration_s - self.offset_s) * self.rate_hz + 1e-6)) + 1
        return np.arange(max(count, 0)) / self.rate_hz + self.offset_s


@dataclass(frozen=True, kw_only=True)
class CameraView:
    """What one camera delivered, in frames of its own."""

    timing: CameraTiming
    times_s: Float[np.ndarray, " f"]
    """As anybody would know them, a clock error not included."""
    people: tuple[Float[np.ndarray, "_ k 3"], ...]
    """Per frame, like `Detections.people`."""
    person: tuple[Int[np.ndarray, " _"], ...]
    """Per frame whose each detection is, an index into `Simulation.people`, or -1."""


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What the pipeline is given, and the truth."""

    name: str
    rig: Rig
    """As calibrated."""
    landmark_set: LandmarkSet
    people: tuple[Person, ...]
    rate_hz: float
    truth: Take
    """The subjects, without bystanders."""
    views: tuple[CameraView, ...]
    """In the order of the rig."""
    imus: dict[str, SimulatedImus]
    """Per subject that wears any."""
    landmark_offsets_m: tuple[Float[np.ndarray, "k 3"], ...]
    """Per person where the detector's landmarks truly lie, in the bones' frames."""
    volume_m: tuple[float, float, float, float] | None = None
    """Capture volume: x_min, x_max, z_min, z_max."""
    seed: int = 0
    keypoint_noise: KeypointNoise = field(default_factory=KeypointNoise)
    imu_noise: ImuNoise = field(default_factory=ImuNoise)

    @property
    def subjects(self) -> tuple[Person, ...]:
        """Everyone who is to be tracked, in the order of `truth`."""
        return tuple(person for person in self.people if not person.bystander)

    @property
    def synchronous(self) -> bool:
        """Whether every camera exposes at the instants of the truth."""
        scene = CameraTiming(rate_hz=self.rate_hz)
        return all(view.timing == scene for view in self.views)

    @cached_property
    def detections(self) -> tuple[Detections, ...]:
        """Per instant of the truth; interpolated as a session's are where cameras do not agree."""
        times_ns = self.truth.timestamps_ns
        if self.synchronous:
            return tuple(
                Detections(timestamp_ns=int(t), people=tuple(v.people[i] for v in self.views))
                for i, t in enumerate(times_ns)
            )
        tracks = [
            KeypointTrack(
                name=name,
                landmarks=self.landmark_set,
                rate_hz=view.timing.rate_hz,
                frames=np.arange(len(view.times_s)),
                times_s=view.times_s,
                people=view.people,
                broken=(),
            )
            for name, view in zip(self.rig.names, self.views, strict=True)
        ]
        return tuple(
            Detections(
                timestamp_ns=int(t),
                people=tuple(people_at(track, float(t) * 1e-9) for track in tracks),
            )
            for t in times_ns
        )

    @property
    def detected_person(self) -> tuple[tuple[Int[np.ndarray, " _"], ...], ...]:
        """Per instant and camera: whose each of `detections` is, an index into `people`, or -1."""
        if not self.synchronous:
            raise InputError(
                "cameras of different rates or offsets: whose each detection is, is known per "
                "frame of each camera (views), not per instant"
            )
        frames = range(len(self.truth.timestamps_ns))
        return tuple(tuple(view.person[frame] for view in self.views) for frame in frames)

    @cached_property
    def imu_readings(self) -> dict[str, tuple[ImuReading, ...]]:
        """Per subject and instant of the truth, in the order of its `imus[...].bones`."""
        return {name: imus.readings() for name, imus in self.imus.items()}

    def subset(
        self,
        *,
        cameras: Sequence[str] | None = None,
        imu_bones: Sequence[str] | None = None,
    ) -> Simulation:
        """This very capture with only the named cameras, and sensors only on the named bones."""
        names = self.rig.names if cameras is None else tuple(cameras)
        rig = self.rig.subset(names)
        imus = self.imus
        if imu_bones is not None:
            kept = {name: worn.subset(imu_bones) for name, worn in self.imus.items()}
            imus = {name: worn for name, worn in kept.items() if worn.bones}
        return replace(
            self,
            rig=rig,
            views=tuple(self.views[self.rig.names.index(name)] for name in names),
            imus=imus,
            people=tuple(
                replace(person, imu_bones=imus[person.name].bones if person.name in imus else ())
                for person in self.people
            ),
        )


def simulate(
    people: Sequence[Person],
    rig: Rig,
    landmark_set: LandmarkSet,
    *,
    rate_hz: float,
    seed: int,
    keypoint_noise: KeypointNoise | None = None,
    imu_noise: ImuNoise | None = None,
    rig_noise: RigNoise | None = None,
    name: str = "simulation",
    volume_m: tuple[float, float, float, float] | None = None,
    timing: Sequence[CameraTiming] | None = None,
    progress: Progress | None = None,
) -> Simulation:
    """Capture `people` in motion, all over the same frames; the same seed gives the same bits.

    `rig` is where the cameras are; the capture's own is as a calibration with `rig_noise` has it.
    `timing` has one entry per camera; by default all expose at the motion's instants.
    """
    keypoint_noise = keypoint_noise or KeypointNoise()
    imu_noise = imu_noise or ImuNoise()
    frames = _common_length(people)
    times_s = np.arange(frames) / rate_hz
    timing = timing or [CameraTiming(rate_hz=rate_hz)] * len(rig)
    if len(timing) != len(rig):
        raise InputError(f"{len(timing)} camera timings for {len(rig)} cameras")
    *streams, of_rig = np.random.default_rng(seed).spawn(2 + len(rig) + len(people))
    subjects = [person for person in people if not person.bystander]
    if not subjects:
        raise InputError("a simulation needs a subject; everybody is a bystander")

    offsets_m, imus = [], {}
    common = detector_bias(landmark_set, keypoint_noise)
    for stream, person in zip(streams[1 + len(rig) :], people, strict=True):
        own = keypoint_noise.landmark_bias_m * streams[0].standard_normal(common.shape)
        default = landmark_set.offsets_m(person.shape)
        offsets_m.append(default + common * person.shape.height_m + own)
        if person.imu_bones:
            measured_s = np.clip(times_s + imu_noise.clock_s * stream.standard_normal(), 0.0, None)
            moving = at_times(person.theta, rate_hz, np.minimum(measured_s, times_s[-1]))
            imus[person.name] = measure(
                stream, person.shape, moving, person.imu_bones, imu_noise, rate_hz
            )
    views = []
    synchronous = _Scene(people, offsets_m, landmark_set, rate_hz, times_s)
    for index, (stream, camera, when) in enumerate(
        zip(streams[1 : 1 + len(rig)], rig.cameras, timing, strict=True)
    ):
        if progress:
            progress("cameras", index, len(rig))
        told_s = when.times_s(times_s[-1])
        clock_error_s = keypoint_noise.clock_s * stream.standard_normal()
        scene = synchronous
        if clock_error_s or len(told_s) != frames or not np.allclose(told_s, times_s, atol=1e-9):
            exposed_s = np.clip(told_s + clock_error_s, 0.0, times_s[-1])
            scene = _Scene(people, offsets_m, landmark_set, rate_hz, exposed_s)
        seen = detect(
            stream,
            camera,
            landmark_set,
            scene.landmarks_in_world_m,
            np.array([person.shape.height_m for person in people]),
            scene.capsules,
            keypoint_noise,
            when.rate_hz,
        )
        views.append(
            CameraView(
                timing=when,
                times_s=told_s,
                people=tuple(keypoints for keypoints, _ in seen),
                person=tuple(whose for _, whose in seen),
            )
        )
    if progress:
        progress("cameras", len(rig), len(rig))
    return Simulation(
        name=name,
        rig=believed(of_rig, rig, rig_noise or RigNoise()),
        landmark_set=landmark_set,
        people=tuple(people),
        rate_hz=rate_hz,
        truth=take_from_theta(
            np.stack([person.theta for person in subjects]),
            [person.shape for person in subjects],
            timestamps_ns=np.round(np.arange(frames) * (1e9 / rate_hz)).astype(np.int64),
            rate_hz=rate_hz,
            subject_names=tuple(person.name for person in subjects),
            skeleton=subjects[0].shape.skeleton,
            provenance=provenance(options={"seed": seed}, simulated=True),
        ),
        views=tuple(views),
        imus=imus,
        landmark_offsets_m=tuple(offsets_m),
        volume_m=volume_m,
        seed=seed,
        keypoint_noise=keypoint_noise,
        imu_noise=imu_noise,
    )


def _common_length(people: Sequence[Person]) -> int:
    lengths = {len(person.theta) for person in people}
    if len(lengths) != 1:
        raise InputError(f"simulated people need motions of one length; got {sorted(lengths)}")
    return lengths.pop()


class _Scene:
    """Everyone's landmarks and solid parts at some instants."""

    def __init__(
        self,
        people: Sequence[Person],
        offsets_m: Sequence[Float[np.ndarray, "k 3"]],
        landmark_set: LandmarkSet,
        rate_hz: float,
        times_s: Float[np.ndarray, " f"],
    ) -> None:
        landmarks, capsules = [], []
        for person, offsets in zip(people, offsets_m, strict=True):
            theta = at_times(person.theta, rate_hz, times_s)
            position, rotation = forward_kinematics(person.shape, theta)
            bones = landmark_set.bones(person.shape.skeleton)
            landmarks.append(landmarks_in_world(position, rotation, bones, offsets))
            capsules.append(body_capsules(person.shape, position, rotation))
        self.landmarks_in_world_m = np.stack(landmarks, axis=1)
        self.capsules = together(capsules)


def at_times(
    theta: Float[np.ndarray, "t p"], rate_hz: float, times_s: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "f p"]:
    """Poses between the frames of a motion that starts at 0 s: root linear, rotations by slerp."""
    frame = times_s * rate_hz
    if len(theta) == 1 or np.allclose(frame, np.round(frame), atol=1e-6):
        return theta[np.clip(np.round(frame).astype(np.int64), 0, len(theta) - 1)]
    own = np.arange(len(theta), dtype=np.float64)
    frame = np.clip(frame, 0.0, own[-1])
    between = np.empty((len(frame), theta.shape[1]))
    for axis in range(3):
        between[:, axis] = np.interp(frame, own, theta[:, axis])
    for bone in range(3, theta.shape[1], 3):
        turn = Slerp(own, Rotation.from_rotvec(theta[:, bone : bone + 3]))
        between[:, bone : bone + 3] = turn(frame).as_rotvec()
    return between


def camera_ring(
    count: int,
    *,
    radius_m: float = 4.5,
    height_m: float = 2.4,
    target_height_m: float = 0.9,
    size_px: tuple[int, int] = (1920, 1080),
    focal_px: float = 1150.0,
    span_deg: float = 360.0,
) -> Rig:
    """Cameras evenly spaced on a circle, all looking at its axis; the first stands at 45 degrees.

    At 45 degrees from +z towards +x, so that four stand in the corners of a room. A span below 360
    makes it an arc about +z.
    """
    matrix = np.array(
        [
            [focal_px, 0.0, (size_px[0] - 1) / 2],
            [0.0, focal_px, (size_px[1] - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    angles = np.pi / 4 + 2 * np.pi * np.arange(count) / max(count, 1)
    if span_deg < 360.0:
        half = np.radians(span_deg) / 2
        angles = np.linspace(half, -half, count) if count > 1 else np.zeros(count)
    cameras = []
    for index, angle in enumerate(angles):
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
