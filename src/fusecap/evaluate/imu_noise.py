"""What body-worn IMUs would have measured, and what a calibration makes of it.

A sensor sits on its bone turned by `bone_from_imu`. Its own fusion reports imu_world_from_imu, with
a heading that is off by a constant and an error that wanders; its accelerometer measures specific
force. The calibration believes a mounting that is off by a constant as well, so eq. 8 and 12 give
the bone's rotation and acceleration with all of these errors in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape, end_offsets_m
from fusecap.evaluate.noise import correlated_noise
from fusecap.sources.imu_files.track import GRAVITY_M_S2
from fusecap.types import ImuReading

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
    """Errors of a sensor and of its calibration; angles and biases are standard deviations."""

    misalignment_deg: float = 3.0
    """About each axis of the mounting, constant."""
    heading_deg: float = 3.0
    """About up, constant per sensor."""
    orientation_deg: float = 0.7
    """About each axis, wandering."""
    correlation_s: float = 2.0
    accel_m_s2: float = 0.1
    """Per axis, white."""
    accel_bias_m_s2: float = 0.05
    """Per axis, constant."""


NO_IMU_NOISE = ImuNoise(
    misalignment_deg=0.0,
    heading_deg=0.0,
    orientation_deg=0.0,
    accel_m_s2=0.0,
    accel_bias_m_s2=0.0,
)


@dataclass(frozen=True, kw_only=True)
class SimulatedImus:
    """The I sensors of one subject over T frames, as measured, and their calibration."""

    bones: tuple[str, ...]
    world_from_imu: Float[np.ndarray, "t i 3 3"]
    """As the sensors report it; their world is ours, but for the heading."""
    accel_m_s2: Float[np.ndarray, "t i 3"]
    """Specific force in the imu frame."""
    bone_from_imu: Float[np.ndarray, "i 3 3"]
    """As the calibration believes it."""
    position_in_bone_m: Float[np.ndarray, "i 3"]

    def subset(self, bones: Sequence[str]) -> SimulatedImus:
        """The sensors on the named bones, in the order they are in."""
        kept = [index for index, bone in enumerate(self.bones) if bone in bones]
        return SimulatedImus(
            bones=tuple(self.bones[index] for index in kept),
            world_from_imu=self.world_from_imu[:, kept],
            accel_m_s2=self.accel_m_s2[:, kept],
            bone_from_imu=self.bone_from_imu[kept],
            position_in_bone_m=self.position_in_bone_m[kept],
        )

    def readings(self) -> tuple[ImuReading, ...]:
        """What the solver is given, per frame [1, eq. 8, 12]."""
        rotation = self.world_from_imu @ np.swapaxes(self.bone_from_imu, 1, 2)
        accel = np.einsum("tijk,tik->tij", self.world_from_imu, self.accel_m_s2)
        accel = accel - GRAVITY_IN_WORLD_M_S2
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
    index = [shape.skeleton.bone(name) for name in bones]
    bone_rotation = rotation_in_world[:, index]
    at = np.array([_middle_m(shape, bone) for bone in index])
    place = position_in_world_m[:, index] + np.einsum("tijk,ik->tij", bone_rotation, at)

    bone_from_imu = Rotation.from_quat(rng.standard_normal((count, 4))).as_matrix()
    world_from_imu = bone_rotation @ bone_from_imu
    specific_force = np.einsum(
        "tikj,tik->tij", world_from_imu, _acceleration(place, rate_hz) + GRAVITY_IN_WORLD_M_S2
    )
    specific_force += noise.accel_bias_m_s2 * rng.standard_normal((count, 3))
    specific_force += noise.accel_m_s2 * rng.standard_normal((frames, count, 3))

    heading = np.zeros((count, 3))
    heading[:, 1] = np.radians(noise.heading_deg) * rng.standard_normal(count)
    wander = correlated_noise(rng, frames, (count, 3), noise.correlation_s * rate_hz)
    wander *= np.radians(noise.orientation_deg)
    misalignment = np.radians(noise.misalignment_deg) * rng.standard_normal((count, 3))
    return SimulatedImus(
        bones=bones,
        world_from_imu=_rotation(heading) @ world_from_imu @ _rotation(wander),
        accel_m_s2=specific_force,
        bone_from_imu=_rotation(misalignment) @ bone_from_imu,
        position_in_bone_m=at,
    )


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
