"""Rotations as angle-axis vectors: exponential, left Jacobian, wrapping."""

from __future__ import annotations

import math

from fusecap.kernels.jit import kernel

_SMALL_ANGLE_SQUARED = 1e-8


@kernel("void(f8, f8, f8, f8, f8, f8[:, ::1])")
def _polynomial(x, y, z, a, b, out):
    """I + a [v] + b [v]², and [v]² = v vᵀ - |v|² I."""
    out[0, 0] = 1.0 - b * (y * y + z * z)
    out[1, 1] = 1.0 - b * (x * x + z * z)
    out[2, 2] = 1.0 - b * (x * x + y * y)
    out[0, 1] = b * x * y - a * z
    out[1, 0] = b * x * y + a * z
    out[0, 2] = b * x * z + a * y
    out[2, 0] = b * x * z - a * y
    out[1, 2] = b * y * z - a * x
    out[2, 1] = b * y * z + a * x


@kernel("void(f8, f8, f8, f8[:, ::1])")
def exp_so3(x, y, z, rotation_out):
    """R = I + a [v] + b [v]² with a = sin φ/φ, b = (1 - cos φ)/φ², φ = |v|."""
    squared = x * x + y * y + z * z
    if squared < _SMALL_ANGLE_SQUARED:
        a = 1.0 - squared / 6.0
        b = 0.5 - squared / 24.0
    else:
        angle = math.sqrt(squared)
        a = math.sin(angle) / angle
        b = (1.0 - math.cos(angle)) / squared
    _polynomial(x, y, z, a, b, rotation_out)


@kernel("void(f8, f8, f8, f8[:, ::1])")
def left_jacobian_so3(x, y, z, jacobian_out):
    """J with exp(v + δ) ≈ exp(J δ) exp(v): I + b [v] + c [v]², c = (φ - sin φ)/φ³."""
    squared = x * x + y * y + z * z
    if squared < _SMALL_ANGLE_SQUARED:
        b = 0.5 - squared / 24.0
        c = 1.0 / 6.0 - squared / 120.0
    else:
        angle = math.sqrt(squared)
        b = (1.0 - math.cos(angle)) / squared
        c = (angle - math.sin(angle)) / (squared * angle)
    _polynomial(x, y, z, b, c, jacobian_out)


@kernel("void(f8[::1])")
def wrap_pose(theta_out):
    """Bring every angle-axis vector of a pose back to at most pi; the rotations stay the same."""
    for start in range(3, theta_out.size, 3):
        x, y, z = theta_out[start], theta_out[start + 1], theta_out[start + 2]
        angle = math.sqrt(x * x + y * y + z * z)
        if angle > math.pi:
            turns = math.floor(angle / (2.0 * math.pi) + 0.5)
            scale = (angle - 2.0 * math.pi * turns) / angle
            theta_out[start] = x * scale
            theta_out[start + 1] = y * scale
            theta_out[start + 2] = z * scale
