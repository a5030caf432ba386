"""Floor term E_FP [1, eq. 16]: feet and toes stay above the floor.

The paper prints ‖H(-y + r)‖² with H the Heaviside step, whose gradient is zero wherever it is
defined; we read it as the one-sided penalty max(0, r - y)², which least squares can follow.
"""

from __future__ import annotations

from numba import float64 as f8

from fusecap.kernels.groups import FLOOR, GATHERED, POSED, SCRATCH
from fusecap.kernels.information import add_point
from fusecap.kernels.jit import kernel


@kernel(f8(f8, FLOOR, POSED, SCRATCH, GATHERED))
def add_floor(weight, floor, posed, scratch, gathered):
    """½ Σ λ max(0, radius - y)² over the joints of `floor`; the floor is y = 0."""
    position = posed.position
    cost = 0.0
    for index in range(floor.bone.size):
        bone = floor.bone[index]
        depth = floor.radius - position[bone, 1]
        if not depth > 0.0:
            continue
        cost += 0.5 * weight * depth * depth
        for i in range(3):
            scratch.gradient[i] = 0.0
            for j in range(3):
                scratch.information[i, j] = 0.0
        scratch.information[1, 1] = weight
        scratch.gradient[1] = -weight * depth
        add_point(
            position[bone, 0] - position[0, 0],
            position[bone, 1] - position[0, 1],
            position[bone, 2] - position[0, 2],
            scratch.information,
            scratch.gradient,
            gathered.information[bone],
            gathered.gradient[bone],
        )
    return cost
