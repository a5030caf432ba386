"""Changes of the world: turned, moved and, with a scale, enlarged."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Camera, Rig


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """new = scale * rotation @ old + translation."""

    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    translation_m: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0

    def points(self, points_in_old: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """The points in the new world."""
        return self.scale * points_in_old @ self.rotation.T + self.translation_m

    def rig(self, rig: Rig) -> Rig:
        """The cameras in the new world; they see what they saw."""
        return Rig(cameras=tuple(self._camera(camera) for camera in rig.cameras))

    def after(self, first: Similarity) -> Similarity:
        """Both as one: `first`, then this."""
        return Similarity(
            rotation=self.rotation @ first.rotation,
            translation_m=self.points(first.translation_m),
            scale=self.scale * first.scale,
        )

    @property
    def angle_deg(self) -> float:
        """How far the axes turn."""
        return float(np.degrees(np.linalg.norm(Rotation.from_matrix(self.rotation).as_rotvec())))

    def _camera(self, camera: Camera) -> Camera:
        rotation = camera.rotation @ self.rotation.T
        return replace(
            camera,
            rotation=rotation,
            translation=self.scale * camera.translation - rotation @ self.translation_m,
        )


def fitted_similarity(
    old: Float[np.ndarray, "n 3"], new: Float[np.ndarray, "n 3"], *, scale: bool = False
) -> Similarity:
    """Least squares of new - (s R old + t); Umeyama, IEEE PAMI 13 (1991)."""
    old_middle, new_middle = old.mean(axis=0), new.mean(axis=0)
    a, b = old - old_middle, new - new_middle
    u, singular, vt = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * sign) @ vt
    size = float(singular @ sign / np.sum(a * a)) if scale else 1.0
    return Similarity(
        rotation=rotation,
        translation_m=new_middle - size * rotation @ old_middle,
        scale=size,
    )


def least_turn(
    direction: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """The rotation of least angle that brings one direction to another."""
    direction = direction / np.linalg.norm(direction)
    cosine = float(direction @ target)
    if cosine < -1 + 1e-9:
        aside = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
        return Rotation.from_rotvec(np.pi * aside / np.linalg.norm(aside)).as_matrix()
    x, y, z = np.cross(direction, target)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)
