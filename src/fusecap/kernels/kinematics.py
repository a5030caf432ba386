"""Forward kinematics of a tree of bones [1, eq. 1, 9], and what one angle does to it."""

from __future__ import annotations

from numba import float64 as f8
from numba import void

from fusecap.kernels.groups import BODY, POSED, SCRATCH
from fusecap.kernels.jit import kernel
from fusecap.kernels.lie import exp_so3, left_jacobian_so3


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def multiply(a, b, product_out):
    """The product a @ b of two 3x3 matrices; the output must be neither input."""
    for i in range(3):
        for j in range(3):
            product_out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]


@kernel(void(f8[::1], BODY, POSED, SCRATCH))
def forward(theta, body, posed, scratch):
    """Joint positions, bone rotations in the world, and `twist`.

    twist[b] (3, 3) is the world angular velocity of bone b's subtree per rate of its angle-axis
    vector: R_parent J_l(v), because exp(v + δ) = exp(J_l δ) exp(v).
    """
    parents, offsets, local = body.parents, body.offsets, scratch.local
    position, rotation, twist = posed.position, posed.rotation, posed.twist
    for bone in range(parents.size):
        x, y, z = theta[3 + 3 * bone], theta[4 + 3 * bone], theta[5 + 3 * bone]
        parent = parents[bone]
        if parent < 0:
            exp_so3(x, y, z, rotation[bone])
            left_jacobian_so3(x, y, z, twist[bone])
            for i in range(3):
                position[bone, i] = theta[i]
        else:
            exp_so3(x, y, z, local)
            multiply(rotation[parent], local, rotation[bone])
            left_jacobian_so3(x, y, z, local)
            multiply(rotation[parent], local, twist[bone])
            for i in range(3):
                position[bone, i] = (
                    position[parent, i]
                    + rotation[parent, i, 0] * offsets[bone, 0]
                    + rotation[parent, i, 1] * offsets[bone, 1]
                    + rotation[parent, i, 2] * offsets[bone, 2]
                )
