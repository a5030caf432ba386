"""Covariances against the dense inverse, error bars against finite differences and true errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_solve import live_takes, solve_simulation
from fusecap.kernels import band, uncertainty
from fusecap.solve.pose_solver import UNKNOWN_RIDGE
from fusecap.solve.uncertainty import Sigmas, grown, sigmas, turn_shares
from test_window import SHAPE, dense_of, filled, observations, solver, walk


@pytest.fixture(name="window")
def _window(rng):
    truth = walk(6)
    window = filled(solver(), truth, observations(truth, noise_px=2.0, rng=rng))
    window.refine(5)
    return window


def test_covariances_are_blocks_of_the_dense_inverse(window):
    window._evaluate(window._theta[:6])
    hessian, p = window._workspace.hessian[:6], window.pose_size
    dense = np.linalg.inv(dense_of(hessian) + UNKNOWN_RIDGE * np.eye(6 * p))
    square = np.zeros((3, 3))
    assert band.eliminate(hessian, np.zeros((6, p)), 6, 0.0, UNKNOWN_RIDGE, square)
    room, found = np.zeros((uncertainty.ROOM, p, p)), np.zeros((p, p))
    for t in range(5, -1, -1):
        uncertainty.step_back(hessian, t, room, found, square)
        expected = dense[t * p : (t + 1) * p, t * p : (t + 1) * p]
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * expected.max())


def test_traces_follow_from_how_bones_move(window):
    turn, place = window.newest_spread()
    covariance, pose = window._covariance.copy(), window._theta[5].copy()
    position, rotation = window._solver.posed(pose)
    moved, turned = [], []
    for index in range(len(pose)):
        step = pose.copy()
        step[index] += 1e-6
        there, facing = window._solver.posed(step)
        moved.append((there - position) / 1e-6)
        relative = facing @ np.swapaxes(rotation, 1, 2)
        turned.append(Rotation.from_matrix(relative).as_rotvec() / 1e-6)
    for found, jacobian in ((place, np.array(moved)), (turn, np.array(turned))):
        expected = np.einsum("pbi,pq,qbi->b", jacobian, covariance, jacobian)
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    oldest, newest = window.spreads(6)[0][[0, 5]]
    assert (newest > 0.99 * turn).all(), "damping only takes doubt away"
    assert oldest.mean() < newest.mean(), "what came later does too"
    assert SHAPE.skeleton is PAPER21


def test_error_bars_grow_while_nothing_measures_and_never_beyond_reason():
    known = Sigmas(np.full(21, 5.0), np.full(21, 0.02))
    later = [grown(known, silent_s) for silent_s in (0.0, 0.5, 100.0)]
    assert later[0].bone_deg[0] == 5.0 and later[0].position_m[0] == 0.02
    assert later[0].bone_deg[0] < later[1].bone_deg[0] < later[2].bone_deg[0] == 180.0
    assert later[2].position_m[0] == 10.0
    worst = sigmas(
        np.array([np.nan, 1e9, -1e-12]), np.array([np.nan, 1e9, 0.0]), np.ones(3), one_view=False
    )
    assert worst.bone_deg[:2].tolist() == [180.0, 180.0] and worst.bone_deg[2] == pytest.approx(2.5)
    assert worst.position_m[:2].tolist() == [10.0, 10.0]


def test_every_skeleton_has_a_share_per_bone():
    for skeleton in (PAPER21, EXTENDED23):
        assert turn_shares(skeleton).shape == (skeleton.bone_count,)


def test_errors_are_as_large_as_the_error_bars_say():
    """Of the demo, which had no part in fitting them: squared errors over variances."""
    simulation = demo_scene(seconds=4.0)
    truth = simulation.truth
    for take in (live_takes(simulation, lag_s=0.1)[0], solve_simulation(simulation).take):
        for row, name in enumerate(take.subject_names):
            true = truth.subject(name)
            seen = take.tracked[row]
            true_rotation = truth.bone_rotation_in_world(true)[seen]
            relative = np.swapaxes(take.bone_rotation_in_world(row)[seen], 2, 3) @ true_rotation
            turn = Rotation.from_matrix(relative.reshape(-1, 3, 3)).magnitude()
            turn_deg2 = np.degrees(turn).reshape(relative.shape[:2]) ** 2
            apart = take.bone_position_in_world_m[row] - truth.bone_position_in_world_m[true]
            place_m2 = np.square(apart[seen]).sum(axis=2)
            ratios = (
                turn_deg2.mean() / np.square(take.bone_sigma_deg[row, seen]).mean(),
                place_m2.mean() / np.square(take.position_sigma_m[row, seen]).mean(),
            )
            assert all(0.3 < ratio < 3.0 for ratio in ratios), ratios
