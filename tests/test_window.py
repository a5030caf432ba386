"""Instants solved together: terms against their twins, the band, and motions that people make."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import LinAlgError
from scipy.spatial.transform import Rotation

import window_twin
from derivatives import assert_jacobian
from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.pose import forward_kinematics
from fusecap.body.prior import load_prior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.kernels import window as kernel
from fusecap.solve import window_solver
from fusecap.solve.options import (
    JOINT_NOISE_RAD_S2,
    ROOT_NOISE_M_S2,
    SMOOTH,
    SolverOptions,
    Weights,
)
from fusecap.solve.pose_solver import ImuSites, PoseSolver
from fusecap.solve.window_solver import WindowSolver
from fusecap.types import GRAVITY_M_S2, ImuReading, Observation
from scenes import IMU13, measure, pose_error_mm_deg, ring

LANDMARKS = LANDMARK_SETS["body25"]
SHAPE = BodyShape.from_height(PAPER21, 1.75)
RATE_HZ = 60.0
SITES = ImuSites(
    bone=tuple(PAPER21.bone(name) for name in IMU13), position_m=np.full((len(IMU13), 3), 0.03)
)
NOTHING = dict.fromkeys(
    ("position", "orientation", "projection", "deviation", "floor")
    + ("motion", "increment", "specific_force"),
    0.0,
)


def solver(cameras=3, sites=SITES, **weights):
    return PoseSolver(
        shape=SHAPE,
        rig=ring(cameras),
        landmarks=LANDMARKS,
        prior=load_prior(PAPER21),
        sites=sites,
        options=SolverOptions(weights=Weights(**SMOOTH | weights)),
    )


def walk(count, swing=0.5, turn_hz=0.0, speed_m_s=0.3):
    """Arms and legs that swing, on a body that travels and may spin."""
    t = np.arange(count) / RATE_HZ
    theta = np.zeros((count, PAPER21.pose_size))
    theta[:, 0] = speed_m_s * (t - t.mean())
    theta[:, 1] = 0.94 + 0.01 * np.sin(4 * np.pi * t)
    theta[:, 4] = 2 * np.pi * turn_hz * t
    for side, sign in (("left", 1.0), ("right", -1.0)):
        theta[:, 5 + 3 * PAPER21.bone(f"{side}_upper_arm")] = -sign * 1.1
        theta[:, 3 + 3 * PAPER21.bone(f"{side}_thigh")] = sign * swing * np.sin(2 * np.pi * t)
        theta[:, 3 + 3 * PAPER21.bone(f"{side}_shank")] = 0.4 + 0.3 * np.sin(2 * np.pi * t)
    vectors = theta[:, 3:].reshape(-1, 3)
    theta[:, 3:] = Rotation.from_rotvec(vectors).as_rotvec().reshape(count, -1)
    return theta


def observations(theta, cameras=3, sites=SITES, noise_px=0.0, rng=None):
    """What cameras and sensors tell of a motion; accelerations by its own second differences."""
    position, rotation = forward_kinematics(SHAPE, theta)
    bones = list(sites.bone)
    site = position[:, bones] + np.einsum("tiab,ib->tia", rotation[:, bones], sites.position_m)
    accel = np.full(site.shape, np.nan)
    accel[1:-1] = (site[2:] - 2 * site[1:-1] + site[:-2]) * RATE_HZ**2
    result = []
    for t, pose in enumerate(theta):
        keypoints = measure(pose, SHAPE, ring(cameras))[0].keypoints.copy()
        if rng is not None:
            keypoints[:, :, :2] += rng.normal(scale=noise_px, size=keypoints[:, :, :2].shape)
        reading = ImuReading(
            bone_rotation_in_world=rotation[t, bones].copy(), accel_in_world_m_s2=accel[t]
        )
        result.append(
            Observation(
                timestamp_ns=round(t / RATE_HZ * 1e9),
                keypoints=keypoints,
                imu=reading if bones else None,
            )
        )
    return result


def evaluated(pose_solver, theta, seen):
    """(cost, dense H, g) of a window."""
    windows = WindowSolver(pose_solver)
    n, p = theta.shape
    hessian, gradient = np.full((n, 3, p, p), np.inf), np.full((n, p), np.inf)
    times_ns = np.array([one.timestamp_ns for one in seen])
    measured = pose_solver.window(times_ns, seen)
    cost = windows._evaluate(np.ascontiguousarray(theta), measured, hessian, gradient)
    dense = np.zeros((n * p, n * p))
    for t in range(n):
        for k in range(min(t, 2) + 1):
            block = hessian[t, k] if k else np.tril(hessian[t, k])
            rows, columns = slice(t * p, t * p + p), slice((t - k) * p, (t - k) * p + p)
            dense[rows, columns] = block
    return cost, np.tril(dense) + np.tril(dense, -1).T, gradient, hessian


def disturbed(rng, count=5, scale=0.1, **motion):
    return walk(count, **motion) + rng.normal(scale=scale, size=(count, PAPER21.pose_size))


def twin_cost(term, weight, pose_solver, theta, seen):
    times_s = np.array([one.timestamp_ns for one in seen]) * 1e-9
    measured = np.stack([one.imu.bone_rotation_in_world for one in seen])
    if term == "increment":
        return window_twin.increment(SHAPE, SITES, weight, theta, measured)
    if term == "specific_force":
        up = np.array([0.0, GRAVITY_M_S2, 0.0])
        accel = np.stack([one.imu.accel_in_world_m_s2 for one in seen])
        force = np.einsum("tiba,tib->tia", measured, accel + up)
        return window_twin.specific_force(SHAPE, SITES, weight, theta, force, times_s)
    noise = np.array([ROOT_NOISE_M_S2] + [JOINT_NOISE_RAD_S2] * PAPER21.bone_count)
    return window_twin.motion(weight / noise**2, theta, times_s)


@pytest.mark.parametrize("term", SMOOTH)
@pytest.mark.parametrize("turn_hz", [0.0, 25.0], ids=["calm", "turns of 150 deg between instants"])
def test_a_term_between_instants_agrees_with_its_twin_and_its_gradient_with_differences(
    term, turn_hz, rng
):
    theta = disturbed(rng, turn_hz=turn_hz)
    seen = observations(walk(5, turn_hz=turn_hz))
    seen[3] = Observation(
        timestamp_ns=seen[3].timestamp_ns + 4_000_000, keypoints=seen[3].keypoints, imu=seen[3].imu
    )
    pose_solver = solver(**NOTHING | {term: SMOOTH[term]})
    cost, _, gradient, _ = evaluated(pose_solver, theta, seen)
    assert cost == pytest.approx(twin_cost(term, SMOOTH[term], pose_solver, theta, seen), rel=1e-9)
    some = rng.choice(theta.size, 40, replace=False)

    def moved(delta):
        there = theta.copy()
        there.ravel()[some] += delta
        return evaluated(pose_solver, there, seen)[0]

    scale = np.abs(gradient).max()
    assert_jacobian(moved, gradient.ravel()[some], rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize("term", SMOOTH)
def test_a_step_on_one_term_alone_brings_its_residual_down_as_gauss_newton_promises(term, rng):
    theta = disturbed(rng, scale=1e-3)
    seen = observations(walk(5))
    pose_solver = solver(**NOTHING | {term: SMOOTH[term]})
    cost, dense, gradient, _ = evaluated(pose_solver, theta, seen)
    assert np.linalg.eigvalsh(dense).min() > -1e-9 * np.abs(dense).max()
    ridge = 1e-9 * np.abs(dense).max() * np.eye(len(dense))
    step = np.linalg.solve(dense + ridge, -gradient.ravel()).reshape(theta.shape)
    after = evaluated(pose_solver, theta + step, seen)[0]
    assert after < 0.05 * cost


def test_a_band_solve_is_a_dense_solve(rng):
    theta, pose_solver = disturbed(rng, count=4, scale=0.02), solver()
    _, dense, gradient, hessian = evaluated(pose_solver, theta, observations(walk(4)))
    n, p = theta.shape
    band = np.zeros((n * p, 3 * p))
    kernel.banded(hessian, 1e-3, band)
    damped = dense + np.diag(1e-3 * np.maximum(np.diag(dense), 1e-6) + 1e-12)
    step = window_solver.cho_solve_banded(
        (window_solver.cholesky_banded(band.T, lower=True), True), -gradient.ravel()
    )
    np.testing.assert_allclose(step, np.linalg.solve(damped, -gradient.ravel()), atol=1e-9)


def test_noise_goes_and_the_motion_stays(rng):
    truth = walk(90)
    pose_solver = solver()
    seen = observations(truth, noise_px=6.0, rng=rng)
    alone = truth + rng.normal(scale=0.01, size=truth.shape)
    together = WindowSolver(pose_solver).smooth(alone, seen)
    before = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(alone, truth, strict=True)]
    after = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(together, truth, strict=True)]
    assert np.mean(after) < 0.7 * np.mean(before)
    jerk = [np.linalg.norm(np.diff(m[:, :3], 3, axis=0), axis=1).mean() for m in (alone, together)]
    assert jerk[1] < 0.02 * jerk[0]


def test_pieces_give_the_motion_of_the_whole(rng, monkeypatch):
    truth, pose_solver = walk(150), solver()
    seen = observations(truth, noise_px=4.0, rng=rng)
    alone = truth + rng.normal(scale=0.01, size=truth.shape)
    monkeypatch.setattr(window_solver, "PIECE", 200)
    whole = WindowSolver(pose_solver).smooth(alone, seen)
    monkeypatch.setattr(window_solver, "PIECE", 40)
    pieces = WindowSolver(pose_solver).smooth(alone, seen)
    apart = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(whole, pieces, strict=True)]
    assert max(apart) < 1.0


def test_a_spinning_person_goes_on_spinning(rng):
    truth = walk(120, turn_hz=2.0)
    seen = observations(truth, noise_px=2.0, rng=rng)
    together = WindowSolver(solver()).smooth(truth, seen)
    errors = [pose_error_mm_deg(SHAPE, a, b) for a, b in zip(together, truth, strict=True)]
    assert np.linalg.norm(together[:, 3:6], axis=1).max() <= np.pi + 1e-9
    assert max(mm for mm, _ in errors) < 40.0
    assert max(deg for _, deg in errors) < 30.0


def test_a_landing_from_a_height_is_not_smoothed_away(rng):
    truth = walk(90, swing=0.0, speed_m_s=0.0)
    t = np.arange(90) / RATE_HZ
    truth[:, 1] = np.maximum(0.94, 0.94 + 1.0 - 0.5 * GRAVITY_M_S2 * t**2)
    seen = observations(truth, noise_px=2.0, rng=rng)
    together = WindowSolver(solver()).smooth(truth, seen)
    assert np.abs(together[:, 1] - truth[:, 1]).max() < 0.02


def test_a_shock_of_sixteen_g_in_one_sensor_leaves_the_motion(rng):
    truth = walk(60)
    seen = observations(truth, noise_px=2.0, rng=rng)
    calm = WindowSolver(solver()).smooth(truth, seen)
    for t in (30, 31):
        seen[t].imu.accel_in_world_m_s2[5] = [0.0, 16 * GRAVITY_M_S2, 0.0]
    shocked = WindowSolver(solver()).smooth(truth, seen)
    apart = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(calm, shocked, strict=True)]
    assert max(apart) < 10.0


def test_a_gap_ends_a_motion_and_begins_another(rng):
    truth, pose_solver = walk(40), solver()
    seen = observations(truth, noise_px=4.0, rng=rng)
    late = [
        Observation(
            timestamp_ns=one.timestamp_ns + (10**9 if t >= 20 else 0),
            keypoints=one.keypoints,
            imu=one.imu,
        )
        for t, one in enumerate(seen)
    ]
    windows = WindowSolver(pose_solver)
    both = windows.smooth(truth, late)
    np.testing.assert_array_equal(both[:20], windows.smooth(truth[:20], seen[:20]))
    np.testing.assert_array_equal(both[20:], windows.smooth(truth[20:], late[20:]))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_poses_stay_as_they_are(count):
    truth = walk(5)[:count]
    seen = observations(walk(5))[:count]
    np.testing.assert_array_equal(WindowSolver(solver()).smooth(truth, seen), truth)


def test_sensors_that_are_silent_or_absent_are_no_reason_to_fail(rng):
    truth = walk(20)
    seen = observations(truth, noise_px=2.0, rng=rng)
    for t in range(5, 12):
        seen[t].imu.bone_rotation_in_world[3] = np.nan
        seen[t].imu.accel_in_world_m_s2[:] = np.nan
    seen[15] = Observation(timestamp_ns=seen[15].timestamp_ns, keypoints=seen[15].keypoints)
    together = WindowSolver(solver()).smooth(truth, seen)
    assert np.isfinite(together).all()
    assert max(pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(together, truth, strict=True)) < 40


def test_nothing_measured_is_a_motion_too():
    truth = walk(10)
    seen = observations(truth, cameras=1, sites=ImuSites.none())
    blind = [
        Observation(timestamp_ns=one.timestamp_ns, keypoints=np.full_like(one.keypoints, np.nan))
        for one in seen
    ]
    assert np.isfinite(WindowSolver(solver(1, ImuSites.none())).smooth(truth, blind)).all()


def test_a_matrix_that_cannot_be_factored_leaves_the_poses(monkeypatch):
    def refuse(*_, **__):
        raise LinAlgError

    monkeypatch.setattr(window_solver, "cholesky_banded", refuse)
    truth = walk(6)
    np.testing.assert_array_equal(WindowSolver(solver()).smooth(truth, observations(truth)), truth)
