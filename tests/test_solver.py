"""The solver and the estimator: truth in, truth out, whatever the motion or the start."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.prior import load_prior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.errors import InputError
from fusecap.solve.estimator import Estimator, SubjectModel
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites, PoseSolver
from fusecap.types import ImuReading, Observation, Status
from scenes import IMU13, flat_prior, measure, pose_error_mm_deg, ring

LANDMARKS = LANDMARK_SETS["body25"]
SHAPE = BodyShape.from_height(PAPER21, 1.75)
WEAK_PRIOR = SolverOptions(weights=Weights(projection=1e-4, deviation=1e-5, floor=0.0).alone())


def standing(x=0.0, z=0.0, heading=0.0):
    """Arms half down, knees a little bent, facing `heading` from +z."""
    theta = np.zeros(PAPER21.pose_size)
    theta[:3] = [x, 0.94, z]
    theta[4] = heading
    for bone, axis, angle in (
        ("left_upper_arm", 2, -1.1),
        ("right_upper_arm", 2, 1.1),
        ("left_forearm", 1, -0.4),
        ("right_forearm", 1, 0.4),
        ("left_thigh", 0, -0.3),
        ("left_shank", 0, 0.5),
        ("right_shank", 0, 0.2),
    ):
        theta[3 + 3 * PAPER21.bone(bone) + axis] = angle
    return theta


def estimator(prior=None, options=WEAK_PRIOR, rig=None, sites=None, shape=SHAPE, **model):
    return Estimator(
        SubjectModel(name="anna", shape=shape, sites=sites or ImuSites.none(), **model),
        rig=ring(4) if rig is None else rig,
        landmarks=LANDMARKS,
        prior=prior or load_prior(PAPER21),
        options=options,
    )


def observe(theta, rig, time_ns, imu_bones=(), shape=SHAPE):
    data, sites = measure(theta, shape, rig, imu_bones=imu_bones)
    imu = None
    if imu_bones:
        imu = ImuReading(
            bone_rotation_in_world=data.imu_rotation, accel_in_world_m_s2=data.imu_accel
        )
    return Observation(timestamp_ns=time_ns, keypoints=data.keypoints, imu=imu), sites


def points_of(theta, shape=SHAPE):
    position, rotation = forward_kinematics(shape, theta[None])
    return landmarks_in_world(
        position, rotation, LANDMARKS.bones(PAPER21), LANDMARKS.offsets_m(shape)
    )[0]


def test_perfect_measurements_give_the_pose_back_within_two_millimetres():
    rig, truth = ring(4), standing()
    data, sites = measure(truth, SHAPE, rig, imu_bones=IMU13)
    solver = PoseSolver(
        shape=SHAPE, rig=rig, landmarks=LANDMARKS, prior=load_prior(PAPER21), sites=sites,
        options=replace(WEAK_PRIOR, function_tolerance=1e-9),
    )  # fmt: skip
    solution = solver.solve(truth + 0.05, data)
    assert solution.status is Status.CONVERGED
    seen = [b for b, name in enumerate(PAPER21.bone_names) if "hand" not in name]
    position, _ = forward_kinematics(SHAPE, np.stack([truth, solution.theta]))
    assert np.linalg.norm(position[0, seen] - position[1, seen], axis=-1).max() < 2e-3


@pytest.mark.parametrize("axis", [(0, 1, 0), (1, 0, 0), (0, 0, 1), (0.6, 0.5, -0.6)])
def test_a_full_turn_about_any_axis_tracks_through(axis):
    """A somersault is the turn about x, a cartwheel the one about z."""
    rig = ring(6, radius_m=5.0)
    est = estimator(rig=rig)
    axis = np.array(axis) / np.linalg.norm(axis)
    worst_mm = 0.0
    for frame, angle in enumerate(np.linspace(0, 2 * np.pi, 61)):
        truth = standing()
        truth[1] = 1.2
        truth[3:6] = Rotation.from_rotvec(axis * angle).as_rotvec()
        observation, _ = observe(truth, rig, frame * 16_666_667)
        result = est.update(observation, points_of(truth) if frame == 0 else None)
        assert result is not None and result.status is not Status.DIVERGED
        assert np.linalg.norm(result.theta[3:].reshape(-1, 3), axis=1).max() <= np.pi + 1e-9
        worst_mm = max(worst_mm, pose_error_mm_deg(SHAPE, truth, result.theta)[0])
    assert worst_mm < 25


@pytest.mark.slow
def test_half_a_minute_of_spinning_tracks_through():
    rig = ring(4)
    est = estimator(rig=rig)
    worst_mm = 0.0
    for frame in range(1800):
        truth = standing(heading=0.0)
        truth[3:6] = Rotation.from_euler("y", 2 * np.pi * frame / 60).as_rotvec()
        observation, _ = observe(truth, rig, frame * 16_666_667)
        result = est.update(observation, points_of(truth) if frame == 0 else None)
        worst_mm = max(worst_mm, pose_error_mm_deg(SHAPE, truth, result.theta)[0])
    assert worst_mm < 25


@pytest.mark.parametrize("heading", np.linspace(-np.pi, np.pi, 9))
def test_first_frame_finds_a_person_facing_any_way(heading):
    rig, truth = ring(4), standing(0.7, -0.4, heading)
    observation, _ = observe(truth, rig, 0)
    result = estimator(rig=rig).update(observation, points_of(truth))
    assert pose_error_mm_deg(SHAPE, truth, result.theta)[0] < 25


def test_imus_alone_give_orientations_and_leave_the_root_where_it_started():
    rig, truth = ring(0), standing(heading=2.0)
    observation, sites = observe(truth, rig, 0, IMU13)
    est = estimator(rig=rig, sites=sites, start_m=(1.5, -0.5), options=SolverOptions())
    result = est.update(observation)
    np.testing.assert_allclose(result.theta[[0, 2]], [1.5, -0.5], atol=1e-6)
    worn = list(sites.bone)
    _, expected = forward_kinematics(SHAPE, truth[None])
    relative = np.swapaxes(result.bone_rotation_in_world[worn], 1, 2) @ expected[0, worn]
    assert np.degrees(np.linalg.norm(Rotation.from_matrix(relative).as_rotvec(), axis=1)).max() < 12
    assert result.bone_sigma_deg[PAPER21.bone("left_shank")] < 15
    assert result.bone_sigma_deg[PAPER21.bone("left_hand")] > 20


def test_one_camera_finds_a_person_facing_it():
    rig, truth = ring(1), standing(heading=0.3)
    observation, _ = observe(truth, rig, 0)
    result = estimator(rig=rig, options=SolverOptions()).update(observation)
    assert result is not None
    assert np.linalg.norm(result.theta[[0, 2]]) < 0.5
    facing = Rotation.from_rotvec(result.theta[3:6]).as_matrix()[:, 2]
    assert facing @ [np.sin(0.3), 0, np.cos(0.3)] > 0.7


def test_nothing_seen_yet_gives_no_pose_and_later_holds_the_last_one():
    rig, truth = ring(4), standing()
    est = estimator(rig=rig)
    nothing = Observation(timestamp_ns=0, keypoints=np.zeros((4, 25, 3)))
    assert est.update(nothing) is None
    observation, _ = observe(truth, rig, 1)
    first = est.update(observation, points_of(truth))
    held = est.update(Observation(timestamp_ns=2, keypoints=np.zeros((4, 25, 3))))
    np.testing.assert_array_equal(held.theta, first.theta)
    assert (held.bone_sigma_deg >= first.bone_sigma_deg).all()


@pytest.mark.parametrize("garbage", [np.nan, np.inf, 1e300, -1e12])
def test_garbage_in_never_gives_a_nan_out(garbage, rng):
    rig, truth = ring(4), standing()
    est = estimator(rig=rig)
    for frame in range(20):
        observation, _ = observe(truth, rig, frame * 16_666_667)
        keypoints = observation.keypoints.copy()
        keypoints[rng.random(keypoints.shape) < 0.3] = garbage
        result = est.update(
            Observation(timestamp_ns=frame * 16_666_667, keypoints=keypoints), points_of(truth)
        )
        assert np.isfinite(result.theta).all()
        assert np.isfinite(result.bone_position_in_world_m).all()
        assert np.isfinite(result.bone_sigma_deg).all()


@pytest.mark.parametrize(("place", "value"), [(slice(None), np.nan), (1, -1e200)])
def test_a_solve_that_cannot_improve_reports_divergence_and_keeps_the_pose(place, value):
    rig, truth = ring(4), standing()
    data, _ = measure(truth, SHAPE, rig)
    solver = PoseSolver(shape=SHAPE, rig=rig, landmarks=LANDMARKS, prior=flat_prior())
    bad = standing(0.3, 0.2, 0.6)
    bad[place] = value
    solution = solver.solve(bad, data)
    assert solution.status is Status.DIVERGED
    np.testing.assert_allclose(solution.theta, bad, rtol=1e-12, atol=1e-12)


def test_far_starts_never_end_above_their_cost_and_reach_what_near_starts_reach(rng):
    rig, truth = ring(4), standing()
    data, _ = measure(truth, SHAPE, rig)
    solver = PoseSolver(
        shape=SHAPE, rig=rig, landmarks=LANDMARKS, prior=load_prior(PAPER21),
        options=replace(WEAK_PRIOR, function_tolerance=1e-9, max_iterations=200),
    )  # fmt: skip
    near = solver.solve(truth + 0.02, data).cost
    for start in truth + rng.normal(scale=0.2, size=(20, truth.size)):
        at_start, _, _ = solver.evaluate(start, data)
        far = solver.solve(start, data).cost
        assert far <= at_start
        # Bones that the keypoints leave free may keep the far start's turn, at the prior's cost.
        assert far == pytest.approx(near, abs=0.2)


def test_a_body_under_constant_acceleration_is_followed_with_the_acceleration_term():
    rig, accel, dt_s = ring(4), np.array([3.0, 0.0, -2.0]), 1 / 60
    _, sites = measure(standing(), SHAPE, rig, imu_bones=IMU13)
    options = SolverOptions(weights=replace(WEAK_PRIOR.weights, acceleration=1e-3))
    est = estimator(rig=rig, sites=sites, options=options)
    for frame in range(20):
        t = (frame - 15) * dt_s
        truth = standing()
        truth[:3] += 0.5 * accel * t * t
        seen, _ = observe(truth, rig, round(frame * dt_s * 1e9), IMU13)
        felt = replace(seen.imu, accel_in_world_m_s2=np.tile(accel, (len(IMU13), 1)))
        result = est.update(replace(seen, imu=felt), points_of(truth) if frame == 0 else None)
        assert pose_error_mm_deg(SHAPE, truth, result.theta)[0] < 10


def test_iteration_limit_is_reported():
    rig, truth = ring(4), standing()
    data, _ = measure(truth, SHAPE, rig)
    options = SolverOptions(max_iterations=1)
    solver = PoseSolver(
        shape=SHAPE, rig=rig, landmarks=LANDMARKS, prior=flat_prior(), options=options
    )
    assert solver.solve(standing(0.3, 0.3, 0.6), data).status is Status.ITERATION_LIMIT


def test_subjects_solved_on_threads_give_the_same_bits_as_one_by_one():
    rig = ring(4)
    truths = [standing(x, 0.2 * x, x) for x in (-1.0, 0.0, 1.0, 0.5)]

    def run(truth):
        est = estimator(rig=rig)
        result = None
        for frame in range(5):
            observation, _ = observe(truth, rig, frame)
            result = est.update(observation, points_of(truth))
        return result.theta

    alone = [run(truth) for truth in truths]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(run, truths))
    np.testing.assert_array_equal(alone, together)


def test_bones_of_an_unmeasured_person_are_learnt_to_within_a_centimetre(rng):
    rig = ring(4)
    tall = BodyShape.from_height(PAPER21, 1.95)
    est = estimator(rig=rig, shape=None)
    for frame in range(40):
        truth = standing(heading=0.05 * frame)
        observation, _ = observe(truth, rig, frame * 16_666_667, shape=tall)
        points = points_of(truth, tall) + rng.normal(scale=0.01, size=(25, 3))
        est.update(observation, points)
    lengths = np.linalg.norm(est.shape.offsets_m, axis=1)
    expected = np.linalg.norm(tall.offsets_m, axis=1)
    limbs = [PAPER21.bone(f"left_{name}") for name in ("forearm", "hand", "shank", "foot")]
    assert np.abs(lengths - expected)[limbs].max() < 0.01
    assert est.shape.height_m == pytest.approx(1.95, abs=0.03)


def test_a_weight_by_an_unknown_name_says_which_was_meant():
    with pytest.raises(InputError, match="did you mean 'orientation'"):
        Weights.named(orientaton=1.0)


def test_a_prior_of_another_skeleton_is_refused():
    with pytest.raises(InputError, match="needs 60"):
        PoseSolver(
            shape=SHAPE,
            rig=ring(1),
            landmarks=LANDMARKS,
            prior=flat_prior(EXTENDED23),
        )
