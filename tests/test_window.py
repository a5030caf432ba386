"""Instants solved together: terms against their twins, the band, and motions that people make."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import window_twin
from derivatives import assert_jacobian
from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.body.pose import forward_kinematics
from fusecap.body.prior import load_prior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.kernels import band
from fusecap.solve import whole_motion
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites, PoseSolver
from fusecap.solve.whole_motion import AHEAD, PIECE, WholeMotion
from fusecap.solve.window_solver import WindowSolver, Workspace
from fusecap.types import GRAVITY_M_S2, ImuReading, Observation
from scenes import IMU13, measure, pose_error_mm_deg, ring

LANDMARKS = LANDMARK_SETS["body25"]
SHAPE = BodyShape.from_height(PAPER21, 1.75)
RATE_HZ = 60.0
SITES = ImuSites(
    bone=tuple(PAPER21.bone(name) for name in IMU13), position_m=np.full((len(IMU13), 3), 0.03)
)
BETWEEN = {
    name: getattr(Weights(), name) for name in ("motion", "increment", "specific_force", "rest")
}
CONTACT = np.array([1.0, 0.5, 0.0, 0.25, 2.0])
"""Of the resting joints, wherever contacts are not found but given."""
NOTHING = dict.fromkeys(
    ("position", "orientation", "projection", "deviation", "floor") + tuple(BETWEEN),
    0.0,
)


def solver(cameras=3, sites=SITES, **weights):
    return PoseSolver(
        shape=SHAPE,
        rig=ring(cameras),
        landmarks=LANDMARKS,
        prior=load_prior(PAPER21),
        sites=sites,
        options=SolverOptions(weights=Weights(**weights)),
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


def filled(pose_solver, theta, seen, size=None):
    """A window of these instants."""
    window = WindowSolver(pose_solver, size or max(len(seen), 3))
    for one, pose in zip(seen, theta, strict=True):
        window.push(one, pose)
    return window


def dense_of(hessian):
    n, p = hessian.shape[0], hessian.shape[2]
    dense = np.zeros((n * p, n * p))
    for t in range(n):
        for k in range(min(t, 2) + 1):
            block = hessian[t, k] if k else np.tril(hessian[t, k])
            rows, columns = slice(t * p, t * p + p), slice((t - k) * p, (t - k) * p + p)
            dense[rows, columns] = block
    return np.tril(dense) + np.tril(dense, -1).T


def evaluated(pose_solver, theta, seen):
    """(cost, dense H, g, H in blocks) of a window."""
    window = filled(pose_solver, theta, seen)
    n = len(theta)
    window._measured.contact[:] = CONTACT
    cost = window._evaluate(np.ascontiguousarray(theta))
    hessian, gradient = window._workspace.hessian[:n].copy(), window._workspace.gradient[:n].copy()
    return cost, dense_of(hessian), gradient, hessian


def moved_together(pose_solver, theta, seen):
    """The motion of a whole take."""
    motion, poses = WholeMotion(pose_solver), []
    for one, pose in zip(seen, theta, strict=True):
        if not motion.goes_on(one.timestamp_ns):
            poses += motion.end()
        poses += motion.push(one, pose)
    return np.array([one.theta for one in [*poses, *motion.end()]]).reshape(theta.shape)


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
    if term == "rest":
        bones, contact = pose_solver.model.floor.resting.tolist(), np.tile(CONTACT, (len(theta), 1))
        return window_twin.rest(SHAPE, bones, weight, contact, theta, times_s)
    usual = load_prior(PAPER21).acceleration
    return window_twin.motion(weight / usual**2, theta, times_s)


@pytest.mark.parametrize("term", BETWEEN)
@pytest.mark.parametrize("turn_hz", [0.0, 25.0], ids=["calm", "turns of 150 deg between instants"])
def test_a_term_between_instants_agrees_with_its_twin_and_its_gradient_with_differences(
    term, turn_hz, rng
):
    theta = disturbed(rng, turn_hz=turn_hz)
    seen = observations(walk(5, turn_hz=turn_hz))
    seen[3] = Observation(
        timestamp_ns=seen[3].timestamp_ns + 4_000_000, keypoints=seen[3].keypoints, imu=seen[3].imu
    )
    pose_solver = solver(**NOTHING | {term: BETWEEN[term]})
    cost, _, gradient, _ = evaluated(pose_solver, theta, seen)
    assert cost == pytest.approx(twin_cost(term, BETWEEN[term], pose_solver, theta, seen), rel=1e-9)
    some = rng.choice(theta.size, 40, replace=False)

    def moved(delta):
        there = theta.copy()
        there.ravel()[some] += delta
        return evaluated(pose_solver, there, seen)[0]

    scale = np.abs(gradient).max()
    assert_jacobian(moved, gradient.ravel()[some], rtol=1e-4, atol=1e-5 * scale)


@pytest.mark.parametrize("term", BETWEEN)
def test_a_step_on_one_term_alone_brings_its_residual_down_as_gauss_newton_promises(term, rng):
    still = {"swing": 0.0, "speed_m_s": 0.0}
    theta, seen = disturbed(rng, scale=2e-4, **still), observations(walk(5, **still))
    pose_solver = solver(**NOTHING | {term: BETWEEN[term]})
    cost, dense, gradient, _ = evaluated(pose_solver, theta, seen)
    assert np.linalg.eigvalsh(dense).min() > -1e-9 * np.abs(dense).max()
    ridge = 1e-9 * np.abs(dense).max() * np.eye(len(dense))
    step = np.linalg.solve(dense + ridge, -gradient.ravel()).reshape(theta.shape)
    after = evaluated(pose_solver, theta + step, seen)[0]
    assert after < 0.05 * cost


def random_band(rng, count=6, size=6):
    """A positive system of blocks that couple three instants, dense and in blocks."""
    dense = np.zeros((count * size, count * size))
    for t in range(count):
        some = slice(max(t - 2, 0) * size, (t + 1) * size)
        rows = rng.normal(size=(4 * size, some.stop - some.start))
        dense[some, some] += rows.T @ rows
    blocks = np.zeros((count, 3, size, size))
    for t in range(count):
        for k in range(min(t, 2) + 1):
            rows, columns = slice(t * size, (t + 1) * size), slice((t - k) * size, None)
            blocks[t, k] = dense[rows, columns][:, :size]
    return dense, blocks, rng.normal(size=(count, size))


def test_a_band_solve_is_a_dense_solve(rng):
    dense, blocks, gradient = random_band(rng)
    step, square = np.zeros_like(gradient), np.zeros((3, 3))
    expected = np.linalg.solve(dense + 0.1 * np.diag(np.diag(dense)), -gradient.ravel())
    assert band.eliminate(blocks, gradient, len(blocks), 0.1, 0.0, square)
    band.step_of(blocks, gradient, step)
    np.testing.assert_allclose(step.ravel(), expected, rtol=1e-9, atol=1e-12)


def test_folding_is_exact_on_a_linear_problem(rng):
    dense, blocks, gradient = random_band(rng)
    expected = np.linalg.solve(dense, -gradient.ravel()).reshape(gradient.shape)
    assert band.eliminate(blocks, gradient, 3, 0.0, 0.0, np.zeros((3, 3)))
    step = np.linalg.solve(dense_of(blocks[3:]), -gradient[3:].ravel())
    np.testing.assert_allclose(step, expected[3:].ravel(), rtol=1e-9, atol=1e-12)


def test_a_system_that_is_not_positive_is_refused(rng):
    _, blocks, gradient = random_band(rng)
    blocks[2, 0, 1, 1] = -1.0
    assert not band.eliminate(blocks, gradient, len(blocks), 0.0, 0.0, np.zeros((3, 3)))
    blocks[2, 0, 1, 1] = np.nan
    assert not band.eliminate(blocks, gradient, len(blocks), 0.0, 0.0, np.zeros((3, 3)))


def test_instants_that_left_still_count(rng):
    """Near the minimum the cost is nearly quadratic: folding loses next to nothing."""
    truth, pose_solver = walk(14), solver()
    seen = observations(truth, noise_px=0.5, rng=rng)
    whole = filled(pose_solver, truth, seen)
    whole.refine(10, 1e-9)
    short = filled(pose_solver, truth[:6], seen[:6])
    for one, pose in zip(seen[6:], truth[6:], strict=True):
        short.refine(10, 1e-9)
        if short.count == 6:
            short.fold(1)
        short.push(one, pose)
    short.refine(10, 1e-9)
    mm, deg = pose_error_mm_deg(SHAPE, short.pose(), whole.pose())
    assert mm < 0.3
    assert deg < 0.1
    forgetful = filled(pose_solver, truth[-6:], seen[-6:])
    forgetful.refine(10, 1e-9)
    assert pose_error_mm_deg(SHAPE, forgetful.pose(), whole.pose())[0] > 2 * mm


def test_a_window_over_all_instants_is_the_whole_motion(rng):
    truth, pose_solver = walk(40), solver()
    seen = observations(truth, noise_px=4.0, rng=rng)
    window = filled(pose_solver, truth, seen)
    window.refine(whole_motion._MAX_STEPS, whole_motion._TOLERANCE)
    all_at_once = np.array([window.pose(39 - t) for t in range(40)])
    np.testing.assert_array_equal(moved_together(pose_solver, truth, seen), all_at_once)


def test_noise_goes_and_the_motion_stays(rng):
    truth = walk(90)
    pose_solver = solver()
    seen = observations(truth, noise_px=6.0, rng=rng)
    alone = truth + rng.normal(scale=0.01, size=truth.shape)
    together = moved_together(pose_solver, alone, seen)
    before = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(alone, truth, strict=True)]
    after = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(together, truth, strict=True)]
    assert np.mean(after) < 0.7 * np.mean(before)
    jerk = [np.linalg.norm(np.diff(m[:, :3], 3, axis=0), axis=1).mean() for m in (alone, together)]
    assert jerk[1] < 0.02 * jerk[0]


def test_pieces_give_the_motion_of_the_whole(rng, monkeypatch):
    truth, pose_solver = walk(150), solver()
    seen = observations(truth, noise_px=4.0, rng=rng)
    alone = truth + rng.normal(scale=0.01, size=truth.shape)
    monkeypatch.setattr(whole_motion, "PIECE", 200)
    whole = moved_together(pose_solver, alone, seen)
    monkeypatch.setattr(whole_motion, "PIECE", 40)
    pieces = moved_together(pose_solver, alone, seen)
    apart = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(whole, pieces, strict=True)]
    assert max(apart) < 1.0


def test_a_spinning_person_goes_on_spinning(rng):
    truth = walk(120, turn_hz=2.0)
    seen = observations(truth, noise_px=2.0, rng=rng)
    together = moved_together(solver(), truth, seen)
    errors = [pose_error_mm_deg(SHAPE, a, b) for a, b in zip(together, truth, strict=True)]
    assert np.linalg.norm(together[:, 3:6], axis=1).max() <= np.pi + 1e-9
    assert max(mm for mm, _ in errors) < 40.0
    assert max(deg for _, deg in errors) < 30.0


def test_a_landing_from_a_height_is_not_smoothed_away(rng):
    truth = walk(90, swing=0.0, speed_m_s=0.0)
    t = np.arange(90) / RATE_HZ
    truth[:, 1] = np.maximum(0.94, 0.94 + 1.0 - 0.5 * GRAVITY_M_S2 * t**2)
    seen = observations(truth, noise_px=2.0, rng=rng)
    together = moved_together(solver(), truth, seen)
    assert np.abs(together[:, 1] - truth[:, 1]).max() < 0.02


def test_a_somersault_is_followed(rng):
    truth = walk(60, swing=0.0, speed_m_s=0.0)
    t = np.arange(60) / RATE_HZ
    air = np.clip((t - 0.2) / 0.6, 0.0, 1.0)
    truth[:, 1] = 0.94 + 4.0 * 0.45 * air * (1.0 - air)
    turned = Rotation.from_rotvec(np.outer(2 * np.pi * air, [1.0, 0.0, 0.0]))
    truth[:, 3:6] = turned.as_rotvec()
    together = moved_together(solver(), truth, observations(truth, noise_px=2.0, rng=rng))
    errors = [pose_error_mm_deg(SHAPE, a, b) for a, b in zip(together, truth, strict=True)]
    assert max(mm for mm, _ in errors) < 60.0
    assert max(deg for _, deg in errors) < 30.0


@pytest.mark.parametrize("fault", ["frozen", "slipped"])
def test_one_sensor_that_lies_does_not_carry_the_motion_away(fault, rng):
    truth = walk(90)
    seen = observations(truth, noise_px=2.0, rng=rng)
    worn = IMU13.index("left_shank")
    for one in seen[30:]:
        if fault == "frozen":
            one.imu.bone_rotation_in_world[worn] = seen[30].imu.bone_rotation_in_world[worn]
            one.imu.accel_in_world_m_s2[worn] = seen[30].imu.accel_in_world_m_s2[worn]
        else:
            slip = Rotation.from_rotvec([0.0, 0.6, 0.3]).as_matrix()
            one.imu.bone_rotation_in_world[worn] = one.imu.bone_rotation_in_world[worn] @ slip
    together = moved_together(solver(), truth, seen)
    errors = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(together, truth, strict=True)]
    assert max(errors[:25]) < 40.0
    assert np.mean(errors) < 40.0
    assert np.isfinite(together).all()


def test_half_a_minute_of_spinning_live():
    truth = walk(1800, turn_hz=1.5)
    pose_solver, seen = solver(2), observations(truth, cameras=2)
    window = WindowSolver(pose_solver, 10)
    worst_deg = 0.0
    for one, pose in zip(seen, truth, strict=True):
        window.push(one, pose)
        window.refine(3)
        worst_deg = max(worst_deg, pose_error_mm_deg(SHAPE, window.pose(), pose)[1])
    assert worst_deg < 45.0


def test_a_shock_of_sixteen_g_in_one_sensor_leaves_the_motion(rng):
    truth = walk(60)
    seen = observations(truth, noise_px=2.0, rng=rng)
    calm = moved_together(solver(), truth, seen)
    for t in (30, 31):
        seen[t].imu.accel_in_world_m_s2[5] = [0.0, 16 * GRAVITY_M_S2, 0.0]
    shocked = moved_together(solver(), truth, seen)
    apart = [pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(calm, shocked, strict=True)]
    assert max(apart) < 10.0


def marched(count):
    """Knees lifted in turn, each foot standing still for half of the time."""
    t = np.arange(count) / RATE_HZ
    theta = walk(count, swing=0.0, speed_m_s=0.0)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        lift = np.maximum(0.0, sign * np.sin(2 * np.pi * t)) ** 2
        theta[:, 3 + 3 * PAPER21.bone(f"{side}_thigh")] = -0.8 * lift
        theta[:, 3 + 3 * PAPER21.bone(f"{side}_shank")] = 1.6 * lift
    theta[:, 1] = 0.94
    return theta


@pytest.mark.parametrize("worn", [True, False], ids=["by its sensor", "by its pose"])
def test_a_foot_that_stands_is_told_from_one_that_is_lifted(worn):
    truth = marched(60)
    seen = observations(truth, sites=SITES if worn else ImuSites.none())
    window = filled(solver(sites=SITES if worn else ImuSites.none()), truth, seen)
    window.stand(0, near=4)
    left = window._measured.contact[:60, 0]
    assert left[35:58].all()
    assert not left[8:24].any()


def test_sensors_alone_drift_less_where_feet_stand():
    truth = marched(180)
    start = truth.copy()
    start[:, 0] += np.linspace(0.0, 0.2, 180)
    drift = []
    for rest in (0.0, BETWEEN["rest"]):
        poses = moved_together(solver(0, rest=rest), start, observations(truth, cameras=0))
        drift.append(abs(poses[-1, 0] - poses[0, 0]))
    assert drift[1] < 0.5 * drift[0]


def test_nobody_jumps_where_two_pieces_meet(rng):
    truth = marched(300)
    start = truth + 0.01 * rng.normal(size=truth.shape)
    start[:, :3] += np.linspace(0.0, 0.5, 300)[:, None] ** 2
    poses = moved_together(solver(0), start, observations(truth, cameras=0))
    third_m = np.linalg.norm(np.diff(poses[:, :3], 3, axis=0), axis=1)
    assert third_m.max() < 1e-3


def test_poses_ahead_that_went_astray_do_not_keep_each_other_there(rng):
    truth = walk(14)
    seen = observations(truth, sites=ImuSites.none())
    window = WindowSolver(solver(sites=ImuSites.none()), 8, ahead=6)
    for one, pose in zip(seen[:8], truth, strict=False):
        window.push(one, pose)
    coming = [replace(one, keypoints=0.0 * one.keypoints) for one in seen[8:]]
    held = window.pose()
    astray = held + rng.normal(scale=1.5, size=held.shape)
    away_mm = pose_error_mm_deg(SHAPE, held, truth[-1])[0]
    for start in (held, astray):
        found = window.ahead([(one, start) for one in coming], 3)
        assert pose_error_mm_deg(SHAPE, found.theta[-1], truth[-1])[0] < 0.6 * away_mm
    np.testing.assert_array_equal(window.pose(), held)


@pytest.mark.parametrize(
    ("cameras", "sites", "alone"),
    [(1, ImuSites.none(), True), (2, ImuSites.none(), False), (1, SITES, False)],
)
def test_places_by_one_view_alone_are_less_certain(cameras, sites, alone):
    truth = walk(3)
    window = filled(solver(cameras, sites), truth, observations(truth, cameras, sites))
    assert window.by_one_view() == window.by_one_view(2) == alone


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
    both = moved_together(pose_solver, truth, late)
    np.testing.assert_array_equal(both[:20], moved_together(pose_solver, truth[:20], seen[:20]))
    np.testing.assert_array_equal(both[20:], moved_together(pose_solver, truth[20:], late[20:]))


def test_a_clock_that_stands_or_runs_back_begins_another_motion():
    truth = walk(6)
    seen = observations(truth)
    window = filled(solver(), truth, seen)
    for jump_ns in (0, -(10**9), 10**10):
        window.push(replace(seen[0], timestamp_ns=seen[-1].timestamp_ns + jump_ns), truth[0])
        assert window.count == 1
        window.refine(3)
        assert np.isfinite(window.pose()).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_poses_stay_as_they_are(count):
    truth = walk(5)[:count]
    seen = observations(walk(5))[:count]
    np.testing.assert_array_equal(moved_together(solver(), truth, seen), truth)


def test_sensors_that_are_silent_or_absent_are_no_reason_to_fail(rng):
    truth = walk(20)
    seen = observations(truth, noise_px=2.0, rng=rng)
    for t in range(5, 12):
        seen[t].imu.bone_rotation_in_world[3] = np.nan
        seen[t].imu.accel_in_world_m_s2[:] = np.nan
    seen[15] = Observation(timestamp_ns=seen[15].timestamp_ns, keypoints=seen[15].keypoints)
    together = moved_together(solver(), truth, seen)
    assert np.isfinite(together).all()
    assert max(pose_error_mm_deg(SHAPE, a, b)[0] for a, b in zip(together, truth, strict=True)) < 40


def test_nothing_measured_is_a_motion_too():
    truth = walk(10)
    seen = observations(truth, cameras=1, sites=ImuSites.none())
    blind = [
        Observation(timestamp_ns=one.timestamp_ns, keypoints=np.full_like(one.keypoints, np.nan))
        for one in seen
    ]
    assert np.isfinite(moved_together(solver(1, ImuSites.none()), truth, blind)).all()


def test_what_cannot_be_solved_leaves_the_poses():
    truth = walk(6)
    seen = observations(truth)
    window = filled(solver(), truth, seen)
    window._measured.steps[2] = np.nan
    window.refine(5)
    poses = [window.pose(5 - t) for t in range(6)]
    np.testing.assert_array_equal(poses, truth)
    window.fold(2)
    window._measured.steps[:] = 1 / RATE_HZ
    window.refine(5)
    assert np.isfinite(window.pose()).all()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_error_bars_of_a_short_motion_are_its_own_whoever_was_solved_before(count):
    """Motions share a workspace."""
    mine, shared = solver(cameras=1), Workspace(PAPER21, PIECE + AHEAD)
    bars = []
    for busy in (False, True):
        if busy:
            before = WholeMotion(solver(), shared)
            for one, pose in zip(observations(walk(40)), walk(40), strict=True):
                before.push(one, pose)
            before.end()
        motion = WholeMotion(mine, shared)
        for one, pose in zip(observations(walk(count), cameras=1), walk(count), strict=True):
            motion.push(one, pose)
        bars.append([settled.sigmas.bone_deg for settled in motion.end()])
    assert_allclose(bars[0], bars[1], rtol=1e-9)
