"""Position term E_P [1, eq. 5-7]: landmarks, seen by cameras."""

from __future__ import annotations

import math

from numba import float64 as f8

from fusecap.kernels.groups import GATHERED, LANDMARKS, POSED, SCRATCH
from fusecap.kernels.information import add_point
from fusecap.kernels.jit import FINITE, kernel
from fusecap.kernels.projection import project_with_jacobian

UNSEEN_RESIDUAL_PX = 1920.0
"""A keypoint whose landmark the camera cannot image costs as an outlier of one image width and has
no gradient; were it free, a body could hide from its residuals behind the camera."""


@kernel(f8(f8, LANDMARKS, f8[:, :, ::1], POSED, SCRATCH, GATHERED))
def add_position(weight, landmarks, keypoints, posed, scratch, gathered):
    """½ Σ log(1 + λ w ‖project(x) - keypoint‖²), residuals in pixels of a 1920-pixel-wide image.

    keypoints (C, K, 3): x, y, confidence w; zero confidence or NaN means missing. The 3x3
    information of a landmark is summed over the cameras before it moves the bones.
    """
    cameras, position, rotation = landmarks.cameras, posed.position, posed.rotation
    cost = 0.0
    for landmark in range(landmarks.bone.size):
        bone = landmarks.bone[landmark]
        ox = landmarks.offset[landmark, 0]
        oy = landmarks.offset[landmark, 1]
        oz = landmarks.offset[landmark, 2]
        r = rotation[bone]
        x = position[bone, 0] + r[0, 0] * ox + r[0, 1] * oy + r[0, 2] * oz
        y = position[bone, 1] + r[1, 0] * ox + r[1, 1] * oy + r[1, 2] * oz
        z = position[bone, 2] + r[2, 0] * ox + r[2, 1] * oy + r[2, 2] * oz
        w00 = w01 = w02 = w11 = w12 = w22 = 0.0
        g0 = g1 = g2 = 0.0
        seen = False
        for camera in range(cameras.shape[0]):
            confidence = keypoints[camera, landmark, 2]
            measured_u = keypoints[camera, landmark, 0]
            measured_v = keypoints[camera, landmark, 1]
            if not (confidence > 0.0 and abs(measured_u) < FINITE and abs(measured_v) < FINITE):
                continue
            imaged, u, v, ux, uy, uz, vx, vy, vz = project_with_jacobian(cameras[camera], x, y, z)
            scale = cameras[camera, 21]
            scaled_weight = weight * confidence
            if imaged == 0.0:
                cost += 0.5 * math.log1p(scaled_weight * UNSEEN_RESIDUAL_PX * UNSEEN_RESIDUAL_PX)
                continue
            scaled_weight *= scale * scale
            du = u - measured_u
            dv = v - measured_v
            s = scaled_weight * (du * du + dv * dv)
            cost += 0.5 * math.log1p(s)
            weighted = scaled_weight / (1.0 + s)
            w00 += weighted * (ux * ux + vx * vx)
            w01 += weighted * (ux * uy + vx * vy)
            w02 += weighted * (ux * uz + vx * vz)
            w11 += weighted * (uy * uy + vy * vy)
            w12 += weighted * (uy * uz + vy * vz)
            w22 += weighted * (uz * uz + vz * vz)
            g0 += weighted * (ux * du + vx * dv)
            g1 += weighted * (uy * du + vy * dv)
            g2 += weighted * (uz * du + vz * dv)
            seen = True
        if seen:
            scratch.information[0, 0] = w00
            scratch.information[0, 1] = scratch.information[1, 0] = w01
            scratch.information[0, 2] = scratch.information[2, 0] = w02
            scratch.information[1, 1] = w11
            scratch.information[1, 2] = scratch.information[2, 1] = w12
            scratch.information[2, 2] = w22
            scratch.gradient[0] = g0
            scratch.gradient[1] = g1
            scratch.gradient[2] = g2
            add_point(
                x - position[0, 0],
                y - position[0, 1],
                z - position[0, 2],
                scratch.information,
                scratch.gradient,
                gathered.information[bone],
                gathered.gradient[bone],
            )
    return cost
