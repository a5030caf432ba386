"""How a pixel moves with the camera and with the point: what calibrations linearise.

`Camera.project` in formulas (see `camera.py`), with q = R p + t and the tangent of the rotation on
the left, R <- exp(w) R, so that dq/dw = -[R p]. Fifteen numbers describe a camera:

    w (3), t (3) [m], fx fy cx cy [px], k1 k2 p1 p2 k3
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Camera

PARAMETERS = 15
POSE = slice(0, 6)
INTRINSICS = slice(6, 15)


def projection_derivatives(
    camera: Camera, points_in_world: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 15"], Float[np.ndarray, "n 2 3"]]:
    """Pixels, and their derivatives by the camera's fifteen numbers and by the point [px / m].

    Points behind the camera come back as the formulas have it; `Camera.project` tells them apart.
    """
    rotated = points_in_world @ camera.rotation.T
    q = rotated + camera.translation
    x, y, inverse_z = q[:, 0] / q[:, 2], q[:, 1] / q[:, 2], 1.0 / q[:, 2]
    fx, fy = camera.matrix[0, 0], camera.matrix[1, 1]
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    pixels = np.stack([fx * xd + camera.matrix[0, 2], fy * yd + camera.matrix[1, 2]], axis=-1)

    cross = 2 * x * y * slope + 2 * (p1 * x + p2 * y)
    d_distorted = np.empty((len(q), 2, 2))
    d_distorted[:, 0, 0] = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
    d_distorted[:, 0, 1] = d_distorted[:, 1, 0] = cross
    d_distorted[:, 1, 1] = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
    d_normalised = np.zeros((len(q), 2, 3))
    d_normalised[:, 0, 0] = d_normalised[:, 1, 1] = inverse_z
    d_normalised[:, 0, 2] = -x * inverse_z
    d_normalised[:, 1, 2] = -y * inverse_z
    d_q = np.array([fx, fy])[:, None] * (d_distorted @ d_normalised)

    d_camera = np.zeros((len(q), 2, PARAMETERS))
    d_camera[:, :, 0:3] = -d_q @ _cross_matrices(rotated)
    d_camera[:, :, 3:6] = d_q
    d_camera[:, 0, 6], d_camera[:, 1, 7] = xd, yd
    d_camera[:, 0, 8] = d_camera[:, 1, 9] = 1.0
    powers = np.stack([r2, r2**2, r2**3], axis=-1)
    d_camera[:, 0, [10, 11, 14]] = fx * x[:, None] * powers
    d_camera[:, 1, [10, 11, 14]] = fy * y[:, None] * powers
    d_camera[:, 0, 12], d_camera[:, 0, 13] = fx * 2 * x * y, fx * (r2 + 2 * x * x)
    d_camera[:, 1, 12], d_camera[:, 1, 13] = fy * (r2 + 2 * y * y), fy * 2 * x * y
    return pixels, d_camera, d_q @ camera.rotation


def moved(camera: Camera, step: Float[np.ndarray, "15"]) -> Camera:
    """The camera after a step of its fifteen numbers."""
    matrix = camera.matrix.copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] += step[6:10]
    return replace(
        camera,
        matrix=matrix,
        distortion=camera.distortion + step[10:15],
        rotation=Rotation.from_rotvec(step[0:3]).as_matrix() @ camera.rotation,
        translation=camera.translation + step[3:6],
    )


def _cross_matrices(v: np.ndarray) -> np.ndarray:
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)
