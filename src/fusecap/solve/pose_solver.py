"""The cost of one body at one instant, minimised: the front of `fusecap.kernels.solve`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.believable import shaped_numbers
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.errors import InputError
from fusecap.geometry.camera import Rig
from fusecap.kernels import band, groups, uncertainty
from fusecap.kernels import solve as kernels
from fusecap.kernels.kinematics import forward
from fusecap.solve.options import SolverOptions
from fusecap.types import Status

_FLOOR_BONES = ("left_foot", "left_toes", "right_foot", "right_toes")
_NEAR_M = 0.5
UNKNOWN_RIDGE = 1e-3
"""Of the normal equations, [1/rad², 1/m²]: nothing is farther off than half a turn or 30 m."""


@dataclass(frozen=True, kw_only=True)
class ImuSites:
    """Where a subject's I sensors sit."""

    bone: tuple[int, ...]
    position_m: Float[np.ndarray, "i 3"]
    """t_ib in the bones' frames; used by the acceleration term only."""

    def __post_init__(self) -> None:
        if not (np.abs(shaped_numbers(self.position_m, (len(self.bone), 3), "sites")) <= 10).all():
            raise InputError("sites of sensors lie within 10 m of their bones' joints")

    @classmethod
    def none(cls) -> ImuSites:
        """A subject without sensors."""
        return cls(bone=(), position_m=np.zeros((0, 3)))


@dataclass(frozen=True, kw_only=True)
class Measurements:
    """The data of one solve, in the world; NaN or zero confidence is missing."""

    keypoints: Float[np.ndarray, "c k 3"]
    imu_rotation: Float[np.ndarray, "i 3 3"]
    """Measured bone orientations [1, eq. 8]."""
    imu_accel: Float[np.ndarray, "i 3"]
    """At the previous instant, without gravity [1, eq. 12]."""
    imu_history: Float[np.ndarray, "2 i 3"]
    """Solved sensor sites one and two instants ago."""
    dt_s: float


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Where a solve ended."""

    theta: Float[np.ndarray, " p"]
    position_in_world_m: Float[np.ndarray, "b 3"]
    rotation_in_world: Float[np.ndarray, "b 3 3"]
    status: Status
    iterations: int
    cost: float


class PoseSolver:
    """Minimises eq. 2 for one subject.

    It owns every array the kernel needs, so a solve allocates nothing but its result. One thread
    per solver at a time; several solvers run in parallel.
    """

    def __init__(
        self,
        *,
        shape: BodyShape,
        rig: Rig,
        landmarks: LandmarkSet,
        prior: PosePrior,
        sites: ImuSites | None = None,
        options: SolverOptions | None = None,
    ) -> None:
        skeleton = shape.skeleton
        if prior.mean.size != 3 * skeleton.bone_count - 3:
            raise InputError(
                f"the prior '{prior.skeleton_name}' has {prior.mean.size} numbers; "
                f"'{skeleton.name}' needs {3 * skeleton.bone_count - 3}"
            )
        worn = (sites or ImuSites.none()).bone
        if not all(0 <= bone < skeleton.bone_count for bone in worn):
            raise InputError(
                f"sensors on bones {worn}; '{skeleton.name}' has {skeleton.bone_count}"
            )
        self.skeleton = skeleton
        self.landmarks = landmarks
        self.options = options or SolverOptions()
        self.sites = sites or ImuSites.none()
        self._rig = rig.packed
        self._landmark_bone = landmarks.bones(skeleton)
        self._sensors = groups.SensorSites(
            bone=np.array(self.sites.bone, dtype=np.int64), offset=self.sites.position_m
        )
        self._present = np.zeros(len(self.sites.bone))
        self._prior = groups.Prior(
            mean=prior.mean, projector=prior.projector, precision=prior.precision
        )
        self._acceleration = prior.acceleration
        feet = [skeleton.bone(name) for name in _FLOOR_BONES]
        self._floor = groups.Floor(
            bone=np.array(feet, dtype=np.int64),
            radius=self.options.floor_radius_m,
            resting=np.array([*feet, 0], dtype=np.int64),
        )
        n, b = skeleton.pose_size, skeleton.bone_count
        self._posed = groups.Posed(
            position=np.zeros((b, 3)), rotation=np.zeros((b, 3, 3)), twist=np.zeros((b, 3, 3))
        )
        self._gathered = groups.Gathered(information=np.zeros((b, 6, 6)), gradient=np.zeros((b, 6)))
        self._scratch = groups.Scratch(
            local=np.zeros((3, 3)),
            information=np.zeros((3, 3)),
            gradient=np.zeros(3),
            motion=np.zeros((b, 6, 3)),
            force=np.zeros((6, 3)),
        )
        self._hessian = np.zeros((2, n, n))
        self._gradient = np.zeros((2, n))
        self._lower = np.zeros((n, n))
        self._inverse = np.zeros((n, n))
        self._covariances = np.zeros((uncertainty.ROOM, n, n))
        self._chain = np.zeros((6, n))
        self._vectors = (np.zeros(n), np.zeros(n), np.zeros(n))
        self.set_shape(shape)

    def set_shape(self, shape: BodyShape, landmark_offsets_m: np.ndarray | None = None) -> None:
        """Change bone lengths, and landmark offsets (by default those of the stature)."""
        self.shape = shape
        if landmark_offsets_m is None:
            landmark_offsets_m = self.landmarks.offsets_m(shape)
        self.landmark_offsets_m = np.ascontiguousarray(landmark_offsets_m, dtype=np.float64)
        weights = self.options.weights
        self.model = groups.Model(
            weights=groups.TermWeights(
                *(float(getattr(weights, name)) for name in groups.TermWeights._fields)
            ),
            body=groups.Body(
                parents=self.skeleton.parent_array,
                offsets=np.ascontiguousarray(shape.offsets_m, dtype=np.float64),
            ),
            landmarks=groups.Landmarks(
                bone=self._landmark_bone, offset=self.landmark_offsets_m, cameras=self._rig
            ),
            sensors=self._sensors,
            prior=self._prior,
            floor=self._floor,
        )
        self._plain_model = groups.plain(self.model)
        self._plain_room = groups.plain((self._posed, self._gathered, self._scratch))

    def solve(self, theta: Float[np.ndarray, " p"], data: Measurements) -> Solution:
        """Minimise from `theta`; always returns finite numbers when `theta` is finite."""
        options = self.options
        result = np.array(theta, dtype=np.float64)
        status, iterations, cost = kernels.solve(
            result,
            options.max_iterations,
            options.function_tolerance,
            options.initial_damping,
            self._inputs(data),
            self._hessian,
            self._gradient,
            self._lower,
            *self._vectors,
        )
        return Solution(
            theta=result,
            position_in_world_m=self._posed.position.copy(),
            rotation_in_world=self._posed.rotation.copy(),
            status=Status(status),
            iterations=iterations,
            cost=cost,
        )

    def posed(
        self, theta: Float[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b 3 3"]]:
        """Joint positions [m] and rotations in the world."""
        forward(theta, self.model.body, self._posed, self._scratch)
        return self._posed.position.copy(), self._posed.rotation.copy()

    def cost(self, theta: Float[np.ndarray, " p"], data: Measurements) -> float:
        """Of a pose at this instant alone."""
        return kernels.evaluate(
            np.ascontiguousarray(theta, dtype=np.float64),
            self.model,
            self._measured(data),
            self._posed,
            self._gathered,
            self._scratch,
            self._hessian[0],
            self._gradient[0],
        )

    def evaluate(
        self, theta: Float[np.ndarray, " p"], data: Measurements
    ) -> tuple[float, Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Cost, gradient and Gauss-Newton matrix at `theta`, for checks and for other solvers."""
        cost = self.cost(theta, data)
        lower = np.tril(self._hessian[0])
        return cost, self._gradient[0].copy(), lower + np.tril(lower, -1).T

    def _inputs(self, data: Measurements) -> tuple[object, ...]:
        """What `kernels.solve` takes, in its order."""
        return (self._plain_model, tuple(self._measured(data)), *self._plain_room)

    def _measured(self, data: Measurements) -> groups.Measured:
        expected = (len(self._rig), len(self._landmark_bone), 3)
        if data.keypoints.shape != expected:
            raise InputError(f"keypoints are {data.keypoints.shape}; expected {expected}")
        self._present[:] = np.isfinite(data.imu_rotation[:, 0, 0])
        return groups.Measured(
            keypoints=data.keypoints,
            rotation=data.imu_rotation,
            present=self._present,
            accel=data.imu_accel,
            history=data.imu_history,
            dt=data.dt_s,
        )

    def weighed(
        self, keypoints: Float[np.ndarray, "c k 3"], root_m: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "c k 3"]:
        """Keypoints of somebody about there, with confidences less where the image is large.

        By `Weights.growth`; a camera that somebody stands behind keeps its own.
        """
        rig, growth = self._rig, self.options.weights.growth
        if not growth or not len(rig):
            return keypoints
        depth_m = rig[:, 6:9] @ root_m + rig[:, 11]
        px_per_m = rig[:, 21] * rig[:, 12] / np.maximum(depth_m, _NEAR_M)
        share = np.where(depth_m > _NEAR_M, 1.0 / (1.0 + growth * px_per_m**2), 1.0)
        weighed = keypoints.copy()
        weighed[:, :, 2] *= share[:, None]
        return weighed

    @property
    def view_shape(self) -> tuple[int, int]:
        """How many cameras and landmarks keypoints come from."""
        return len(self._rig), len(self._landmark_bone)

    @property
    def steadiness(self) -> Float[np.ndarray, " n"]:
        """(1 + B,) of the root's place and every joint: one over their mean square acceleration."""
        return self._acceleration**-2.0

    def spread(self) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
        """Traces [rad², m²] of what the last solve, alone, says of bones' turns and joints.

        NaN where its matrix is not positive.
        """
        turn, place = np.full((2, self.skeleton.bone_count), np.nan)
        lower, square = self._hessian[1], self._scratch.local
        lower[:] = self._hessian[0] + UNKNOWN_RIDGE * np.eye(len(lower))
        if band.factor(lower, square):
            uncertainty.newest(lower, self._inverse, self._covariances, square)
            uncertainty.spread(
                self.model.body, self._posed, self._inverse, self._chain, turn, place
            )
        return turn, place
