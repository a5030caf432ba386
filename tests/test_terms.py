"""Every cost term against its paper-like twin: value, gradient and Gauss-Newton matrix."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from derivatives import assert_jacobian
from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites, Measurements, PoseSolver
from paper_twin import Twin
from scenes import IMU13, flat_prior, measure, random_pose, ring

ALL_TERMS = SolverOptions(weights=Weights.paper())
TERMS = ("position", "orientation", "acceleration", "projection", "deviation", "floor")
LANDMARKS = LANDMARK_SETS["body25"]


def only(term: str) -> SolverOptions:
    weights = dict.fromkeys(TERMS, 0.0)
    weights[term] = {"position": 1e-3, "floor": 10.0}.get(term, 0.3)
    return SolverOptions(weights=Weights(**weights))


def scene(rng, options, *, skeleton=PAPER21, angle=0.4, distortion=(0, 0, 0, 0, 0)):
    shape = BodyShape.from_height(skeleton, 1.75)
    rig = ring(3, distortion=distortion)
    truth = random_pose(rng, angle, skeleton)
    data, sites = measure(truth, shape, rig, imu_bones=IMU13)
    keypoints = data.keypoints.copy()
    keypoints[:, :, :2] += rng.normal(scale=20, size=keypoints[:, :, :2].shape)
    data = Measurements(
        keypoints=keypoints,
        imu_rotation=data.imu_rotation,
        imu_accel=rng.normal(scale=3, size=(len(IMU13), 3)),
        imu_history=data.imu_history + rng.normal(scale=1e-3, size=(2, len(IMU13), 3)),
        dt_s=1 / 60,
    )
    prior = flat_prior(skeleton)
    theta = truth + rng.normal(scale=0.1, size=truth.shape)
    solver = PoseSolver(
        shape=shape, rig=rig, landmarks=LANDMARKS, prior=prior, sites=sites, options=options
    )
    twin = Twin(shape, rig, LANDMARKS, prior, data, sites, options)
    return solver, twin, theta, data


def assert_agrees(solver, twin, theta, data, *, hessian=True):
    cost, gradient, matrix = solver.evaluate(theta, data)
    assert cost == pytest.approx(twin.cost(theta), rel=1e-9, abs=1e-12)
    expected_gradient, expected_matrix = twin.normal_equations(theta)
    scale = max(1.0, np.abs(expected_gradient).max())
    np.testing.assert_allclose(gradient, expected_gradient, atol=2e-6 * scale)
    if hessian:
        scale = max(1.0, np.abs(expected_matrix).max())
        np.testing.assert_allclose(matrix, expected_matrix, atol=2e-6 * scale)


def assert_gradient_is_that_of_the_cost(solver, theta, data):
    _, gradient, _ = solver.evaluate(theta, data)
    assert_jacobian(
        lambda delta: solver.evaluate(theta + delta, data)[0],
        gradient,
        rtol=2e-4,
        atol=2e-4 * max(1, abs(gradient).max()),
    )


@pytest.mark.parametrize("term", TERMS)
def test_term_agrees_with_its_twin(term, rng):
    solver, twin, theta, data = scene(rng, only(term))
    if term == "floor":
        theta[1] = 0.4
    assert_agrees(solver, twin, theta, data)
    assert_gradient_is_that_of_the_cost(solver, theta, data)


def test_all_terms_together_agree_with_the_twin(rng):
    solver, twin, theta, data = scene(rng, ALL_TERMS)
    assert_agrees(solver, twin, theta, data)


def test_position_term_agrees_under_lens_distortion(rng):
    solver, twin, theta, data = scene(
        rng, only("position"), distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01)
    )
    assert_agrees(solver, twin, theta, data)


def test_extended_skeleton_agrees_with_the_twin(rng):
    solver, twin, theta, data = scene(rng, ALL_TERMS, skeleton=EXTENDED23)
    assert_agrees(solver, twin, theta, data)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-5])
def test_derivatives_hold_near_the_zero_pose(size, rng):
    solver, twin, _, data = scene(rng, ALL_TERMS, angle=size)
    theta = random_pose(rng, size)
    assert_agrees(solver, twin, theta, data)


@pytest.mark.parametrize("degrees", [90.0, 170.0, 179.9])
def test_orientation_gradient_is_right_up_to_half_a_turn(degrees, rng):
    solver, twin, theta, data = scene(rng, only("orientation"))
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix()
    solved = twin.bones_in_world(theta)
    turned = np.stack([solved[bone][:3, :3] @ turn for bone in twin.sites.bone])
    data = Measurements(
        keypoints=data.keypoints,
        imu_rotation=turned,
        imu_accel=data.imu_accel,
        imu_history=data.imu_history,
        dt_s=data.dt_s,
    )
    twin.data = data
    assert_agrees(solver, twin, theta, data)


def test_derivatives_hold_with_a_root_turned_by_almost_a_full_turn(rng):
    solver, twin, theta, data = scene(rng, ALL_TERMS)
    theta[3:6] = np.array([0.1, 0.99, 0.05]) * 6.0
    assert_agrees(solver, twin, theta, data)


def test_point_behind_camera_has_no_gradient_but_costs_as_an_outlier(rng):
    solver, twin, theta, data = scene(rng, only("position"))
    theta[:3] += 2.5 * twin.rig.cameras[0].position_in_world * [1, 0, 1]
    assert_agrees(solver, twin, theta, data)
    lonely = Measurements(
        keypoints=np.where(np.arange(3)[:, None, None] == 0, data.keypoints, 0.0),
        imu_rotation=data.imu_rotation,
        imu_accel=data.imu_accel,
        imu_history=data.imu_history,
        dt_s=data.dt_s,
    )
    cost, gradient, _ = solver.evaluate(theta, lonely)
    assert cost > 0 and not gradient.any()


def test_missing_data_neither_costs_nor_pulls(rng):
    solver, twin, theta, data = scene(rng, ALL_TERMS)
    keypoints = data.keypoints.copy()
    keypoints[0, ::2] = [np.nan, np.nan, 0.0]
    keypoints[1, ::3] = [np.nan, np.nan, 0.7]
    keypoints[2, 5] = [100.0, 100.0, np.nan]
    imu_rotation, imu_accel = data.imu_rotation.copy(), data.imu_accel.copy()
    imu_rotation[::2] = np.nan
    imu_accel[::3] = np.nan
    data = Measurements(
        keypoints=keypoints,
        imu_rotation=imu_rotation,
        imu_accel=imu_accel,
        imu_history=data.imu_history,
        dt_s=data.dt_s,
    )
    twin.data = data
    assert_agrees(solver, twin, theta, data)


def test_nothing_measured_leaves_only_the_prior(rng):
    shape = BodyShape.from_height(PAPER21, 1.75)
    prior = flat_prior()
    solver = PoseSolver(shape=shape, rig=ring(0), landmarks=LANDMARKS, prior=prior)
    data, _ = measure(random_pose(rng), shape, ring(0))
    theta = random_pose(rng)
    solution = solver.solve(theta, data)
    np.testing.assert_allclose(solution.theta[6:], prior.mean, atol=1e-2)
    np.testing.assert_allclose(solution.theta[[0, 2, 3, 4, 5]], theta[[0, 2, 3, 4, 5]], atol=1e-9)


def test_sites_without_sensors_are_empty():
    assert ImuSites.none().position_m.shape == (0, 3)
