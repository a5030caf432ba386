"""The paper's cost, eq. 1-16, in slow NumPy that reads like the paper: the kernels' second opinion.

Every term returns pairs (weighted residual vector, robust) whose ρ(‖r‖²) add up to its energy.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from derivatives import differences
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.geometry.camera import Rig
from fusecap.solve.options import SolverOptions
from fusecap.solve.pose_solver import ImuSites, Measurements

UNSEEN_PX = 1920.0


@dataclass
class Twin:
    shape: BodyShape
    rig: Rig
    landmarks: LandmarkSet
    prior: PosePrior
    data: Measurements
    sites: ImuSites = field(default_factory=ImuSites.none)
    options: SolverOptions = field(default_factory=SolverOptions)

    def bones_in_world(self, theta):
        """T^g_b as (rotation, translation) per bone: the product along the chain [eq. 1]."""
        transforms = []
        for bone, parent in enumerate(self.shape.skeleton.parents):
            local = np.eye(4)
            local[:3, :3] = Rotation.from_rotvec(theta[3 + 3 * bone : 6 + 3 * bone]).as_matrix()
            local[:3, 3] = theta[:3] if parent < 0 else self.shape.offsets_m[bone]
            transforms.append(local if parent < 0 else transforms[parent] @ local)
        return transforms

    def position(self, theta):
        bones = self.bones_in_world(theta)
        lam = self.options.weights.position
        for camera, keypoints in zip(self.rig.cameras, self.data.keypoints, strict=True):
            for bone, offset, (u, v, w) in zip(
                self.landmarks.bones(self.shape.skeleton),
                self.landmarks.offsets_m(self.shape),
                keypoints,
                strict=True,
            ):
                if not w > 0 or np.isnan(u + v):
                    continue
                target = (bones[bone] @ [*offset, 1.0])[:3]  # eq. 5
                pixel = camera.project(target[None])[0]  # eq. 6
                if np.isnan(pixel[0]) or (camera.rotation @ target + camera.translation)[2] < 0.05:
                    yield np.sqrt(lam * w) * np.array([UNSEEN_PX, 0.0]), True
                    continue
                scale = 1920.0 / camera.size_px[0]
                yield np.sqrt(lam * w) * scale * (pixel - [u, v]), True  # eq. 7

    def orientation(self, theta):
        bones = self.bones_in_world(theta)
        for bone, measured in zip(self.sites.bone, self.data.imu_rotation, strict=True):
            if np.isnan(measured[0, 0]):
                continue
            relative = bones[bone][:3, :3].T @ measured
            x, y, z, w = Rotation.from_matrix(relative).as_quat()
            vector = np.array([x, y, z]) * (1.0 if w >= 0 else -1.0)
            yield np.sqrt(self.options.weights.orientation) * vector, False  # eq. 10

    def acceleration(self, theta):
        bones = self.bones_in_world(theta)
        for i, bone in enumerate(self.sites.bone):
            site = (bones[bone] @ [*self.sites.position_m[i], 1.0])[:3]
            before, earlier = self.data.imu_history[:, i]
            solved = (site - 2 * before + earlier) / self.data.dt_s**2  # eq. 11
            residual = solved - self.data.imu_accel[i]
            if np.all(np.isfinite(residual)):
                yield np.sqrt(self.options.weights.acceleration) * residual, True  # eq. 13

    def projection(self, theta):
        x = theta[6:] - self.prior.mean
        basis = self.prior.basis
        yield np.sqrt(self.options.weights.projection) * (x - basis @ (basis.T @ x)), True  # 14

    def deviation(self, theta):
        x = theta[6:] - self.prior.mean
        scaled = self.prior.basis.T @ x / self.prior.sigma
        yield np.sqrt(self.options.weights.deviation) * scaled, True  # eq. 15

    def floor(self, theta):
        bones = self.bones_in_world(theta)
        for name in ("left_foot", "left_toes", "right_foot", "right_toes"):
            height = bones[self.shape.skeleton.bone(name)][1, 3]
            depth = max(0.0, self.options.floor_radius_m - height)
            yield np.sqrt(self.options.weights.floor) * np.array([depth]), False  # eq. 16

    TERMS = ("position", "orientation", "acceleration", "projection", "deviation", "floor")

    def residuals(self, theta):
        for term in self.TERMS:
            yield from getattr(self, term)(theta)

    def cost(self, theta):
        """½ Σ ρ(‖r‖²): Cauchy where robust, plain elsewhere [eq. 2]."""
        total = 0.0
        for r, robust in self.residuals(theta):
            s = float(r @ r)
            total += 0.5 * (np.log1p(s) if robust else s)
        return total

    def normal_equations(self, theta):
        """g and the reweighted Gauss-Newton H from central differences of every residual."""
        n = len(theta)
        centre = list(self.residuals(theta))
        stacked = differences(
            lambda delta: np.concatenate([r for r, _ in self.residuals(theta + delta)]), n
        )
        ends = np.cumsum([len(r) for r, _ in centre])[:-1]
        jacobians = np.split(stacked, ends)
        g, h = np.zeros(n), np.zeros((n, n))
        for (r, robust), jacobian in zip(centre, jacobians, strict=True):
            weight = 1 / (1 + r @ r) if robust else 1.0
            g += weight * jacobian.T @ r
            h += weight * jacobian.T @ jacobian
        return g, h
