"""Specific force term: what an accelerometer on a bone feels, in the bone's frame.

    r = R₁ᵀ (Σ c_k x_k + g) - f,      x_k = p_k + R_k t: the sensor at t-1, t, t+1, g upwards

All three poses are free and gravity goes through the solved orientation, so that a sensor whose
heading is off leaks nothing. With A_k = c_k [I, -[d_k]], d_k = x_k from the root, and [0, [u]]
added in the middle (u the bracket), J_k = R₁ᵀ A_k and J_iᵀ J_j = A_iᵀ A_j.
"""

from __future__ import annotations

import math

from numba import float64 as f8

from fusecap.kernels.groups import GATHERED_WINDOW, POSED_WINDOW, SENSORS
from fusecap.kernels.jit import FINITE, LOSS_SCALE, kernel

GRAVITY_M_S2 = 9.80665


@kernel("void(f8, f8, f8, f8, f8[:, ::1])")
def lever_of(c, dx, dy, dz, a_out):
    """The matrix c [I, -[d]] (3, 6)."""
    for i in range(3):
        for j in range(3):
            a_out[i, j] = c if i == j else 0.0
        a_out[i, 3 + i] = 0.0
    a_out[0, 4] = c * dz
    a_out[0, 5] = -c * dy
    a_out[1, 3] = -c * dz
    a_out[1, 5] = c * dx
    a_out[2, 3] = c * dy
    a_out[2, 4] = -c * dx


@kernel(f8(f8, SENSORS, f8[:, ::1], f8[::1], POSED_WINDOW, f8[:, :, ::1], GATHERED_WINDOW))
def add_specific_force(weight, sensors, force, difference, posed, lever, gathered):
    """½ Σ k log(1 + λ ‖r‖² / k) over three consecutive instants, all groups sliced to them.

    force (I, 3) at the middle one, NaN switches a sensor off; difference (3,) are the c_k; lever
    (3, 3, 6) is scratch.
    """
    position, rotation = posed.position, posed.rotation
    cost = 0.0
    for imu in range(sensors.bone.size):
        if not abs(force[imu, 0]) < FINITE:
            continue
        bone = sensors.bone[imu]
        ox, oy, oz = sensors.offset[imu, 0], sensors.offset[imu, 1], sensors.offset[imu, 2]
        ux, uy, uz = 0.0, GRAVITY_M_S2, 0.0
        for k in range(3):
            r = rotation[k, bone]
            x = position[k, bone, 0] + r[0, 0] * ox + r[0, 1] * oy + r[0, 2] * oz
            y = position[k, bone, 1] + r[1, 0] * ox + r[1, 1] * oy + r[1, 2] * oz
            z = position[k, bone, 2] + r[2, 0] * ox + r[2, 1] * oy + r[2, 2] * oz
            c = difference[k]
            ux += c * x
            uy += c * y
            uz += c * z
            lever_of(
                c,
                x - position[k, 0, 0],
                y - position[k, 0, 1],
                z - position[k, 0, 2],
                lever[k],
            )
        lever[1, 0, 4] -= uz
        lever[1, 0, 5] += uy
        lever[1, 1, 3] += uz
        lever[1, 1, 5] -= ux
        lever[1, 2, 3] -= uy
        lever[1, 2, 4] += ux
        r = rotation[1, bone]
        r0 = r[0, 0] * ux + r[1, 0] * uy + r[2, 0] * uz - force[imu, 0]
        r1 = r[0, 1] * ux + r[1, 1] * uy + r[2, 1] * uz - force[imu, 1]
        r2 = r[0, 2] * ux + r[1, 2] * uy + r[2, 2] * uz - force[imu, 2]
        s = weight * (r0 * r0 + r1 * r1 + r2 * r2) / LOSS_SCALE
        if not s < FINITE:
            continue
        cost += 0.5 * LOSS_SCALE * math.log1p(s)
        weighted = weight / (1.0 + s)
        w0 = r[0, 0] * r0 + r[0, 1] * r1 + r[0, 2] * r2
        w1 = r[1, 0] * r0 + r[1, 1] * r1 + r[1, 2] * r2
        w2 = r[2, 0] * r0 + r[2, 1] * r1 + r[2, 2] * r2
        for k in range(3):
            a = lever[k]
            for i in range(6):
                gathered.gradient[k, bone, i] += weighted * (
                    a[0, i] * w0 + a[1, i] * w1 + a[2, i] * w2
                )
            for back in range(k + 1):
                b = lever[k - back]
                target = gathered.information[k, back, bone]
                for i in range(6):
                    for j in range(6):
                        target[i, j] += weighted * (
                            a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]
                        )
    return cost
