"""Rotations, kinematics, projection and linear algebra of the kernels against SciPy and NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numba.core.caching import CacheImpl
from scipy.spatial.transform import Rotation

from derivatives import assert_jacobian
from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.kernels import cholesky, groups, jit, kinematics, lie, projection
from fusecap.kernels.terms.orientation import relative_quaternion
from scenes import random_pose, ring


def test_kernels_compile_where_nothing_can_keep_them(monkeypatch, caplog):
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])
    monkeypatch.setattr(jit, "_announced", False)
    twice = [jit.kernel("float64(float64)")(lambda x: 2.0 * x) for _ in range(2)]
    assert twice[0](2.0) == twice[1](2.0) == 4.0
    assert [record.message.count("NUMBA_CACHE_DIR") for record in caplog.records] == [1]


vectors = arrays(np.float64, 3, elements=st.floats(-6.0, 6.0))
scales = st.sampled_from([1.0, 1e-3, 1e-5, 1e-9, 0.0])


def exp(vector):
    out = np.full((3, 3), np.inf)
    lie.exp_so3(*vector, out)
    return out


@given(vectors, scales)
def test_exp_agrees_with_scipy_also_near_zero(vector, scale):
    vector = vector * scale
    expected = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(exp(vector), expected, atol=2e-12)


@given(vectors, scales)
def test_left_jacobian_is_the_derivative_of_exp(vector, scale):
    vector = vector * scale
    jacobian = np.full((3, 3), np.inf)
    lie.left_jacobian_so3(*vector, jacobian)
    assert_jacobian(
        lambda delta: Rotation.from_matrix(exp(vector + delta) @ exp(vector).T).as_rotvec(),
        jacobian,
        atol=1e-7,
    )


@given(vectors)
def test_wrapping_keeps_the_rotation_and_ends_at_most_at_pi(vector):
    theta = np.concatenate([[1.0, 2.0, 3.0], vector * 3])
    wrapped = theta.copy()
    lie.wrap_pose(wrapped)
    assert np.linalg.norm(wrapped[3:]) <= np.pi + 1e-9
    np.testing.assert_allclose(exp(wrapped[3:]), exp(theta[3:]), atol=1e-11)
    np.testing.assert_array_equal(wrapped[:3], theta[:3])


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23])
def test_kernel_kinematics_agree_with_the_vectorised_ones(skeleton, rng):
    shape = BodyShape.from_height(skeleton, 1.8)
    theta = random_pose(rng, 1.0, skeleton)
    b = skeleton.bone_count
    position, rotation = np.full((b, 3), np.inf), np.full((b, 3, 3), np.inf)
    kinematics.forward(
        theta,
        groups.Body(parents=skeleton.parent_array, offsets=shape.offsets_m),
        groups.Posed(position=position, rotation=rotation, twist=np.full((b, 3, 3), np.inf)),
        groups.Scratch(
            local=np.zeros((3, 3)),
            information=np.zeros((3, 3)),
            gradient=np.zeros(3),
            motion=np.zeros((b, 6, 3)),
            force=np.zeros((6, 3)),
        ),
    )
    expected_position, expected_rotation = forward_kinematics(shape, theta[None])
    np.testing.assert_allclose(position, expected_position[0], atol=1e-12)
    np.testing.assert_allclose(rotation, expected_rotation[0], atol=1e-12)


@pytest.mark.parametrize("distortion", [(0, 0, 0, 0, 0), (-0.2, 0.05, 1e-3, -2e-3, 0.01)])
def test_projection_agrees_with_the_camera_and_its_jacobian_with_differences(distortion, rng):
    camera = ring(1, distortion=distortion).cameras[0]
    for point in rng.normal(scale=0.8, size=(20, 3)) + [0, 1, 0]:
        values = np.array(projection.project_with_jacobian(camera.packed, *point))
        assert values[0] == 1.0
        np.testing.assert_allclose(values[1:3], camera.project(point[None])[0], atol=1e-9)
        assert_jacobian(
            lambda delta, point=point: camera.project((point + delta)[None])[0],
            values[3:].reshape(2, 3),
            atol=1e-4,
        )


def test_a_point_behind_the_camera_is_not_imaged():
    camera = ring(1).cameras[0]
    behind = camera.position_in_world - camera.rotation[2]
    assert projection.project_with_jacobian(camera.packed, *behind) == (0.0,) * 9
    assert np.isnan(camera.project(behind[None])).all()


def test_a_point_beyond_the_range_of_the_distortion_is_not_imaged():
    camera = ring(1, distortion=(-0.3, 0, 0, 0, 0)).cameras[0]
    assert camera.max_radius_squared == pytest.approx(1 / 0.9)
    sideways = camera.position_in_world + camera.rotation[2] + 1.2 * camera.rotation[0]
    assert projection.project_with_jacobian(camera.packed, *sideways)[0] == 0.0


@pytest.mark.parametrize("size", [1, 5, 66])
def test_cholesky_solves_and_gives_the_diagonal_of_the_inverse(size, rng):
    root = rng.normal(size=(size, size))
    matrix = root @ root.T + np.eye(size)
    lower = np.full((size, size), np.inf)
    assert cholesky.factor(matrix, np.full(size, 0.5), lower)
    right = rng.normal(size=size)
    solution = np.full(size, np.inf)
    cholesky.solve_factored(lower, right, solution)
    damped = matrix + 0.5 * np.eye(size)
    np.testing.assert_allclose(damped @ solution, right, atol=1e-9)


def test_cholesky_refuses_what_is_not_positive_definite():
    lower = np.zeros((2, 2))
    assert not cholesky.factor(np.diag([1.0, -1.0]), np.zeros(2), lower)
    assert not cholesky.factor(np.full((2, 2), np.nan), np.zeros(2), lower)


@pytest.mark.parametrize("axis", [(1, 0.2, 0.1), (0.2, 1, 0.1), (0.1, 0.2, 1)])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, 3.0, 3.1415, 3.2])
def test_relative_quaternions_are_those_of_scipy_about_every_axis(axis, angle, rng):
    first = Rotation.random(rng=rng)
    turn = Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis))
    relative = np.array(relative_quaternion(first.as_matrix(), (first * turn).as_matrix()))
    expected = turn.as_quat()[[3, 0, 1, 2]]
    np.testing.assert_allclose(relative, expected * (1 if expected[0] >= 0 else -1), atol=1e-9)
