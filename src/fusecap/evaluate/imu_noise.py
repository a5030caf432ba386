"""What body-worn IMUs would have measured, and what a calibration makes of it.

A sensor sits on its bone turned by `bone_from_imu`. Its own fusion reports imu_world_from_imu, with
a heading that is off and drifts and an error that wanders; its accelerometer measures specific
force. The flesh under it yields: it falls behind when the bone turns, and tilts when the bone is
accelerated across its length. The calibration believes a mounting that is off by a constant as
well, so eq. 8 and 12 give the bone's rotation and acceleration with all of these errors in them.

The sensor is an InvenSense MPU-9250 (data sheet PS-MPU-9250A-01, rev. 1.0): 8 mg rms of noise on
the accelerometer and 0.1 deg/s rms on the gyroscope behind filters of 94 and 92 Hz. Its orientation
is as good as fusion is said to make it: 2 deg rms in motion (Xsens, MTi and MTx user manual,
MT0100P rev. N, sec. 4.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape, end_offsets_m
from fusecap.evaluate.noise import bursts, correlated_noise
from fusecap.geometry.quaternions import to_wxyz
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.synchronizer import MountedImu, resample_imus
from fusecap.types import GRAVITY_M_S2, ImuReading

IMUS_13 = (
    "hips",
    "spine3",
    "head",
    "left_upper_arm",
    "right_upper_arm",
    "left_forearm",
    "right_forearm",
    "left_thigh",
    "right_thigh",
    "left_shank",
    "right_shank",
    "left_foot",
    "right_foot",
)
"""Pelvis, sternum, head, upper arms, forearms, thighs, shanks, feet."""

IMUS_6 = ("hips", "head", "left_forearm", "right_forearm", "left_shank", "right_shank")
"""The sparse set."""

GRAVITY_IN_WORLD_M_S2 = np.array([0.0, GRAVITY_M_S2, 0.0])
"""Specific force at rest."""


@dataclass(frozen=True, kw_only=True)
class ImuNoise:
    """Errors of a sensor and of its calibration; angles, rates and biases are standard deviations.

    A share is a probability per sample; its seconds are the mean run.
    """

    misalignment_deg: float = 3.0
    """About each axis of the mounting, constant."""
    heading_deg: float = 3.0
    """About up, constant per sensor."""
    heading_drift_deg_min: float = 1.0
    """About up, per minute, constant per sensor."""
    orientation_deg: float = 1.15
    """About each axis, wandering."""
    correlation_s: float = 2.0
    tissue_lag_s: float = 0.008
    """How far the flesh turns back: times the bone's angular velocity."""
    tissue_deg_per_m_s2: float = 0.2
    """How far the flesh tilts: times the acceleration across the bone."""
    tissue_s: float = 0.04
    """Time the flesh takes to yield."""
    gyro_deg_s: float = 0.1
    """Per axis, white."""
    accel_m_s2: float = 0.08
    """Per axis, white."""
    accel_bias_m_s2: float = 0.05
    """Per axis, constant."""
    lost_share: float = 0.005
    """Of samples, lost on the radio."""
    lost_s: float = 0.05
    clock_s: float = 0.0
    """Constant error of each subject's clock, which nobody knows of."""

    def scaled(self, factor: float) -> ImuNoise:
        """All errors of orientation larger by a factor; the rest as it is."""
        return replace(
            self,
            misalignment_deg=self.misalignment_deg * factor,
            heading_deg=self.heading_deg * factor,
            heading_drift_deg_min=self.heading_drift_deg_min * factor,
            orientation_deg=self.orientation_deg * factor,
            tissue_lag_s=self.tissue_lag_s * factor,
            tissue_deg_per_m_s2=self.tissue_deg_per_m_s2 * factor,
        )


NO_IMU_NOISE = ImuNoise(
    misalignment_deg=0.0,
    heading_deg=0.0,
    heading_drift_deg_min=0.0,
    orientation_deg=0.0,
    tissue_lag_s=0.0,
    tissue_deg_per_m_s2=0.0,
    gyro_deg_s=0.0,
    accel_m_s2=0.0,
    accel_bias_m_s2=0.0,
    lost_share=0.0,
)


@dataclass(frozen=True, kw_only=True)
class SimulatedImus:
    """The I sensors of one subject over T frames, as measured, and their calibration."""

    bones: tuple[str, ...]
    times_s: Float[np.ndarray, " t"]
    """As their clock has it."""
    received: Bool[np.ndarray, "t i"]
    """Which samples were not lost."""
    world_from_imu: Float[np.ndarray, "t i 3 3"]
    """As the sensors report it; their world is ours, but for the heading."""
    accel_m_s2: Float[np.ndarray, "t i 3"]
    """Specific force in the imu frame."""
    gyro_rad_s: Float[np.ndarray, "t i 3"]
    """Angular velocity in the imu frame."""
    bone_from_imu: Float[np.ndarray, "i 3 3"]
    """As the calibration believes it."""
    position_in_bone_m: Float[np.ndarray, "i 3"]
    mounting: Float[np.ndarray, "i 3 3"]
    """bone_from_imu as it truly is, between bone and sensor at rest."""
    heading_rad: Float[np.ndarray, "t i"]
    """How far the sensor's world is truly turned about up against ours, with its drift."""

    def subset(self, bones: Sequence[str]) -> SimulatedImus:
        """The sensors on the named bones, in the order they are in."""
        kept = [index for index, bone in enumerate(self.bones) if bone in bones]
        return SimulatedImus(
            bones=tuple(self.bones[index] for index in kept),
            times_s=self.times_s,
            received=self.received[:, kept],
            world_from_imu=self.world_from_imu[:, kept],
            accel_m_s2=self.accel_m_s2[:, kept],
            gyro_rad_s=self.gyro_rad_s[:, kept],
            bone_from_imu=self.bone_from_imu[kept],
            position_in_bone_m=self.position_in_bone_m[kept],
            mounting=self.mounting[kept],
            heading_rad=self.heading_rad[:, kept],
        )

    def orientation_wxyz(self, sensor: int) -> Float[np.ndarray, "t 4"]:
        """imu_world_from_imu of one sensor, w >= 0."""
        return to_wxyz(Rotation.from_matrix(self.world_from_imu[:, sensor]))

    def readings(self) -> tuple[ImuReading, ...]:
        """What the solver is given, per frame, as from a session's files [1, eq. 8, 12]."""
        mounted = []
        for sensor, bone in enumerate(self.bones):
            kept = self.received[:, sensor]
            mounted.append(
                MountedImu(
                    bone=bone,
                    track=ImuTrack(
                        times_s=self.times_s[kept],
                        orientation_wxyz=self.orientation_wxyz(sensor)[kept],
                        accel_m_s2=self.accel_m_s2[kept, sensor],
                    ),
                    world_from_imu_world=np.eye(3),
                    bone_from_imu=self.bone_from_imu[sensor],
                    position_in_bone_m=self.position_in_bone_m[sensor],
                )
            )
        rotation, accel = resample_imus(mounted, self.times_s)
        return tuple(
            ImuReading(bone_rotation_in_world=r, accel_in_world_m_s2=a)
            for r, a in zip(rotation, accel, strict=True)
        )


def measure(
    rng: np.random.Generator,
    shape: BodyShape,
    theta: Float[np.ndarray, "t p"],
    bones: tuple[str, ...],
    noise: ImuNoise,
    rate_hz: float,
) -> SimulatedImus:
    """Sensors half-way along `bones`, mounted any way round."""
    position_in_world_m, rotation_in_world = forward_kinematics(shape, theta)
    frames, count = len(theta), len(bones)
    times_s = np.arange(frames) / rate_hz
    index = [shape.skeleton.bone(name) for name in bones]
    bone_rotation = rotation_in_world[:, index]
    at = np.array([_middle_m(shape, bone) for bone in index]).reshape(count, 3)
    place = position_in_world_m[:, index] + np.einsum("tijk,ik->tij", bone_rotation, at)
    accel = _acceleration(place, rate_hz)
    turning = _angular_velocity(bone_rotation, rate_hz)

    mounting = Rotation.from_quat(rng.standard_normal((count, 4))).as_matrix()
    flesh = _tissue(noise, at, np.einsum("tikj,tik->tij", bone_rotation, accel), turning, rate_hz)
    world_from_imu = bone_rotation @ _rotation(flesh) @ mounting
    specific_force = np.einsum("tikj,tik->tij", world_from_imu, accel + GRAVITY_IN_WORLD_M_S2)
    specific_force += noise.accel_bias_m_s2 * rng.standard_normal((count, 3))
    specific_force += noise.accel_m_s2 * rng.standard_normal((frames, count, 3))
    gyro = np.einsum("ikj,tik->tij", mounting, turning)
    gyro += np.radians(noise.gyro_deg_s) * rng.standard_normal((frames, count, 3))

    heading = np.zeros((frames, count, 3))
    heading[..., 1] = np.radians(noise.heading_deg) * rng.standard_normal(count)
    drift_rad_s = np.radians(noise.heading_drift_deg_min) / 60.0 * rng.standard_normal(count)
    heading[..., 1] += np.outer(times_s, drift_rad_s)
    wander = correlated_noise(rng, frames, (count, 3), noise.correlation_s * rate_hz)
    wander *= np.radians(noise.orientation_deg)
    misalignment = np.radians(noise.misalignment_deg) * rng.standard_normal((count, 3))
    lost = bursts(rng, frames, (count,), share=noise.lost_share, mean_frames=noise.lost_s * rate_hz)
    # A track has a first and a last sample.
    lost[[0, -1]] = False
    return SimulatedImus(
        bones=bones,
        times_s=times_s,
        received=~lost,
        world_from_imu=_rotation(heading) @ world_from_imu @ _rotation(wander),
        accel_m_s2=specific_force,
        gyro_rad_s=gyro,
        bone_from_imu=_rotation(misalignment) @ mounting,
        position_in_bone_m=at,
        mounting=mounting,
        heading_rad=heading[..., 1],
    )


def _tissue(
    noise: ImuNoise,
    along: Float[np.ndarray, "i 3"],
    accel_in_bone_m_s2: Float[np.ndarray, "t i 3"],
    turning_rad_s: Float[np.ndarray, "t i 3"],
    rate_hz: float,
) -> Float[np.ndarray, "t i 3"]:
    """How the flesh under a sensor is turned against the bone [rad], in the bone's frame."""
    axis = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    wanted = -noise.tissue_lag_s * turning_rad_s
    tilt = np.radians(noise.tissue_deg_per_m_s2)
    wanted -= tilt * np.cross(np.broadcast_to(axis, accel_in_bone_m_s2.shape), accel_in_bone_m_s2)
    follow = 1.0 - np.exp(-1.0 / max(noise.tissue_s * rate_hz, 1e-9))
    turned = wanted.copy()
    for frame in range(1, len(wanted)):
        turned[frame] = turned[frame - 1] + follow * (wanted[frame] - turned[frame - 1])
    return turned


def _angular_velocity(
    rotation: Float[np.ndarray, "t i 3 3"], rate_hz: float
) -> Float[np.ndarray, "t i 3"]:
    """In the turning frame [rad/s]; central differences, the ends repeat their neighbours'."""
    velocity = np.zeros(rotation.shape[:3])
    if len(rotation) >= 3:
        step = np.swapaxes(rotation[:-2], -1, -2) @ rotation[2:]
        turn = Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec()
        velocity[1:-1] = turn.reshape(velocity[1:-1].shape) * rate_hz / 2
        velocity[0], velocity[-1] = velocity[1], velocity[-2]
    return velocity


def _middle_m(shape: BodyShape, bone: int) -> Float[np.ndarray, "3"]:
    """Half-way from a bone's joint to its first child's, or to its end."""
    children = shape.skeleton.children(bone)
    if children:
        return 0.5 * shape.offsets_m[children[0]]
    return 0.5 * end_offsets_m(shape)[shape.skeleton.bone_names[bone]]


def _acceleration(place: Float[np.ndarray, "t i 3"], rate_hz: float) -> Float[np.ndarray, "t i 3"]:
    """Second central difference; the first and last frame repeat their neighbours'."""
    accel = np.zeros_like(place)
    if len(place) >= 3:
        accel[1:-1] = (place[2:] - 2 * place[1:-1] + place[:-2]) * rate_hz**2
        accel[0], accel[-1] = accel[1], accel[-2]
    return accel


def _rotation(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vectors.shape, 3)
