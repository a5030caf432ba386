"""Acceleration term E_A [1, eq. 11-13]: IMU sites, accelerated as measured.

The central difference over t-2, t-1 and t is the acceleration at t-1; only the site at t depends on
the pose, with derivative 1/Δt².
"""

from __future__ import annotations

import math

from fusecap.kernels.information import add_point
from fusecap.kernels.jit import FINITE, kernel


@kernel(
    "f8(f8, i8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8, f8[:, ::1], f8[:, :, ::1], "
    "f8[:, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1])"
)
def add_acceleration(
    # Term in:
    weight,
    imu_bone,
    imu_offset,
    imu_accel,
    imu_history,
    dt,
    # Body in:
    position,
    rotation,
    # Scratch:
    point_information,
    point_gradient,
    # Gathered out:
    information_out,
    gradient_out,
):
    """½ Σ log(1 + λ ‖(x - 2 x(t-1) + x(t-2))/Δt² - a(t-1)‖²).

    imu_accel (I, 3) is a(t-1) in the world without gravity [m/s²]; imu_history (2, I, 3) the sites
    at t-1 and t-2. A NaN in either switches that IMU off.
    """
    cost = 0.0
    per_dt2 = 1.0 / (dt * dt)
    for imu in range(imu_bone.size):
        bone = imu_bone[imu]
        ox, oy, oz = imu_offset[imu, 0], imu_offset[imu, 1], imu_offset[imu, 2]
        r = rotation[bone]
        x = position[bone, 0] + r[0, 0] * ox + r[0, 1] * oy + r[0, 2] * oz
        y = position[bone, 1] + r[1, 0] * ox + r[1, 1] * oy + r[1, 2] * oz
        z = position[bone, 2] + r[2, 0] * ox + r[2, 1] * oy + r[2, 2] * oz
        before = imu_history[0, imu]
        earlier = imu_history[1, imu]
        ax = (x - 2.0 * before[0] + earlier[0]) * per_dt2 - imu_accel[imu, 0]
        ay = (y - 2.0 * before[1] + earlier[1]) * per_dt2 - imu_accel[imu, 1]
        az = (z - 2.0 * before[2] + earlier[2]) * per_dt2 - imu_accel[imu, 2]
        s = weight * (ax * ax + ay * ay + az * az)
        if not s < FINITE:
            continue
        cost += 0.5 * math.log1p(s)
        slope = weight / (1.0 + s) * per_dt2
        for i in range(3):
            for j in range(3):
                point_information[i, j] = 0.0
            point_information[i, i] = slope * per_dt2
        point_gradient[0] = slope * ax
        point_gradient[1] = slope * ay
        point_gradient[2] = slope * az
        add_point(
            x - position[0, 0],
            y - position[0, 1],
            z - position[0, 2],
            point_information,
            point_gradient,
            information_out[bone],
            gradient_out[bone],
        )
    return cost
