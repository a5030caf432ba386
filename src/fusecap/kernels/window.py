"""Cost and normal equations of N consecutive poses: blocks that couple at most three instants.

What one instant's terms and those between instants know of a bone is gathered per bone, then pushed
up the chain into the blocks (t, t), (t, t - 1) and (t, t - 2).
"""

from __future__ import annotations

from numba import float64 as f8

from fusecap.kernels.between import assemble_between, joint_motions
from fusecap.kernels.groups import (
    GATHERED_WINDOW,
    MODEL,
    POSED_WINDOW,
    SCRATCH,
    WINDOW,
    Gathered,
    Posed,
    Scratch,
)
from fusecap.kernels.information import assemble
from fusecap.kernels.jit import kernel
from fusecap.kernels.kinematics import forward
from fusecap.kernels.terms.floor import add_floor
from fusecap.kernels.terms.increment import add_increment
from fusecap.kernels.terms.motion import add_motion
from fusecap.kernels.terms.orientation import add_orientation
from fusecap.kernels.terms.position import add_position
from fusecap.kernels.terms.prior import add_prior
from fusecap.kernels.terms.specific_force import add_specific_force


@kernel(
    f8(
        f8[:, ::1], MODEL, WINDOW, POSED_WINDOW, GATHERED_WINDOW, SCRATCH,
        f8[:, :, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, :, ::1], f8[:, ::1],
    )
)  # fmt: skip
def evaluate_window(
    theta,
    model,
    window,
    posed,
    gathered,
    # Scratch:
    scratch,
    motions,
    lever,
    square,
    # Normal equations out:
    hessian_out,
    gradient_out,
):
    """Cost at theta (N, P), with H (N, 3, P, P) and g (N, P).

    H[t, k] couples instants t and t - k, its lower triangle where k = 0. motions (N, B, 6, 3),
    lever (3, 3, 6) and square (10, 3, 3).
    """
    weights, prior, sensors = model.weights, model.prior, model.sensors
    count = theta.shape[0]
    gathered.information[:] = 0.0
    gathered.gradient[:] = 0.0
    hessian_out[:] = 0.0
    gradient_out[:] = 0.0
    cost = 0.0
    for t in range(count):
        own = Posed(posed.position[t], posed.rotation[t], posed.twist[t])
        mine = Gathered(gathered.information[t, 0], gathered.gradient[t])
        forward(theta[t], model.body, own, scratch)
        joint_motions(own, motions[t])
        if weights.position > 0.0:
            cost += add_position(
                weights.position, model.landmarks, window.keypoints[t], own, scratch, mine
            )
        if weights.orientation > 0.0:
            cost += add_orientation(
                weights.orientation, sensors, window.rotation[t], window.present[t], own, mine
            )
        if weights.floor > 0.0:
            cost += add_floor(weights.floor, model.floor, own, scratch, mine)
        if weights.increment > 0.0 and t > 0:
            cost += add_increment(
                weights.increment,
                sensors,
                window.rotation[t - 1],
                window.rotation[t],
                Posed(posed.position[t - 1], posed.rotation[t - 1], posed.twist[t - 1]),
                own,
                Gathered(gathered.information[t - 1, 0], gathered.gradient[t - 1]),
                mine,
                gathered.information[t, 1],
                square,
            )
        if t < 2:
            continue
        first, end = t - 2, t + 1
        if weights.specific_force > 0.0:
            mean = 2.0 / (window.steps[first] + window.steps[first + 1])
            scratch.gradient[0] = mean / window.steps[first]
            scratch.gradient[2] = mean / window.steps[first + 1]
            scratch.gradient[1] = -scratch.gradient[0] - scratch.gradient[2]
            cost += add_specific_force(
                weights.specific_force,
                sensors,
                window.force[t - 1],
                scratch.gradient,
                Posed(posed.position[first:end], posed.rotation[first:end], posed.twist[first:end]),
                lever,
                Gathered(gathered.information[first:end], gathered.gradient[first:end]),
            )
        if weights.motion > 0.0:
            cost += add_motion(
                weights.motion,
                window.steadiness,
                theta[first:end],
                window.steps[first : first + 2],
                square,
                hessian_out[first:end],
                gradient_out[first:end],
            )
    for t in range(count):
        for k in range(1, min(t, 2) + 1):
            assemble_between(
                model.body, motions[t], motions[t - k], gathered.information[t, k],
                scratch.force, hessian_out[t, k],
            )  # fmt: skip
        assemble(
            model.body,
            Posed(posed.position[t], posed.rotation[t], posed.twist[t]),
            Gathered(gathered.information[t, 0], gathered.gradient[t]),
            Scratch(
                scratch.local, scratch.information, scratch.gradient, motions[t], scratch.force
            ),
            hessian_out[t, 0],
            gradient_out[t],
        )
        if weights.projection > 0.0:
            cost += add_prior(
                weights.projection, prior.mean, prior.projector, theta[t], hessian_out[t, 0],
                gradient_out[t],
            )  # fmt: skip
        if weights.deviation > 0.0:
            cost += add_prior(
                weights.deviation, prior.mean, prior.precision, theta[t], hessian_out[t, 0],
                gradient_out[t],
            )  # fmt: skip
    return cost


@kernel("void(f8[:, :, :, ::1], f8, f8[:, ::1])")
def banded(hessian, damping, band_out):
    """Lower band (N P, 3 P): band_out[column, row - column]; the diagonal damped."""
    count, size = hessian.shape[0], hessian.shape[2]
    band_out[:] = 0.0
    for t in range(count):
        for k in range(min(t, 2) + 1):
            block = hessian[t, k]
            for i in range(size):
                for j in range(i + 1 if k == 0 else size):
                    band_out[(t - k) * size + j, k * size + i - j] = block[i, j]
        for i in range(size):
            d = hessian[t, 0, i, i]
            band_out[t * size + i, 0] += damping * max(d, 1e-6) + 1e-12
