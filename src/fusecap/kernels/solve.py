"""Levenberg-Marquardt over one pose: the whole of eq. 2 in one compiled call.

Each step solves (H + μ diag H) δ = -g, where H and g come from all terms at the current pose with
their robust weights. A step that lowers the cost is taken and μ shrinks with the gain ratio
(Nielsen 1999); one that does not is refused and μ grows. Linearisation is fused with evaluation,
because warm-started steps are nearly always taken.

Nothing is allocated and the GIL is not held: the caller brings all arrays, so subjects can be
solved on threads. A pose that is not finite is never returned: without finite improvement the start
comes back, with status DIVERGED.
"""

from __future__ import annotations

from numba import float64 as f8
from numba import int64 as i8
from numba import types

from fusecap.kernels.cholesky import factor, solve_factored
from fusecap.kernels.groups import (
    GATHERED,
    MEASURED,
    MODEL,
    POSED,
    SCRATCH,
    Body,
    Floor,
    Gathered,
    Landmarks,
    Measured,
    Model,
    Posed,
    Prior,
    Scratch,
    SensorSites,
    TermWeights,
    plain_type,
)
from fusecap.kernels.information import assemble
from fusecap.kernels.jit import FINITE, kernel
from fusecap.kernels.kinematics import forward
from fusecap.kernels.lie import wrap_pose
from fusecap.kernels.terms.acceleration import add_acceleration
from fusecap.kernels.terms.floor import add_floor
from fusecap.kernels.terms.orientation import add_orientation
from fusecap.kernels.terms.position import add_position
from fusecap.kernels.terms.prior import add_prior

CONVERGED = 0
ITERATION_LIMIT = 1
DIVERGED = 2

_PLAIN = plain_type(MODEL, MEASURED, POSED, GATHERED, SCRATCH)
_MATRIX, _VECTOR = f8[:, ::1], f8[::1]


@kernel(f8(_VECTOR, MODEL, MEASURED, POSED, GATHERED, SCRATCH, _MATRIX, _VECTOR))
def evaluate(theta, model, measured, posed, gathered, scratch, hessian_out, gradient_out):
    """Cost at theta, with the lower triangle of H (P, P), and g (P,); leaves the posed body."""
    weights, prior = model.weights, model.prior
    forward(theta, model.body, posed, scratch)
    gathered.information[:] = 0.0
    gathered.gradient[:] = 0.0
    hessian_out[:] = 0.0
    gradient_out[:] = 0.0
    cost = 0.0
    if weights.position > 0.0:
        cost += add_position(
            weights.position, model.landmarks, measured.keypoints, posed, scratch, gathered
        )
    if weights.orientation > 0.0:
        cost += add_orientation(
            weights.orientation, model.sensors, measured.rotation, measured.present, posed, gathered
        )
    if weights.acceleration > 0.0:
        cost += add_acceleration(
            weights.acceleration, model.sensors, measured, posed, scratch, gathered
        )
    if weights.floor > 0.0:
        cost += add_floor(weights.floor, model.floor, posed, scratch, gathered)
    assemble(model.body, posed, gathered, scratch, hessian_out, gradient_out)
    if weights.projection > 0.0:
        cost += add_prior(
            weights.projection, prior.mean, prior.projector, theta, hessian_out, gradient_out
        )
    if weights.deviation > 0.0:
        cost += add_prior(
            weights.deviation, prior.mean, prior.precision, theta, hessian_out, gradient_out
        )
    return cost


@kernel(
    types.Tuple([i8, i8, f8])(
        _VECTOR, i8, f8, f8, _PLAIN, f8[:, :, ::1], _MATRIX, _MATRIX, _VECTOR, _VECTOR, _VECTOR
    )
)
def solve(
    # Pose in and out, made canonical (angles at most pi) at the end:
    theta,
    # Stopping: iterations, relative decrease of the cost, damping μ of the first step.
    max_iterations,
    function_tolerance,
    initial_damping,
    # (model, measured, posed, gathered, scratch) as `groups.plain` gives it.
    inputs,
    # Scratch: H (2, n, n) and g (2, n), current and trial; Cholesky factor, damping, step, trial.
    hessian,
    gradient,
    lower,
    damping,
    step,
    trial,
):
    """(status, iterations, cost). hessian[0] and gradient[0] end up at the returned pose."""
    constant = inputs[0]
    model = Model(
        TermWeights(*constant[0]),
        Body(*constant[1]),
        Landmarks(*constant[2]),
        SensorSites(*constant[3]),
        Prior(*constant[4]),
        Floor(*constant[5]),
    )
    measured = Measured(*inputs[1])
    posed = Posed(*inputs[2])
    gathered = Gathered(*inputs[3])
    scratch = Scratch(*inputs[4])
    size = theta.size
    cost = evaluate(theta, model, measured, posed, gathered, scratch, hessian[0], gradient[0])
    if not cost < FINITE:
        return DIVERGED, 0, cost
    mu = initial_damping
    growth = 2.0
    status = ITERATION_LIMIT
    iteration = 0
    moved = False
    current = 0
    while iteration < max_iterations:
        iteration += 1
        h = hessian[current]
        g = gradient[current]
        for i in range(size):
            # The floor under the diagonal leaves unobserved directions where they are.
            damping[i] = mu * max(h[i, i], 1e-6) + 1e-12
            trial[i] = -g[i]
        if not factor(h, damping, lower):
            mu *= growth
            growth *= 2.0
            if mu > 1e12:
                break
            continue
        solve_factored(lower, trial, step)
        predicted = 0.0
        for i in range(size):
            # ½ δᵀ(μ D δ - g): the decrease that the quadratic model promises.
            predicted += 0.5 * step[i] * (damping[i] * step[i] - g[i])
            trial[i] = theta[i] + step[i]
        if not predicted > function_tolerance * cost + 1e-28:
            # Not worth an evaluation, without which no step is taken.
            status = CONVERGED
            break
        other = 1 - current
        trial_cost = evaluate(
            trial, model, measured, posed, gathered, scratch, hessian[other], gradient[other]
        )
        if trial_cost < cost:
            moved = True
            decrease = cost - trial_cost
            for i in range(size):
                theta[i] = trial[i]
            current = other
            ratio = 2.0 * decrease / predicted - 1.0
            mu *= max(0.2, 1.0 - ratio * ratio * ratio)
            growth = 2.0
            small = decrease <= function_tolerance * cost
            cost = trial_cost
            if small:
                status = CONVERGED
                break
        else:
            mu *= growth
            growth *= 2.0
            if mu > 1e12:
                break
    if status != CONVERGED and not moved:
        status = DIVERGED
    wrap_pose(theta)
    forward(theta, model.body, posed, scratch)
    if current == 1:
        hessian[0] = hessian[1]
        gradient[0] = gradient[1]
    return status, iteration, cost
