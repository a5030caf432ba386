"""Rest term: what stands on the floor does not move.

    r = (x₁ - x₀) / h,      x: an ankle, a toe joint or the root at two consecutive instants

where a `contact` says that it rests (see `fusecap.solve.contact`). With A_k = c_k [I, -[d_k]],
c = (-1/h, 1/h), d_k = x_k from the root, the Jacobians are A_k, as in `specific_force`.
"""

from __future__ import annotations

import math

from numba import float64 as f8

from fusecap.kernels.groups import FLOOR, GATHERED_WINDOW, POSED_WINDOW
from fusecap.kernels.jit import LOSS_SCALE, kernel
from fusecap.kernels.terms.specific_force import lever_of


@kernel(f8(f8, FLOOR, f8[::1], f8, POSED_WINDOW, f8[:, :, ::1], GATHERED_WINDOW))
def add_rest(weight, floor, contact, step, posed, lever, gathered):
    """½ Σ c k log(1 + λ ‖r‖² / k) over two consecutive instants, all groups sliced to them.

    contact (R,) c, 0 or more, per resting joint of `floor`; lever (2 or more, 3, 6) is scratch.
    """
    position = posed.position
    cost = 0.0
    for index in range(floor.resting.size):
        share = contact[index]
        if not share > 0.0:
            continue
        bone = floor.resting[index]
        rx = (position[1, bone, 0] - position[0, bone, 0]) / step
        ry = (position[1, bone, 1] - position[0, bone, 1]) / step
        rz = (position[1, bone, 2] - position[0, bone, 2]) / step
        s = weight * (rx * rx + ry * ry + rz * rz) / LOSS_SCALE
        cost += 0.5 * share * LOSS_SCALE * math.log1p(s)
        weighted = share * weight / (1.0 + s)
        for k in range(2):
            lever_of(
                (2 * k - 1) / step,
                position[k, bone, 0] - position[k, 0, 0],
                position[k, bone, 1] - position[k, 0, 1],
                position[k, bone, 2] - position[k, 0, 2],
                lever[k],
            )
        for k in range(2):
            a = lever[k]
            for i in range(6):
                gathered.gradient[k, bone, i] += weighted * (
                    a[0, i] * rx + a[1, i] * ry + a[2, i] * rz
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
