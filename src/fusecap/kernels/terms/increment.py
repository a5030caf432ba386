"""Increment term: a bone turns from one instant to the next as its sensor did.

With D = R₀ᵀ R₁ the solved and D̂ = M₀ᵀ M₁ the measured turn, (w, v) the quaternion of Dᵀ D̂ with
w >= 0, the residual is 2 v, about the angle between them. A wrong heading cancels in D̂. World
rotations ω₀, ω₁ of the bone enter as δ = R₁ᵀ (ω₀ - ω₁), dv = ½ (w I - [v]) δ, and with n = R₁ v

    Jᵀ J = I - n nᵀ,    Jᵀ r = 2 w n        for ω₀, the same with the sign turned for ω₁.
"""

from __future__ import annotations

import math

from numba import float64 as f8

from fusecap.kernels.groups import GATHERED, POSED, SENSORS
from fusecap.kernels.jit import FINITE, LOSS_SCALE, kernel
from fusecap.kernels.terms.orientation import relative_quaternion

_CUBE = f8[:, :, ::1]


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def transpose_multiply(a, b, out):
    """Aᵀ B."""
    for i in range(3):
        for j in range(3):
            out[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]


@kernel(
    f8(f8, SENSORS, _CUBE, _CUBE, POSED, POSED, GATHERED, GATHERED, f8[:, :, ::1], f8[:, :, ::1])
)
def add_increment(
    weight,
    sensors,
    measured_before,
    measured,
    posed_before,
    posed,
    gathered_before,
    gathered,
    between_out,
    square,
):
    """½ Σ k log(1 + λ ‖2 v‖² / k); NaN in a measured rotation switches that sensor off."""
    cost = 0.0
    for imu in range(sensors.bone.size):
        if not (abs(measured[imu, 0, 0]) < FINITE and abs(measured_before[imu, 0, 0]) < FINITE):
            continue
        bone = sensors.bone[imu]
        r1 = posed.rotation[bone]
        transpose_multiply(posed_before.rotation[bone], r1, square[0])
        transpose_multiply(measured_before[imu], measured[imu], square[1])
        w, x, y, z = relative_quaternion(square[0], square[1])
        s = 4.0 * weight * (x * x + y * y + z * z) / LOSS_SCALE
        cost += 0.5 * LOSS_SCALE * math.log1p(s)
        weighted = weight / (1.0 + s)
        n0 = r1[0, 0] * x + r1[0, 1] * y + r1[0, 2] * z
        n1 = r1[1, 0] * x + r1[1, 1] * y + r1[1, 2] * z
        n2 = r1[2, 0] * x + r1[2, 1] * y + r1[2, 2] * z
        for i in range(3):
            ni = n0 if i == 0 else (n1 if i == 1 else n2)
            slope = 2.0 * weighted * w * ni
            gathered_before.gradient[bone, 3 + i] += slope
            gathered.gradient[bone, 3 + i] -= slope
            for j in range(3):
                nj = n0 if j == 0 else (n1 if j == 1 else n2)
                value = -weighted * ni * nj
                if i == j:
                    value += weighted
                gathered_before.information[bone, 3 + i, 3 + j] += value
                gathered.information[bone, 3 + i, 3 + j] += value
                between_out[bone, 3 + i, 3 + j] -= value
    return cost
