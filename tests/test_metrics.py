from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.errors import TakeError
from fusecap.evaluate.metrics import (
    aligned_error_m,
    correct_limbs,
    identity_switches,
    idf1,
    match_people,
    orientation_error_rad,
    position_error_m,
    procrustes,
    root_relative_error_m,
    summarize,
)
from fusecap.evaluate.score import score_take
from motions import any_poses, person, take_of, walk


def test_summary_of_a_worked_example():
    summary = summarize(np.array([1.0, 2.0, 3.0, 4.0, 100.0, np.nan]))
    assert (summary.mean, summary.median, summary.mad, summary.count) == (22.0, 3.0, 1.0, 5)
    assert summary.std == pytest.approx(np.sqrt((21**2 + 20**2 + 19**2 + 18**2 + 78**2) / 5))
    assert summary.scaled(1000.0).mean == 22000.0


def test_summary_of_nothing_is_not_a_number():
    summary = summarize(np.array([np.nan]))
    assert np.isnan([summary.mean, summary.std, summary.median, summary.mad]).all()
    assert summary.count == 0


def test_position_error_is_the_distance():
    assert position_error_m(np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 3))) == [5.0]


def test_root_relative_error_forgets_where_the_root_is(rng):
    truth = rng.normal(size=(4, 5, 3))
    estimate = truth + [1.0, 2.0, 3.0]
    estimate[:, 2, 0] += 0.1
    assert np.allclose(root_relative_error_m(estimate, truth), [[0, 0, 0.1, 0, 0]] * 4)


def test_procrustes_undoes_any_similarity(rng):
    truth = rng.normal(size=(6, 9, 3))
    turn = Rotation.random(6, rng).as_matrix()
    estimate = 1.7 * np.einsum("tij,tkj->tki", turn, truth) + rng.normal(size=(6, 1, 3))
    assert aligned_error_m(estimate, truth).max() < 1e-12


def test_procrustes_does_not_mirror(rng):
    truth = rng.normal(size=(1, 9, 3))
    assert aligned_error_m(truth * [-1, 1, 1], truth).mean() > 0.1


def test_procrustes_is_the_best_similarity(rng):
    truth = rng.normal(size=(1, 9, 3))
    aligned = procrustes(truth + 0.1 * rng.normal(size=truth.shape), truth)
    cost = ((aligned - truth) ** 2).sum()
    for _ in range(50):
        turn = Rotation.from_rotvec(rng.normal(size=3) * 0.01).as_matrix()
        other = aligned @ turn.T * (1 + rng.normal() * 0.01) + rng.normal(size=3) * 0.01
        assert ((other - truth) ** 2).sum() > cost


def test_procrustes_leaves_frames_with_nan_alone(rng):
    truth = rng.normal(size=(2, 4, 3))
    estimate = truth.copy()
    estimate[0, 1] = np.nan
    aligned = procrustes(estimate, truth)
    assert np.isnan(aligned[0]).all() and np.allclose(aligned[1], truth[1])


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 5.0, 90.0, 179.9])
def test_orientation_error_is_the_angle(rng, angle_deg):
    truth = Rotation.random(20, rng)
    axis = rng.normal(size=(20, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    estimate = truth * Rotation.from_rotvec(axis * np.radians(angle_deg))
    error = orientation_error_rad(estimate.as_matrix(), truth.as_matrix())
    assert np.allclose(np.degrees(error), angle_deg, rtol=1e-6, atol=1e-9)


def test_pcp_of_a_worked_example():
    truth = np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0.2, 0]])
    estimate = truth + [[0.0, 0.4, 0], [0.0, 0, 0.5], [np.nan, 0, 0]]
    limbs = np.array([[0, 1], [1, 2]])
    assert correct_limbs(estimate, truth, limbs).tolist() == [True, False]
    estimate[0, 1] = 0.6
    assert correct_limbs(estimate, truth, limbs).tolist() == [False, False]


def crowd(places) -> np.ndarray:
    """People (S, T, 2, 3) whose two joints stand at x = place (S, T), NaN: absent."""
    points = np.zeros((*np.shape(places), 2, 3))
    points[..., 0] = np.array(places)[..., None]
    points[np.isnan(places)] = np.nan
    return points


NOBODY = np.nan


def test_people_are_matched_one_to_one_within_the_gate():
    truth = crowd([[0.0, 0.0, 0.0], [1.0, 0.3, NOBODY]])
    estimate = crowd([[0.9, 0.2, 0.1], [0.1, 0.4, 3.0]])
    assert match_people(estimate, truth).tolist() == [[1, 0, 0], [0, 1, -1]]


def test_nobody_to_match_is_no_match():
    assert match_people(crowd(np.zeros((0, 2))), crowd([[0.0, 1.0]])).tolist() == [[-1, -1]]


def test_identity_switches_count_changes_and_not_gaps():
    match = np.array([[0, 0, -1, 0, 1, 1, -1, 0], [1, -1, -1, -1, -1, 1, 1, 1]])
    assert identity_switches(match) == 2


def test_idf1_of_two_who_swap_half_way():
    truth = crowd([[0.0] * 10, [5.0] * 10])
    swapped = crowd([[0.0] * 6 + [5.0] * 4, [5.0] * 6 + [0.0] * 4])
    assert idf1(truth, truth) == 1.0
    assert idf1(swapped, truth) == pytest.approx(2 * 12 / 40)
    assert idf1(truth[:1], truth) == pytest.approx(2 * 10 / 30)


@pytest.fixture
def truth():
    theta = np.stack([walk(person(), 30), walk(person(), 30, phase_rad=1.0)])
    theta[1, :, 0] += 2.0
    return take_of(theta, [person(), person()], names=("anna", "ben"))


def test_perfect_take_scores_zero(truth):
    score = score_take(truth, truth)
    assert score.position_error_mm.mean == 0.0
    assert score.orientation_error_deg.mean == 0.0
    assert (score.found_share, score.extra_share, score.idf1) == (1.0, 0.0, 1.0)
    assert (score.identity_switches, score.subjects) == (0, 2)


def test_score_of_a_take_that_is_off_by_known_amounts(truth):
    theta = truth.theta[::-1].copy()
    theta[:, :, 0] += 0.03
    theta[:, :, 3 + 3 * PAPER21.bone("head") + 1] += np.radians(10.0)
    score = score_take(take_of(theta, [person(), person()], names=("x", "y")), truth)
    assert score.position_error_mm.mean == pytest.approx(30.0)
    assert score.root_relative_error_mm.mean == pytest.approx(0.0, abs=1e-9)
    assert score.bone_orientation_error_deg["head"] == pytest.approx(10.0)
    assert score.orientation_error_deg.mean == pytest.approx(10.0 / 21)


def test_missed_and_extra_people_are_counted(truth):
    theta = np.stack([truth.theta[0], truth.theta[0]])
    theta[1, :, 2] += 50.0
    score = score_take(take_of(theta, [person(), person()], names=("anna", "ghost")), truth)
    assert (score.found_share, score.extra_share) == (0.5, 0.5)


def test_take_without_anyone_finds_nothing(truth):
    nobody = replace(
        truth,
        subject_names=(),
        **{
            name: getattr(truth, name)[:0]
            for name in (
                "heights_m",
                "offsets_m",
                "theta",
                "bone_position_in_world_m",
                "bone_rotation_in_world_wxyz",
                "tracked",
                "measured",
                "bone_sigma_deg",
                "position_sigma_m",
            )
        },
    )
    score = score_take(nobody, truth)
    assert (score.found_share, score.subjects, score.position_error_mm.count) == (0.0, 0, 0)


def test_frames_are_paired_by_time(truth):
    part = take_of(truth.theta[:, 10:20], [person(), person()], names=("a", "b"))
    part = replace(part, timestamps_ns=truth.timestamps_ns[10:20] + 100)
    score = score_take(part, truth)
    assert score.position_error_mm.mean == 0.0
    assert score.found_share == 1.0


def test_takes_that_do_not_fit_are_refused(truth, rng):
    other = take_of(any_poses(rng, EXTENDED23, 30)[None], [person(1.7, EXTENDED23)], names=("a",))
    with pytest.raises(TakeError, match="different skeletons"):
        score_take(other, truth)
    late = replace(truth, timestamps_ns=truth.timestamps_ns + 10**12)
    with pytest.raises(TakeError, match="no timestamp"):
        score_take(late, truth)
