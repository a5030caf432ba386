"""Motion term: joints and the root keep their velocity.

    r = log(R₁ᵀ R₂) / h₁ - log(R₀ᵀ R₁) / h₀   per joint, over the mean step: angular acceleration

Rotations only ever enter as products, so a joint may turn for ever. With ω = log(R_aᵀ R_b),
dω = J_l⁻¹(-ω) J_r(b) δb - J_l⁻¹(ω) J_r(a) δa, where J_r(v) = J_l(-v). The root's place is the same
with plain differences.
"""

from __future__ import annotations

import math

from fusecap.kernels.jit import LOSS_SCALE, kernel
from fusecap.kernels.kinematics import multiply
from fusecap.kernels.lie import exp_so3, left_jacobian_so3
from fusecap.kernels.terms.orientation import relative_quaternion


@kernel("UniTuple(f8, 3)(f8[:, ::1], f8[:, ::1])")
def turn_between(a, b):
    """log(aᵀ b) as an angle-axis vector, at most pi."""
    w, x, y, z = relative_quaternion(a, b)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if sine < 1e-8 else 2.0 * math.atan2(sine, w) / sine
    return scale * x, scale * y, scale * z


@kernel("void(f8, f8, f8, f8[:, ::1])")
def inverse_left_jacobian(x, y, z, out):
    """J_l⁻¹(v) = I - ½ [v] + c [v]², c = 1/φ² - (1 + cos φ)/(2 φ sin φ)."""
    squared = x * x + y * y + z * z
    if squared < 1e-6:
        c = 1.0 / 12.0 + squared / 720.0
    else:
        angle = math.sqrt(squared)
        half = 0.5 * angle
        c = (1.0 - half * math.cos(half) / max(math.sin(half), 1e-6)) / squared
    out[0, 0] = 1.0 - c * (y * y + z * z)
    out[1, 1] = 1.0 - c * (x * x + z * z)
    out[2, 2] = 1.0 - c * (x * x + y * y)
    out[0, 1] = c * x * y + 0.5 * z
    out[1, 0] = c * x * y - 0.5 * z
    out[0, 2] = c * x * z - 0.5 * y
    out[2, 0] = c * x * z + 0.5 * y
    out[1, 2] = c * y * z + 0.5 * x
    out[2, 1] = c * y * z - 0.5 * x


@kernel("f8(f8, f8[::1], f8[:, ::1], f8[::1], f8[:, :, ::1], f8[:, :, :, ::1], f8[:, ::1])")
def add_motion(weight, steadiness, theta, steps, scratch, hessian_out, gradient_out):
    """½ Σ k log(1 + λ_b ‖r_b‖² / k) over three consecutive instants.

    steadiness (1 + B,): of the root's place [1/(m/s²)²], then of every joint [1/(rad/s²)²];
    theta (3, P); steps (2,) h₀, h₁ [s]; scratch (10, 3, 3). hessian_out (3, 3, P, P): [t, k]
    couples instants t and t - k, its lower triangle where k = 0; gradient_out (3, P).
    """
    per_mean = 2.0 / (steps[0] + steps[1])
    p0 = per_mean / steps[0]
    p2 = per_mean / steps[1]
    cost = 0.0
    rx = p2 * (theta[2, 0] - theta[1, 0]) - p0 * (theta[1, 0] - theta[0, 0])
    ry = p2 * (theta[2, 1] - theta[1, 1]) - p0 * (theta[1, 1] - theta[0, 1])
    rz = p2 * (theta[2, 2] - theta[1, 2]) - p0 * (theta[1, 2] - theta[0, 2])
    s = weight * steadiness[0] * (rx * rx + ry * ry + rz * rz) / LOSS_SCALE
    cost += 0.5 * LOSS_SCALE * math.log1p(s)
    weighted = weight * steadiness[0] / (1.0 + s)
    for k in range(3):
        ck = p0 if k == 0 else (-(p0 + p2) if k == 1 else p2)
        gradient_out[k, 0] += weighted * ck * rx
        gradient_out[k, 1] += weighted * ck * ry
        gradient_out[k, 2] += weighted * ck * rz
        for back in range(k + 1):
            m = k - back
            cm = p0 if m == 0 else (-(p0 + p2) if m == 1 else p2)
            for i in range(3):
                hessian_out[k, back, i, i] += weighted * ck * cm
    bones = (theta.shape[1] - 3) // 3
    for bone in range(bones):
        at = 3 + 3 * bone
        for k in range(3):
            exp_so3(theta[k, at], theta[k, at + 1], theta[k, at + 2], scratch[k])
            # J_r(v) = J_l(-v)
            left_jacobian_so3(-theta[k, at], -theta[k, at + 1], -theta[k, at + 2], scratch[3 + k])
        ax, ay, az = turn_between(scratch[0], scratch[1])
        bx, by, bz = turn_between(scratch[1], scratch[2])
        rx = p2 * bx - p0 * ax
        ry = p2 * by - p0 * ay
        rz = p2 * bz - p0 * az
        s = weight * steadiness[1 + bone] * (rx * rx + ry * ry + rz * rz) / LOSS_SCALE
        cost += 0.5 * LOSS_SCALE * math.log1p(s)
        weighted = weight * steadiness[1 + bone] / (1.0 + s)
        inverse_left_jacobian(ax, ay, az, scratch[6])
        inverse_left_jacobian(-ax, -ay, -az, scratch[7])
        inverse_left_jacobian(bx, by, bz, scratch[8])
        inverse_left_jacobian(-bx, -by, -bz, scratch[9])
        for i in range(3):
            for j in range(3):
                # dr/dv of each instant, before J_r.
                scratch[8, i, j] = -p2 * scratch[8, i, j] - p0 * scratch[7, i, j]
                scratch[6, i, j] = p0 * scratch[6, i, j]
                scratch[9, i, j] = p2 * scratch[9, i, j]
        multiply(scratch[6], scratch[3], scratch[0])
        multiply(scratch[8], scratch[4], scratch[1])
        multiply(scratch[9], scratch[5], scratch[2])
        for k in range(3):
            a = scratch[k]
            for i in range(3):
                gradient_out[k, at + i] += weighted * (a[0, i] * rx + a[1, i] * ry + a[2, i] * rz)
            for back in range(k + 1):
                b = scratch[k - back]
                for i in range(3):
                    for j in range(3):
                        hessian_out[k, back, at + i, at + j] += weighted * (
                            a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]
                        )
    return cost
