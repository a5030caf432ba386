"""Project a point into a camera, with derivatives. Camera rows: see fusecap.geometry.camera."""

from __future__ import annotations

from fusecap.kernels.jit import kernel

NEAR_M = 0.05
"""Nearer than this in front of a camera, or behind it, a point is not imaged."""

_NUMBERS = "UniTuple(f8, 9)(f8[::1], f8, f8, f8)"


@kernel(_NUMBERS)
def project_with_jacobian(camera, x, y, z):
    """(imaged, u, v, du/dx, du/dy, du/dz, dv/dx, dv/dy, dv/dz), pixels and pixels per metre.

    imaged is 1.0, or 0.0 for a point behind the camera or beyond its distortion's range.
    """
    xc = camera[0] * x + camera[1] * y + camera[2] * z + camera[9]
    yc = camera[3] * x + camera[4] * y + camera[5] * z + camera[10]
    zc = camera[6] * x + camera[7] * y + camera[8] * z + camera[11]
    if not zc > NEAR_M:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    inverse_z = 1.0 / zc
    a = xc * inverse_z
    b = yc * inverse_z
    r2 = a * a + b * b
    if r2 > camera[22]:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    k1, k2, p1, p2, k3 = camera[16], camera[17], camera[18], camera[19], camera[20]
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # d radial / d a = slope * a
    u = camera[12] * (a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)) + camera[14]
    v = camera[13] * (b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b) + camera[15]
    cross = a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    du_da = camera[12] * (radial + a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a)
    du_db = camera[12] * cross
    dv_da = camera[13] * cross
    dv_db = camera[13] * (radial + b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a)
    # a = xc/zc, b = yc/zc: chain through the camera's axes.
    du_dx = inverse_z * du_da
    du_dy = inverse_z * du_db
    du_dz = -inverse_z * (du_da * a + du_db * b)
    dv_dx = inverse_z * dv_da
    dv_dy = inverse_z * dv_db
    dv_dz = -inverse_z * (dv_da * a + dv_db * b)
    return (
        1.0,
        u,
        v,
        du_dx * camera[0] + du_dy * camera[3] + du_dz * camera[6],
        du_dx * camera[1] + du_dy * camera[4] + du_dz * camera[7],
        du_dx * camera[2] + du_dy * camera[5] + du_dz * camera[8],
        dv_dx * camera[0] + dv_dy * camera[3] + dv_dz * camera[6],
        dv_dx * camera[1] + dv_dy * camera[4] + dv_dz * camera[7],
        dv_dx * camera[2] + dv_dy * camera[5] + dv_dz * camera[8],
    )
