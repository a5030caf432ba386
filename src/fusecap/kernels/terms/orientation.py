"""Orientation term E_R [1, eq. 8-10]: bones, turned as their IMUs say.

With (w, v) the quaternion of R̂ᵀ R_measured and w >= 0, the residual is v, so λ ‖v‖² is λ sin²(φ/2).
A world rotation ω of the bone changes it by dv = -½ (w I - [v]) R̂ᵀ ω, and with n = R̂ v

    Jᵀ J = ¼ (I - n nᵀ),    Jᵀ v = -½ w n.

The gradient is exact up to 180 degrees, where w = 0 and it vanishes: the farthest orientation.
"""

from __future__ import annotations

import math

from numba import float64 as f8

from fusecap.kernels.groups import GATHERED, POSED, SENSORS
from fusecap.kernels.jit import kernel


@kernel("UniTuple(f8, 4)(f8[:, ::1], f8[:, ::1])")
def relative_quaternion(a, b):
    """(w, x, y, z) of aᵀ b with w >= 0 (Shepperd's method)."""
    m00 = a[0, 0] * b[0, 0] + a[1, 0] * b[1, 0] + a[2, 0] * b[2, 0]
    m01 = a[0, 0] * b[0, 1] + a[1, 0] * b[1, 1] + a[2, 0] * b[2, 1]
    m02 = a[0, 0] * b[0, 2] + a[1, 0] * b[1, 2] + a[2, 0] * b[2, 2]
    m10 = a[0, 1] * b[0, 0] + a[1, 1] * b[1, 0] + a[2, 1] * b[2, 0]
    m11 = a[0, 1] * b[0, 1] + a[1, 1] * b[1, 1] + a[2, 1] * b[2, 1]
    m12 = a[0, 1] * b[0, 2] + a[1, 1] * b[1, 2] + a[2, 1] * b[2, 2]
    m20 = a[0, 2] * b[0, 0] + a[1, 2] * b[1, 0] + a[2, 2] * b[2, 0]
    m21 = a[0, 2] * b[0, 1] + a[1, 2] * b[1, 1] + a[2, 2] * b[2, 1]
    m22 = a[0, 2] * b[0, 2] + a[1, 2] * b[1, 2] + a[2, 2] * b[2, 2]
    trace = m00 + m11 + m22
    if trace >= m00 and trace >= m11 and trace >= m22:
        w = 1.0 + trace
        x = m21 - m12
        y = m02 - m20
        z = m10 - m01
    elif m00 >= m11 and m00 >= m22:
        w = m21 - m12
        x = 1.0 + m00 - m11 - m22
        y = m01 + m10
        z = m02 + m20
    elif m11 >= m22:
        w = m02 - m20
        x = m01 + m10
        y = 1.0 - m00 + m11 - m22
        z = m12 + m21
    else:
        w = m10 - m01
        x = m02 + m20
        y = m12 + m21
        z = 1.0 - m00 - m11 + m22
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    return w * scale, x * scale, y * scale, z * scale


@kernel(f8(f8, SENSORS, f8[:, :, ::1], f8[::1], POSED, GATHERED))
def add_orientation(weight, sensors, measured, present, posed, gathered):
    """½ Σ λ w ‖v‖²; a measured rotation is R_ig R_i R_ib⁻¹, skipped where `present` is 0."""
    cost = 0.0
    for imu in range(sensors.bone.size):
        if not present[imu] > 0.0:
            continue
        bone = sensors.bone[imu]
        r = posed.rotation[bone]
        w, vx, vy, vz = relative_quaternion(r, measured[imu])
        weighted = weight * present[imu]
        cost += 0.5 * weighted * (vx * vx + vy * vy + vz * vz)
        n0 = r[0, 0] * vx + r[0, 1] * vy + r[0, 2] * vz
        n1 = r[1, 0] * vx + r[1, 1] * vy + r[1, 2] * vz
        n2 = r[2, 0] * vx + r[2, 1] * vy + r[2, 2] * vz
        quarter = 0.25 * weighted
        information = gathered.information[bone]
        information[3, 3] += quarter * (1.0 - n0 * n0)
        information[4, 4] += quarter * (1.0 - n1 * n1)
        information[5, 5] += quarter * (1.0 - n2 * n2)
        information[3, 4] -= quarter * n0 * n1
        information[4, 3] -= quarter * n0 * n1
        information[3, 5] -= quarter * n0 * n2
        information[5, 3] -= quarter * n0 * n2
        information[4, 5] -= quarter * n1 * n2
        information[5, 4] -= quarter * n1 * n2
        slope = -0.5 * weighted * w
        gathered.gradient[bone, 3] += slope * n0
        gathered.gradient[bone, 4] += slope * n1
        gathered.gradient[bone, 5] += slope * n2
    return cost
