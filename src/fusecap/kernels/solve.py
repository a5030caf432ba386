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

from fusecap.kernels.cholesky import factor, solve_factored
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

# Arguments that evaluate and solve share, in order; see evaluate for what each means.
_BODY = "i8[::1], f8[:, ::1]"
_CAMERAS = "i8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1]"
_IMUS = "i8[::1], f8[:, :, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8"
_PRIORS = "f8[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8, f8[::1]"
_INPUTS = f"{_BODY}, {_CAMERAS}, {_IMUS}, {_PRIORS}"
_POSED = "f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1]"
_SCRATCH = "f8[:, ::1], f8[:, ::1], f8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1]"


@kernel(f"f8(f8[::1], {_INPUTS}, {_POSED}, {_SCRATCH}, f8[:, ::1], f8[::1])")
def evaluate(
    theta,
    # Body in: parents (B,), offsets (B, 3).
    parents,
    offsets,
    # Cameras in: landmarks on bones, packed cameras (C, 24), keypoints (C, K, 3).
    landmark_bone,
    landmark_offset,
    cameras,
    keypoints,
    # IMUs in: see the orientation and acceleration terms.
    imu_bone,
    imu_rotation,
    imu_weight,
    imu_offset,
    imu_accel,
    imu_history,
    dt,
    # Priors in: PCA mean (3B - 3,), its two matrices, floor joints and radius. Weights (6,) in the
    # order position, orientation, acceleration, projection, deviation, floor; 0 switches one off.
    prior_mean,
    prior_projector,
    prior_precision,
    floor_bone,
    floor_radius,
    weights,
    # Posed body out:
    position_out,
    rotation_out,
    twist_out,
    # Scratch:
    local,
    point_information,
    point_gradient,
    information,
    gathered,
    motion,
    force,
    # Normal equations out (lower triangle of H):
    hessian_out,
    gradient_out,
):
    """Cost at theta, with H and g."""
    forward(theta, parents, offsets, position_out, rotation_out, twist_out, local)
    information[:] = 0.0
    gathered[:] = 0.0
    hessian_out[:] = 0.0
    gradient_out[:] = 0.0
    cost = 0.0
    if weights[0] > 0.0:
        cost += add_position(
            weights[0],
            landmark_bone,
            landmark_offset,
            cameras,
            keypoints,
            position_out,
            rotation_out,
            point_information,
            point_gradient,
            information,
            gathered,
        )
    if weights[1] > 0.0:
        cost += add_orientation(
            weights[1], imu_bone, imu_rotation, imu_weight, rotation_out, information, gathered
        )
    if weights[2] > 0.0:
        cost += add_acceleration(
            weights[2],
            imu_bone,
            imu_offset,
            imu_accel,
            imu_history,
            dt,
            position_out,
            rotation_out,
            point_information,
            point_gradient,
            information,
            gathered,
        )
    if weights[5] > 0.0:
        cost += add_floor(
            weights[5],
            floor_bone,
            floor_radius,
            position_out,
            point_information,
            point_gradient,
            information,
            gathered,
        )
    assemble(
        parents,
        position_out,
        twist_out,
        information,
        gathered,
        motion,
        force,
        hessian_out,
        gradient_out,
    )
    if weights[3] > 0.0:
        cost += add_prior(weights[3], prior_mean, prior_projector, theta, hessian_out, gradient_out)
    if weights[4] > 0.0:
        cost += add_prior(weights[4], prior_mean, prior_precision, theta, hessian_out, gradient_out)
    return cost


@kernel(
    f"Tuple((i8, i8, f8))(f8[::1], i8, f8, f8, {_INPUTS}, {_POSED}, {_SCRATCH}, "
    "f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[::1])"
)
def solve(
    # Pose in and out, made canonical (angles at most pi) at the end:
    theta,
    # Stopping: iterations, relative decrease of the cost, damping μ of the first step.
    max_iterations,
    function_tolerance,
    initial_damping,
    # The same inputs, posed body and scratch as evaluate:
    parents,
    offsets,
    landmark_bone,
    landmark_offset,
    cameras,
    keypoints,
    imu_bone,
    imu_rotation,
    imu_weight,
    imu_offset,
    imu_accel,
    imu_history,
    dt,
    prior_mean,
    prior_projector,
    prior_precision,
    floor_bone,
    floor_radius,
    weights,
    position,
    rotation,
    twist,
    local,
    point_information,
    point_gradient,
    information,
    gathered,
    motion,
    force,
    # Scratch: H (2, n, n) and g (2, n), current and trial; Cholesky factor, damping, step, trial.
    hessian,
    gradient,
    lower,
    damping,
    step,
    trial,
):
    """(status, iterations, cost). hessian[0] and gradient[0] end up at the returned pose."""
    size = theta.size
    cost = evaluate(
        theta, parents, offsets, landmark_bone, landmark_offset, cameras, keypoints,
        imu_bone, imu_rotation, imu_weight, imu_offset, imu_accel, imu_history, dt,
        prior_mean, prior_projector, prior_precision, floor_bone, floor_radius, weights,
        position, rotation, twist, local, point_information, point_gradient,
        information, gathered, motion, force, hessian[0], gradient[0],
    )  # fmt: skip
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
            trial, parents, offsets, landmark_bone, landmark_offset, cameras, keypoints,
            imu_bone, imu_rotation, imu_weight, imu_offset, imu_accel, imu_history, dt,
            prior_mean, prior_projector, prior_precision, floor_bone, floor_radius, weights,
            position, rotation, twist, local, point_information, point_gradient,
            information, gathered, motion, force, hessian[other], gradient[other],
        )  # fmt: skip
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
    forward(theta, parents, offsets, position, rotation, twist, local)
    if current == 1:
        hessian[0] = hessian[1]
        gradient[0] = gradient[1]
    return status, iteration, cost
