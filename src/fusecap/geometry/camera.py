"""Calibrated cameras: OpenCV's pinhole with radial and tangential distortion.

    point_in_cam = rotation @ point_in_world + translation          x right, y down, z forward
    x = X/Z, y = Y/Z, r² = x² + y²
    x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2x²)
    y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + p1 (r² + 2y²) + 2 p2 x y
    u = fx x' + cx, v = fy y' + cy                                  pixel (0, 0) is a pixel's centre

A radial polynomial folds back far outside the image; beyond that radius a point counts as not
imaged, like one behind the camera.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from fusecap.errors import CalibrationError, nearest

REFERENCE_WIDTH_PX = 1920.0
"""Residuals are scaled to an image this wide, so that weights do not depend on resolution."""

MOST, MOST_PX = 1e9, 1_000_000
"""Of any number of a camera, and of the sides of its picture."""
PACKED_SIZE = 24
"""Length of `Camera.packed`: R (9), t (3), fx fy cx cy, k1 k2 p1 p2 k3, scale, r²max, 0."""


MOST_CAMERAS = 1024
"""Of a rig: pairs of them are compared."""


@dataclass(frozen=True, kw_only=True)
class Camera:
    """One calibrated view."""

    name: str
    size_px: tuple[int, int]
    """Width, height."""
    matrix: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    """k1, k2, p1, p2, k3."""
    rotation: Float[np.ndarray, "3 3"]
    """cam_from_world."""
    translation: Float[np.ndarray, "3"]
    """Of cam_from_world [m]."""

    def __post_init__(self) -> None:
        for field in ("matrix", "distortion", "rotation", "translation"):
            values = np.abs(getattr(self, field))
            if not np.all(np.isfinite(values)):
                raise CalibrationError(f"camera '{self.name}': {field} is not a number")
            if values.max() > MOST:
                raise CalibrationError(
                    f"camera '{self.name}': {field} has {values.max():g}, expected at most {MOST:g}"
                )
        if not all(2 <= side <= MOST_PX for side in self.size_px):
            raise CalibrationError(f"camera '{self.name}': image size is {self.size_px}")
        if self.matrix[0, 0] <= 0 or self.matrix[1, 1] <= 0:
            raise CalibrationError(
                f"camera '{self.name}': focal lengths are {self.matrix[0, 0]:g}, "
                f"{self.matrix[1, 1]:g} px; both must be positive"
            )
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-3):
            raise CalibrationError(f"camera '{self.name}': the rotation is not orthonormal")
        if np.linalg.det(self.rotation) < 0:
            raise CalibrationError(
                f"camera '{self.name}': the rotation mirrors the world (determinant -1); "
                "an axis of the calibration has its sign flipped"
            )

    @property
    def position_in_world(self) -> Float[np.ndarray, "3"]:
        """Centre of projection [m]."""
        return -self.rotation.T @ self.translation

    def turned(self, clockwise_deg: int) -> Camera:
        """The same view of pictures that were turned clockwise by 0, 90, 180 or 270 degrees."""
        if clockwise_deg == 0:
            return self
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        (width, height), (fx, fy) = self.size_px, np.diag(self.matrix)[:2]
        k1, k2, p1, p2, k3 = self.distortion
        once = Camera(
            name=self.name,
            size_px=(height, width),
            matrix=np.array(
                [[fy, 0.0, height - 1 - self.matrix[1, 2]], [0.0, fx, self.matrix[0, 2]], [0, 0, 1]]
            ),
            distortion=np.array([k1, k2, p2, -p1, k3]),
            rotation=quarter @ self.rotation,
            translation=quarter @ self.translation,
        )
        return once.turned(clockwise_deg - 90)

    @property
    def pixel_scale(self) -> float:
        """Multiplies residuals, see `REFERENCE_WIDTH_PX`."""
        return REFERENCE_WIDTH_PX / self.size_px[0]

    @cached_property
    def max_radius_squared(self) -> float:
        """r² up to which distortion is one-to-one; infinite without distortion."""
        k1, k2, _, _, k3 = np.where(np.abs(self.distortion) < 1e-12, 0.0, self.distortion)
        roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
        folds = [r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0]
        return float(min(folds)) if folds else np.inf

    @cached_property
    def packed(self) -> Float[np.ndarray, "24"]:
        """Everything the kernels need, in one row (see `PACKED_SIZE`)."""
        m = self.matrix
        return np.concatenate(
            [
                self.rotation.ravel(),
                self.translation,
                [m[0, 0], m[1, 1], m[0, 2], m[1, 2]],
                self.distortion,
                [self.pixel_scale, self.max_radius_squared, 0.0],
            ]
        ).astype(np.float64)

    def project(self, points_in_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Pixels; NaN for points that this camera cannot image."""
        point = points_in_world @ self.rotation.T + self.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = point[:, 0] / point[:, 2], point[:, 1] / point[:, 2]
            distorted = self._distort(x, y)
        pixels = distorted * [self.matrix[0, 0], self.matrix[1, 1]] + self.matrix[:2, 2]
        imaged = (point[:, 2] > 1e-6) & (x * x + y * y <= self.max_radius_squared)
        return np.where(imaged[:, None], pixels, np.nan)

    def undistort(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Normalised image coordinates (X/Z, Y/Z) of pixels, by fixed-point iteration."""
        target = (pixels - self.matrix[:2, 2]) / [self.matrix[0, 0], self.matrix[1, 1]]
        if not self.distortion.any():
            return target
        xy = target.copy()
        for _ in range(20):
            xy += target - self._distort(xy[:, 0], xy[:, 1])
        return xy

    def _distort(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )


@dataclass(frozen=True, kw_only=True)
class Rig:
    """The cameras of a session, in the order of its keypoints."""

    cameras: tuple[Camera, ...]

    def __post_init__(self) -> None:
        if len(self.cameras) > MOST_CAMERAS:
            raise CalibrationError(
                f"{len(self.cameras)} cameras; at most {MOST_CAMERAS} are read: keep those in use"
            )
        counts = Counter(camera.name for camera in self.cameras)
        doubled = sorted(name for name, count in counts.items() if count > 1)
        if doubled:
            raise CalibrationError(f"two cameras are called {', '.join(doubled)}")

    def __len__(self) -> int:
        return len(self.cameras)

    @property
    def names(self) -> tuple[str, ...]:
        """Camera names in order."""
        return tuple(camera.name for camera in self.cameras)

    def __getitem__(self, name: str) -> Camera:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise CalibrationError(f"the calibration has no camera '{name}'{nearest(name, self.names)}")

    @cached_property
    def packed(self) -> Float[np.ndarray, "c 24"]:
        """One packed row per camera for the kernels."""
        if not self.cameras:
            return np.zeros((0, PACKED_SIZE))
        return np.stack([camera.packed for camera in self.cameras])

    def subset(self, names: Sequence[str]) -> Rig:
        """The named cameras, in the given order."""
        return Rig(cameras=tuple(self[name] for name in names))

    def in_world(self, new_from_old: Float[np.ndarray, "3 3"]) -> Rig:
        """The same cameras after the world's axes were rotated."""
        return Rig(
            cameras=tuple(
                Camera(
                    name=camera.name,
                    size_px=camera.size_px,
                    matrix=camera.matrix,
                    distortion=camera.distortion,
                    rotation=camera.rotation @ new_from_old.T,
                    translation=camera.translation,
                )
                for camera in self.cameras
            )
        )


Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotates a z-up world into ours: x stays, z becomes y, y becomes -z."""
