"""What couples two instants, pushed up the chain as `information` does for one.

A term that looks at one bone at the instants i and j knows its information K (6x6) between the
motions (v, ω) of the bone at i and at j, each about that instant's root joint. Everything below a
joint moves as one, so with K summed over the subtree of whichever of a and c is lower,

    H_ij[a, c] = Φ_i,aᵀ K Φ_j,c        where one of a, c is above the other, else 0.
"""

from __future__ import annotations

from numba import float64 as f8
from numba import void

from fusecap.kernels.groups import BODY, POSED
from fusecap.kernels.jit import kernel


@kernel(void(POSED, f8[:, :, ::1]))
def joint_motions(posed, motion_out):
    """Φ (B, 6, 3): how each joint's angles move the bones below it, about the root joint."""
    position, twist = posed.position, posed.twist
    for bone in range(position.shape[0]):
        ox = position[bone, 0] - position[0, 0]
        oy = position[bone, 1] - position[0, 1]
        oz = position[bone, 2] - position[0, 2]
        for j in range(3):
            w0, w1, w2 = twist[bone, 0, j], twist[bone, 1, j], twist[bone, 2, j]
            motion_out[bone, 0, j] = oy * w2 - oz * w1
            motion_out[bone, 1, j] = oz * w0 - ox * w2
            motion_out[bone, 2, j] = ox * w1 - oy * w0
            motion_out[bone, 3, j] = w0
            motion_out[bone, 4, j] = w1
            motion_out[bone, 5, j] = w2


@kernel(void(BODY, f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1]))
def assemble_between(body, motion_i, motion_j, information, force, block_out):
    """Add `information` (B, 6, 6), consumed, to the block (P, P) of rows i and columns j."""
    parents = body.parents
    bones = parents.size
    for bone in range(bones - 1, 0, -1):
        parent = parents[bone]
        for i in range(6):
            for j in range(6):
                information[parent, i, j] += information[bone, i, j]
    for bone in range(bones):
        k6 = information[bone]
        row = 3 + 3 * bone
        # K Φ_j of this bone, under every row joint at or above it.
        for i in range(6):
            for j in range(3):
                total = 0.0
                for k in range(6):
                    total += k6[i, k] * motion_j[bone, k, j]
                force[i, j] = total
        for i in range(3):
            for j in range(3):
                block_out[i, row + j] += force[i, j]
        above = bone
        while above >= 0:
            at = 3 + 3 * above
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(6):
                        total += motion_i[above, k, i] * force[k, j]
                    block_out[at + i, row + j] += total
            above = parents[above]
        # Kᵀ Φ_i of this bone, for every column joint above it.
        for i in range(6):
            for j in range(3):
                total = 0.0
                for k in range(6):
                    total += k6[k, i] * motion_i[bone, k, j]
                force[i, j] = total
        for i in range(3):
            for j in range(3):
                block_out[row + i, j] += force[j, i]
        above = parents[bone]
        while above >= 0:
            at = 3 + 3 * above
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for k in range(6):
                        total += force[k, i] * motion_j[above, k, j]
                    block_out[row + i, at + j] += total
            above = parents[above]
    for i in range(3):
        for j in range(3):
            block_out[i, j] += information[0, i, j]
