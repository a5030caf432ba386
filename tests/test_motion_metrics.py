"""Jitter, acceleration error, foot skate, axial rotation, tracks: worked examples, second opinions.

The second opinions are slow loops, SciPy's rotations and polynomials whose derivatives are known.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.metrics import (
    acceleration_error_m_s2,
    aligned_orientation_error_rad,
    axial_error_rad,
    false_tracks,
    foot_contact,
    foot_skate_m_s,
    jitter_m_s3,
    long_axes,
    missed_tracks,
    orientation_error_rad,
    procrustes,
    standing_heights_m,
    swing_error_rad,
)
from fusecap.evaluate.score import score_take
from motions import person, take_of, walk

RATE_HZ = 60.0


def polynomial(*coefficients: float, frames: int = 12) -> np.ndarray:
    """One joint (T, 1, 3) that moves along x by a polynomial in seconds, lowest power first."""
    time_s = np.arange(frames) / RATE_HZ
    points = np.zeros((frames, 1, 3))
    points[:, 0, 0] = np.polynomial.polynomial.polyval(time_s, coefficients)
    return points


def test_jitter_of_a_cubic_is_six_times_its_coefficient():
    jitter = jitter_m_s3(polynomial(1.0, -2.0, 3.0, 0.5), RATE_HZ)
    assert np.isnan(jitter[[0, 1, -1]]).all()
    assert np.allclose(jitter[2:-1], 3.0)


def test_acceleration_error_of_a_parabola_is_twice_its_coefficient():
    error = acceleration_error_m_s2(polynomial(1.0, 2.0, 0.75), polynomial(0.0), RATE_HZ)
    assert np.isnan(error[[0, -1]]).all()
    assert np.allclose(error[1:-1], 1.5)


def test_a_constant_offset_and_a_constant_drift_are_no_acceleration_error(rng):
    truth = rng.normal(size=(9, 4, 3))
    drifting = truth + [0.3, 0, 0] + np.arange(9)[:, None, None] * 0.01
    assert np.nanmax(acceleration_error_m_s2(drifting, truth, RATE_HZ)) < 1e-9


def test_jitter_and_acceleration_agree_with_loops(rng):
    estimate, truth = rng.normal(size=(2, 3, 10, 4, 3))
    jitter = jitter_m_s3(estimate, RATE_HZ)
    error = acceleration_error_m_s2(estimate, truth, RATE_HZ)
    for person_, frame, joint in np.ndindex(3, 10, 4):
        x, y = estimate[person_, :, joint], truth[person_, :, joint]
        if 2 <= frame < 9:
            jerk = (x[frame + 1] - 3 * x[frame] + 3 * x[frame - 1] - x[frame - 2]) * RATE_HZ**3
            assert jitter[person_, frame, joint] == pytest.approx(np.sqrt((jerk**2).sum()))
        if 1 <= frame < 9:
            a = (x[frame + 1] - 2 * x[frame] + x[frame - 1]) * RATE_HZ**2
            b = (y[frame + 1] - 2 * y[frame] + y[frame - 1]) * RATE_HZ**2
            assert error[person_, frame, joint] == pytest.approx(np.sqrt(((a - b) ** 2).sum()))


def test_a_millimetre_of_white_noise_costs_what_the_docstring_says(rng):
    noise = 1e-3 * rng.standard_normal((20_000, 1, 3))
    error = np.nanmean(acceleration_error_m_s2(noise, np.zeros_like(noise), RATE_HZ))
    assert error == pytest.approx(14.1, rel=0.02)
    assert np.nanmean(jitter_m_s3(noise, RATE_HZ)) * 1e-3 == pytest.approx(1.54, rel=0.02)


def test_differences_do_not_reach_across_a_gap(rng):
    points = rng.normal(size=(12, 1, 3))
    points[6] = np.nan
    unknown = np.isnan(jitter_m_s3(points, RATE_HZ)[:, 0])
    assert np.flatnonzero(~unknown).tolist() == [2, 3, 4, 9, 10]
    unknown = np.isnan(acceleration_error_m_s2(points, np.zeros_like(points), RATE_HZ)[:, 0])
    assert np.flatnonzero(~unknown).tolist() == [1, 2, 3, 4, 8, 9, 10]


def test_too_few_frames_have_no_jitter_and_no_acceleration():
    points = np.zeros((2, 1, 3))
    assert np.isnan(jitter_m_s3(points, RATE_HZ)).all()
    assert np.isnan(acceleration_error_m_s2(points, points, RATE_HZ)).all()


def test_a_foot_is_in_contact_while_slow_and_low():
    foot = np.zeros((6, 1, 3))
    foot[:, 0, 1] = [0.10, 0.10, 0.10, 0.14, 0.20, 0.20]
    foot[1:, 0, 0] = 0.02
    # From 0 to 1 it moves 1.2 m/s, from 2 to 3 it rises, and then it is too high.
    contact = foot_contact(foot, np.array([0.07]), RATE_HZ)
    assert contact[:, 0].tolist() == [False, True, False, False, False, False]


def test_foot_skate_is_the_horizontal_speed_during_contact():
    estimate = np.zeros((4, 1, 3))
    estimate[:, 0] = [[0, 0, 0], [0.003, 0.5, 0.004], [1, 0, 0], [2, 0, 0]]
    contact = np.array([[True], [False], [False], [False]])
    skate = foot_skate_m_s(estimate, contact, RATE_HZ)
    assert skate[0, 0] == pytest.approx(0.005 * RATE_HZ)
    assert np.isnan(skate[1:]).all()


def test_standing_heights_put_the_toes_just_above_the_floor():
    height = standing_heights_m(person(1.75))
    assert height[PAPER21.bone("left_toes")] == pytest.approx(0.012 * 1.75)
    assert height[PAPER21.bone("left_foot")] == pytest.approx(0.039 * 1.75)
    assert height[PAPER21.bone("right_thigh")] == pytest.approx(0.530 * 1.75)


def test_long_axes_point_along_the_bones():
    axes = long_axes(person())
    expected = {"left_upper_arm": [1, 0, 0], "right_hand": [-1, 0, 0], "left_thigh": [0, -1, 0]}
    expected |= {"hips": [0, 1, 0], "head": [0, 1, 0], "right_toes": [0, 0, 1]}
    for bone, axis in expected.items():
        assert np.allclose(axes[PAPER21.bone(bone)], axis), bone
    assert np.allclose(np.linalg.norm(axes, axis=1), 1.0)


@pytest.mark.parametrize("twist_deg", [0.0, 1e-4, 30.0, -90.0, 179.0, 180.0])
@pytest.mark.parametrize("swing_deg", [0.0, 10.0, 120.0])
def test_twist_and_swing_of_a_worked_example(rng, twist_deg, swing_deg):
    truth = Rotation.random(rng=rng)
    twist = Rotation.from_rotvec([np.radians(twist_deg), 0, 0])
    swing = Rotation.from_rotvec([0, 0, np.radians(swing_deg)])
    estimate = (truth * swing * twist).as_matrix()[None]
    axes = np.array([[1.0, 0, 0]])
    axial = axial_error_rad(estimate, truth.as_matrix()[None], axes)
    assert np.degrees(axial)[0] == pytest.approx(abs(twist_deg), abs=1e-5)
    angle = swing_error_rad(estimate, truth.as_matrix()[None], axes)
    assert np.degrees(angle)[0] == pytest.approx(swing_deg, abs=1e-5)


@given(st.integers(0, 2**32 - 1))
def test_axial_error_agrees_with_the_quaternion_decomposition(seed):
    rng = np.random.default_rng(seed)
    estimate, truth = Rotation.random(8, rng), Rotation.random(8, rng)
    axes = rng.normal(size=(8, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    axial = axial_error_rad(estimate.as_matrix(), truth.as_matrix(), axes)
    swing = swing_error_rad(estimate.as_matrix(), truth.as_matrix(), axes)
    for bone in range(8):
        x, y, z, w = (truth[bone].inv() * estimate[bone]).as_quat()
        twist = Rotation.from_quat([*(np.dot([x, y, z], axes[bone]) * axes[bone]), w])
        rest = truth[bone].inv() * estimate[bone] * twist.inv()
        assert axial[bone] == pytest.approx(twist.magnitude(), abs=1e-6)
        assert swing[bone] == pytest.approx(rest.magnitude(), abs=1e-6)
        assert np.dot(rest.as_rotvec(), axes[bone]) == pytest.approx(0.0, abs=1e-6)


def test_an_axis_turned_round_has_no_axial_error():
    turned = Rotation.from_rotvec([0, np.pi, 0]).as_matrix()[None]
    assert np.isnan(axial_error_rad(turned, np.eye(3)[None], np.array([[1.0, 0, 0]]))).all()
    assert np.isnan(axial_error_rad(np.full((1, 3, 3), np.nan), turned, np.array([[1.0, 0, 0]])))


def test_aligned_orientation_error_forgets_a_common_turn(rng):
    joints, bones = rng.normal(size=(5, 7, 3)), Rotation.random(35, rng).as_matrix()
    turn = Rotation.random(5, rng).as_matrix()
    own = Rotation.from_rotvec(rng.normal(size=(35, 3)) * 0.2).as_matrix()
    truth = bones.reshape(5, 7, 3, 3)
    estimate = turn[:, None] @ truth @ own.reshape(5, 7, 3, 3)
    error = aligned_orientation_error_rad(
        estimate, truth, 1.3 * np.einsum("tij,tkj->tki", turn, joints) + 0.5, joints
    )
    assert np.allclose(error, Rotation.from_matrix(own).magnitude().reshape(5, 7))
    assert orientation_error_rad(estimate, truth).mean() > error.mean()


def test_procrustes_rotation_agrees_with_scipy(rng):
    truth, estimate = rng.normal(size=(2, 1, 9, 3))
    x, y = estimate[0] - estimate[0].mean(axis=0), truth[0] - truth[0].mean(axis=0)
    turn, _ = Rotation.align_vectors(y, x)
    turned = x @ turn.as_matrix().T
    expected = turned * ((turned * y).sum() / (x**2).sum()) + truth[0].mean(axis=0)
    assert np.allclose(procrustes(estimate, truth)[0], expected)


def test_people_found_in_less_than_a_fifth_of_their_frames_are_missed():
    match = np.full((3, 10), -1)
    match[0, :2], match[1, :1] = 0, 0
    present = np.ones((3, 10), dtype=bool)
    assert missed_tracks(match, present) == 2
    present[2] = False
    assert missed_tracks(match, present) == 1


def test_tracks_that_are_nobody_for_four_fifths_of_their_frames_are_false():
    match = np.array([[0] * 10, [1] + [-1] * 9])
    tracked = np.ones((3, 10), dtype=bool)
    assert false_tracks(match, tracked) == 2
    tracked[1, 3:] = False
    assert false_tracks(match, tracked) == 1


@pytest.fixture
def truth():
    return take_of(walk(person(), 120)[None], [person()], names=("anna",))


def test_score_has_the_axial_error_of_the_bone_that_is_twisted(truth):
    theta = truth.theta.copy()
    theta[0, :, 3 + 3 * PAPER21.bone("left_toes") + 2] += np.radians(12.0)
    score = score_take(take_of(theta, [person()], names=("anna",)), truth)
    assert score.bone_axial_error_deg["left_toes"] == pytest.approx(12.0)
    assert score.axial_error_deg.mean == pytest.approx(12.0 / 21)
    assert score.bone_axial_error_deg["right_toes"] == pytest.approx(0.0, abs=1e-6)


def test_score_of_a_shaking_take_has_its_jitter_and_skate(truth):
    theta = truth.theta.copy()
    theta[0, ::2, 0] += 0.002
    score = score_take(take_of(theta, [person()], names=("anna",)), truth)
    # Every difference of order n of +-1 mm is 2^n mm.
    assert score.acceleration_error_m_s2 == pytest.approx(0.004 * RATE_HZ**2)
    assert score.jitter_km_s3 == pytest.approx(0.008 * RATE_HZ**3 * 1e-3, rel=0.05)
    assert score.true_jitter_km_s3 < 0.1 * score.jitter_km_s3
    assert 0 < score.contact_share < 1
    assert score.true_foot_skate_m_s < 0.15
    assert score.foot_skate_m_s == pytest.approx(0.002 * RATE_HZ, rel=0.3)
    assert (score.missed_tracks, score.false_tracks) == (0, 0)
