"""Cost and normal equations of N consecutive poses: blocks that couple at most three instants.

What one instant's terms and those between instants know of a bone is gathered per bone, then pushed
up the chain into the blocks (t, t), (t, t - 1) and (t, t - 2).
"""

from __future__ import annotations

from numba import float64 as f8
from numba import int64 as i8

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
from fusecap.kernels.terms.rest import add_rest
from fusecap.kernels.terms.specific_force import add_specific_force


@kernel(
    f8(
        f8[:, ::1], i8, MODEL, WINDOW, POSED_WINDOW, GATHERED_WINDOW, SCRATCH,
        f8[:, :, :, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, :, ::1], f8[:, ::1],
    )
)  # fmt: skip
def evaluate_window(
    theta,
    owned,
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

    Only terms that touch one of the first `owned` instants count. H[t, k] couples instants t and
    t - k, its lower triangle where k = 0. motions (N, B, 6, 3), lever (3, 3, 6) and square
    (10, 3, 3).
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
        mine_counts = t < owned
        if weights.position > 0.0 and mine_counts:
            cost += add_position(
                weights.position, model.landmarks, window.keypoints[t], own, scratch, mine
            )
        if weights.orientation > 0.0 and mine_counts:
            cost += add_orientation(
                weights.orientation, sensors, window.rotation[t], window.present[t], own, mine
            )
        if weights.floor > 0.0 and mine_counts:
            cost += add_floor(weights.floor, model.floor, own, scratch, mine)
        if weights.increment > 0.0 and 0 < t <= owned:
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
        if weights.rest > 0.0 and 0 < t <= owned:
            cost += add_rest(
                weights.rest,
                model.floor,
                window.contact[t],
                window.steps[t - 1],
                Posed(
                    posed.position[t - 1 : t + 1],
                    posed.rotation[t - 1 : t + 1],
                    posed.twist[t - 1 : t + 1],
                ),
                lever,
                Gathered(gathered.information[t - 1 : t + 1], gathered.gradient[t - 1 : t + 1]),
            )
        if t < 2 or t - 2 >= owned:
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
        if weights.projection > 0.0 and t < owned:
            cost += add_prior(
                weights.projection, prior.mean, prior.projector, theta[t], hessian_out[t, 0],
                gradient_out[t],
            )  # fmt: skip
        if weights.deviation > 0.0 and t < owned:
            cost += add_prior(
                weights.deviation, prior.mean, prior.precision, theta[t], hessian_out[t, 0],
                gradient_out[t],
            )  # fmt: skip
    return cost


@kernel("f8(f8[:, :, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, :, ::1], f8[:, ::1])")
def add_folded(information, slope, where, theta, hessian_out, gradient_out):
    """½ dᵀ H d + gᵀ d of the two oldest instants, d = theta - where (2, P).

    information (2, 3, P, P) as `evaluate_window` gives H, slope (2, P) its gradient at `where`.
    """
    size = theta.shape[1]
    cost = 0.0
    for t in range(2):
        for i in range(size):
            d = theta[t, i] - where[t, i]
            pull = 0.0
            for j in range(size):
                value = information[t, 0, i, j] if j <= i else information[t, 0, j, i]
                pull += value * (theta[t, j] - where[t, j])
                hessian_out[t, 0, i, j] += information[t, 0, i, j]
            cost += d * (0.5 * pull + slope[t, i])
            gradient_out[t, i] += pull + slope[t, i]
    for i in range(size):
        d = theta[1, i] - where[1, i]
        pull = 0.0
        for j in range(size):
            value = information[1, 1, i, j]
            pull += value * (theta[0, j] - where[0, j])
            hessian_out[1, 1, i, j] += value
            gradient_out[0, j] += value * d
        cost += d * pull
        gradient_out[1, i] += pull
    return cost
