"""Acceleration term E_A [1, eq. 11-13]: IMU sites, accelerated as measured.

The central difference over t-2, t-1 and t is the acceleration at t-1; only the site at t depends on
the pose, with derivative 1/Δt².
"""

from __future__ import annotations

import math

from numba import float64 as f8

from fusecap.kernels.groups import GATHERED, MEASURED, POSED, SCRATCH, SENSORS
from fusecap.kernels.information import add_point
from fusecap.kernels.jit import FINITE, kernel


@kernel(f8(f8, SENSORS, MEASURED, POSED, SCRATCH, GATHERED))
def add_acceleration(weight, sensors, measured, posed, scratch, gathered):
    """½ Σ log(1 + λ ‖(x - 2 x(t-1) + x(t-2))/Δt² - a(t-1)‖²).

    `accel` is a(t-1) in the world without gravity [m/s²]; `history` the sites at t-1 and
    t-2. A NaN in either switches that IMU off.
    """
    position, rotation = posed.position, posed.rotation
    cost = 0.0
    per_dt2 = 1.0 / (measured.dt * measured.dt)
    for imu in range(sensors.bone.size):
        bone = sensors.bone[imu]
        ox, oy, oz = sensors.offset[imu, 0], sensors.offset[imu, 1], sensors.offset[imu, 2]
        r = rotation[bone]
        x = position[bone, 0] + r[0, 0] * ox + r[0, 1] * oy + r[0, 2] * oz
        y = position[bone, 1] + r[1, 0] * ox + r[1, 1] * oy + r[1, 2] * oz
        z = position[bone, 2] + r[2, 0] * ox + r[2, 1] * oy + r[2, 2] * oz
        before = measured.history[0, imu]
        earlier = measured.history[1, imu]
        ax = (x - 2.0 * before[0] + earlier[0]) * per_dt2 - measured.accel[imu, 0]
        ay = (y - 2.0 * before[1] + earlier[1]) * per_dt2 - measured.accel[imu, 1]
        az = (z - 2.0 * before[2] + earlier[2]) * per_dt2 - measured.accel[imu, 2]
        s = weight * (ax * ax + ay * ay + az * az)
        if not s < FINITE:
            continue
        cost += 0.5 * math.log1p(s)
        slope = weight / (1.0 + s) * per_dt2
        for i in range(3):
            for j in range(3):
                scratch.information[i, j] = 0.0
            scratch.information[i, i] = slope * per_dt2
        scratch.gradient[0] = slope * ax
        scratch.gradient[1] = slope * ay
        scratch.gradient[2] = slope * az
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
