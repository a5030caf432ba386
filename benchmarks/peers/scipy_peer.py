"""The same cost for scipy.optimize.least_squares, in vectorised NumPy.

SciPy's own losses act on single numbers; ours act on the norm of a vector. A vector r with s = ‖r‖²
is therefore handed over as r √(log(1 + s)/s), whose square is the robust cost itself.
"""

from __future__ import annotations

import numpy as np
from pose_problem import Problems
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

_UNSEEN_PX = 1920.0
_NEAR_M = 0.05


class ScipyProblem:
    """One frame of `problems`."""

    def __init__(self, problems: Problems, frame: int) -> None:
        self._p = problems.shared
        self._data = problems.measurements(frame)
        self.start = problems.frames["start"][frame]
        self._tolerance = float(self._p["function_tolerance"][0])
        self._parents = self._p["parents"].astype(int)
        self._landmark_bone = self._p["landmark_bone"].astype(int)
        self._imu_bone = self._p["imu_bone"].astype(int)
        self._floor_bone = self._p["floor_bone"].astype(int)
        rows = self._p["cameras_packed"]
        self._camera_rotation = rows[:, :9].reshape(-1, 3, 3)
        self._camera = rows[:, 9:, None].swapaxes(0, 1)
        keypoints = self._data.keypoints
        self._seen = (keypoints[:, :, 2] > 0) & np.isfinite(keypoints[:, :, :2].sum(axis=2))
        self._keypoints = np.where(self._seen[:, :, None], keypoints, 0.0)
        self._oriented = np.isfinite(self._data.imu_rotation[:, 0, 0])
        self._measured = Rotation.from_matrix(self._data.imu_rotation[self._oriented])

    def solve(self) -> OptimizeResult:
        """With its default method and derivatives by differences."""
        return least_squares(self.residuals, self.start, ftol=self._tolerance)

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """½ ‖residuals‖² is the cost of eq. 2."""
        position, rotation = self._posed(theta)
        weights = self._p["weights"]
        x = theta[6:] - self._p["prior_mean"]
        inside = self._p["prior_basis"].T @ x
        parts = [
            _robust(np.sqrt(weights[3]) * (x - self._p["prior_basis"] @ inside)[None]),
            _robust(np.sqrt(weights[4]) * (inside / self._p["prior_sigma"])[None]),
            self._position(position, rotation),
            self._orientation(rotation),
            np.sqrt(weights[5])
            * np.maximum(0.0, self._p["floor_radius_m"] - position[self._floor_bone, 1]),
        ]
        if weights[2] > 0:
            parts.append(self._acceleration(position, rotation))
        return np.concatenate(parts)

    def _posed(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        local = Rotation.from_rotvec(theta[3:].reshape(-1, 3)).as_matrix()
        position, rotation = np.empty((len(local), 3)), np.empty_like(local)
        position[0], rotation[0] = theta[:3], local[0]
        for bone, parent in enumerate(self._parents[1:], start=1):
            rotation[bone] = rotation[parent] @ local[bone]
            position[bone] = position[parent] + rotation[parent] @ self._p["offsets_m"][bone]
        return position, rotation

    def _position(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        bone = self._landmark_bone
        offset = self._p["landmark_offset_m"][:, :, None]
        points = position[bone] + (rotation[bone] @ offset)[:, :, 0]
        tx, ty, tz, fx, fy, cx, cy, k1, k2, p1, p2, k3, scale, max_r2, _ = self._camera
        in_camera = np.einsum("cij,kj->ick", self._camera_rotation, points)
        z = in_camera[2] + tz
        imaged = z > _NEAR_M
        z = np.where(imaged, z, 1.0)
        a, b = (in_camera[0] + tx) / z, (in_camera[1] + ty) / z
        r2 = a * a + b * b
        imaged &= r2 <= max_r2
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + cx
        v = fy * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + cy
        r = np.stack([u, v], axis=2) - self._keypoints[:, :, :2]
        r = np.where(imaged[:, :, None], scale[:, :, None] * r, [_UNSEEN_PX, 0.0])
        r *= np.sqrt(self._p["weights"][0] * self._keypoints[:, :, 2:])
        return _robust(r[self._seen])

    def _orientation(self, rotation: np.ndarray) -> np.ndarray:
        bones = Rotation.from_matrix(rotation[self._imu_bone[self._oriented]])
        xyzw = (bones.inv() * self._measured).as_quat(canonical=True)
        return np.sqrt(self._p["weights"][1]) * xyzw[:, :3].ravel()

    def _acceleration(self, position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        bone = self._imu_bone
        site = position[bone] + (rotation[bone] @ self._p["imu_offset_m"][:, :, None])[:, :, 0]
        before, earlier = self._data.imu_history
        r = (site - 2 * before + earlier) / self._data.dt_s**2 - self._data.imu_accel
        return _robust(np.sqrt(self._p["weights"][2]) * r[np.isfinite(r).all(axis=1)])


def _robust(r: np.ndarray) -> np.ndarray:
    s = np.sum(r * r, axis=-1, keepdims=True)
    return (r * np.sqrt(np.log1p(s) / np.maximum(s, 1e-300))).ravel()
