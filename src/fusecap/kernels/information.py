"""The normal equations of a tree, gathered where the measurements are and pushed up the chain.

A term that looks at a point x on bone b knows its information W (3x3, Σ Jᵀ ρ' J) and gradient g (3)
in the world. A rigid motion (v, ω) about the origin moves the point by v + ω × x, so in six numbers

    I6 = [ W       -W [x]     ]        g6 = [   g   ]
         [ [x] W   -[x] W [x] ]             [ x × g ]

and everything below a joint moves as one: the subtree's six-by-six is the plain sum over its bones.
That sum is the composite rigid body algorithm (Featherstone) with information in place of inertia.
Joint a turns its subtree about its own centre o_a: Φ_a = [[o_a]; I] twist_a (6x3). With c at or
below a,

    H[a, c] = Φ_aᵀ I6_c Φ_c,    g[c] = Φ_cᵀ g6_c.

The cost of one landmark does not depend on the number of bones above it, nor the assembly on the
number of landmarks or cameras. The origin is the root joint, to keep the arms of the levers short.
"""

from __future__ import annotations

from numba import float64 as f8
from numba import void

from fusecap.kernels.groups import BODY, GATHERED, POSED, SCRATCH
from fusecap.kernels.jit import kernel


@kernel("f8(f8, f8, f8, f8[:, ::1], i8, i8)")
def _lever(x, y, z, w, i, j):
    """Element (i, j) of -W [x]."""
    if j == 0:
        return y * w[i, 2] - z * w[i, 1]
    if j == 1:
        return z * w[i, 0] - x * w[i, 2]
    return x * w[i, 1] - y * w[i, 0]


@kernel("void(f8, f8, f8, f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def add_point(x, y, z, point_information, point_gradient, information_out, gradient_out):
    """Add a point's W (3, 3) and g (3,) to its bone's I6 (6, 6) and g6 (6,); x from the root."""
    for i in range(3):
        w0, w1, w2 = point_information[i, 0], point_information[i, 1], point_information[i, 2]
        information_out[i, 0] += w0
        information_out[i, 1] += w1
        information_out[i, 2] += w2
        # Row i of -W [x] is x × (row i of W).
        information_out[i, 3] += y * w2 - z * w1
        information_out[i, 4] += z * w0 - x * w2
        information_out[i, 5] += x * w1 - y * w0
    for j in range(3):
        # Column j of -[x] W [x] is x × (column j of -W [x]).
        b0 = _lever(x, y, z, point_information, 0, j)
        b1 = _lever(x, y, z, point_information, 1, j)
        b2 = _lever(x, y, z, point_information, 2, j)
        information_out[3, 3 + j] += y * b2 - z * b1
        information_out[4, 3 + j] += z * b0 - x * b2
        information_out[5, 3 + j] += x * b1 - y * b0
    gx, gy, gz = point_gradient[0], point_gradient[1], point_gradient[2]
    gradient_out[0] += gx
    gradient_out[1] += gy
    gradient_out[2] += gz
    gradient_out[3] += y * gz - z * gy
    gradient_out[4] += z * gx - x * gz
    gradient_out[5] += x * gy - y * gx


@kernel(void(BODY, POSED, GATHERED, SCRATCH, f8[:, ::1], f8[::1]))
def assemble(body, posed, gathered, scratch, hessian_out, gradient_out):
    """Add the gathered information to the lower triangle of H (3 + 3B, 3 + 3B) and to g (3 + 3B,).

    It needs its upper right block and both diagonal ones, and is consumed: children are summed into
    parents.
    """
    parents, position, twist = body.parents, posed.position, posed.twist
    information, gradient = gathered.information, gathered.gradient
    motion, force = scratch.motion, scratch.force
    bones = parents.size
    for bone in range(bones - 1, 0, -1):
        parent = parents[bone]
        for i in range(6):
            gradient[parent, i] += gradient[bone, i]
            for j in range(6):
                information[parent, i, j] += information[bone, i, j]
    for bone in range(bones):
        ox = position[bone, 0] - position[0, 0]
        oy = position[bone, 1] - position[0, 1]
        oz = position[bone, 2] - position[0, 2]
        for j in range(3):
            w0, w1, w2 = twist[bone, 0, j], twist[bone, 1, j], twist[bone, 2, j]
            motion[bone, 0, j] = oy * w2 - oz * w1
            motion[bone, 1, j] = oz * w0 - ox * w2
            motion[bone, 2, j] = ox * w1 - oy * w0
            motion[bone, 3, j] = w0
            motion[bone, 4, j] = w1
            motion[bone, 5, j] = w2
        inf = information[bone]
        for i in range(3):
            for j in range(3):
                linear = 0.0
                angular = 0.0
                for k in range(3):
                    linear += inf[i, k] * motion[bone, k, j]
                    linear += inf[i, 3 + k] * motion[bone, 3 + k, j]
                    angular += inf[k, 3 + i] * motion[bone, k, j]
                    angular += inf[3 + i, 3 + k] * motion[bone, 3 + k, j]
                force[i, j] = linear
                force[3 + i, j] = angular
        row = 3 + 3 * bone
        for j in range(3):
            total = 0.0
            for k in range(6):
                total += motion[bone, k, j] * gradient[bone, k]
            gradient_out[row + j] += total
            for i in range(3):
                hessian_out[row + j, i] += force[i, j]
        ancestor = bone
        while ancestor >= 0:
            column = 3 + 3 * ancestor
            for j in range(3):
                for i in range(3):
                    total = 0.0
                    for k in range(6):
                        total += motion[ancestor, k, i] * force[k, j]
                    hessian_out[row + j, column + i] += total
            ancestor = parents[ancestor]
    for i in range(3):
        gradient_out[i] += gradient[0, i]
        for j in range(3):
            hessian_out[i, j] += information[0, i, j]
