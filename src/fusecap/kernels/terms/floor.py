"""Floor term E_FP [1, eq. 16]: feet and toes stay above the floor.

The paper prints ‖H(-y + r)‖² with H the Heaviside step, whose gradient is zero wherever it is
defined; we read it as the one-sided penalty max(0, r - y)², which least squares can follow.
"""

from __future__ import annotations

from fusecap.kernels.information import add_point
from fusecap.kernels.jit import kernel


@kernel("f8(f8, i8[::1], f8, f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1])")
def add_floor(
    # Term in:
    weight,
    floor_bone,
    radius,
    # Body in:
    position,
    # Scratch:
    point_information,
    point_gradient,
    # Gathered out:
    information_out,
    gradient_out,
):
    """½ Σ λ max(0, radius - y)² over the joints of `floor_bone`; the floor is y = 0."""
    cost = 0.0
    for index in range(floor_bone.size):
        bone = floor_bone[index]
        depth = radius - position[bone, 1]
        if not depth > 0.0:
            continue
        cost += 0.5 * weight * depth * depth
        for i in range(3):
            point_gradient[i] = 0.0
            for j in range(3):
                point_information[i, j] = 0.0
        point_information[1, 1] = weight
        point_gradient[1] = -weight * depth
        add_point(
            position[bone, 0] - position[0, 0],
            position[bone, 1] - position[0, 1],
            position[bone, 2] - position[0, 2],
            point_information,
            point_gradient,
            information_out[bone],
            gradient_out[bone],
        )
    return cost
