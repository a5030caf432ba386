"""What is sent neither jumps nor vanishes at once."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.engine.continuity import (
    BLEND_S,
    BONE_NOISE_RAD,
    BONE_SPEED_RAD_S,
    JOINT_SPEED_M_S,
    PLACE_NOISE_M,
    Continuity,
    remaining,
)
from fusecap.types import Estimate, Status

SHAPE = BodyShape.from_height(PAPER21, 1.75)
RATE_HZ = 60.0
BOTH = (2, True)
NOTHING = (0, False)


def estimate(tick, theta=None, *, shape=SHAPE, track_id=0, sigma_deg=5.0):
    theta = np.zeros(PAPER21.pose_size) if theta is None else theta
    position, rotation = forward_kinematics(shape, theta[None])
    return Estimate(
        track_id=track_id,
        name="anna",
        timestamp_ns=round(tick * 1e9 / RATE_HZ),
        theta=theta,
        bone_position_in_world_m=position[0],
        bone_rotation_in_world=rotation[0],
        bone_sigma_deg=np.full(PAPER21.bone_count, sigma_deg),
        position_sigma_m=np.full(PAPER21.bone_count, 0.02),
        shape=shape,
        status=Status.CONVERGED,
        iterations=1,
        cost=0.0,
        solve_s=0.0,
        views=np.ones(2, dtype=bool),
        measured=True,
    )


def at(x_m=0.0, arm_rad=0.0):
    theta = np.zeros(PAPER21.pose_size)
    theta[0] = x_m
    theta[3 + 3 * PAPER21.bone("left_upper_arm") + 2] = arm_rad
    return theta


def sent(script, footing=BOTH, hold_s=10.0):
    """What goes out for a list of estimates (None: nothing measures), one per tick."""
    continuity = Continuity(hold_s)
    out = []
    for tick, item in enumerate(script):
        now_ns = round(tick * 1e9 / RATE_HZ)
        given, rests_on = item if isinstance(item, tuple) else (item, footing)
        out.append(continuity.update(given, NOTHING if given is None else rests_on, now_ns))
    return out


def joint_steps_m(out):
    position = np.array([e.bone_position_in_world_m for e in out])
    return np.linalg.norm(np.diff(position, axis=0), axis=2).max(axis=1)


def test_offset_goes_smoothly():
    s = np.linspace(0, 1, 1001)
    left = remaining(s)
    assert left[0] == 1 and left[-1] == 0 and (np.diff(left) <= 0).all()
    assert abs(np.diff(left)[[0, -1]]).max() < 1e-5
    assert np.abs(np.diff(left)).max() * 1000 == pytest.approx(1.875, rel=1e-3)


def test_fast_motion_goes_out_as_it_is():
    script = [estimate(k, at(10.0 * k / RATE_HZ, 0.5 * np.sin(k))) for k in range(60)]
    assert all(a is b for a, b in zip(sent(script), script, strict=True))


def test_new_person_appears_where_it_is():
    script = [None] * 5 + [estimate(k, at(3.0)) for k in range(5, 8)]
    out = sent(script)
    assert out[:5] == [None] * 5 and out[5] is script[5]


def test_jump_becomes_a_way():
    script = [estimate(k, at(0.0 if k < 10 else 0.5)) for k in range(60)]
    out = sent(script)
    assert out[10].theta[0] == 0.0
    assert joint_steps_m(out).max() < 1.875 * 0.5 / BLEND_S / RATE_HZ + 1e-9
    done = 10 + int(BLEND_S * RATE_HZ) + 1
    assert all(a is b for a, b in zip(out[done:], script[done:], strict=True))


def test_far_jump_takes_as_long_as_people_would():
    script = [estimate(k, at(0.0 if k < 10 else 6.0)) for k in range(200)]
    steps = joint_steps_m(sent(script))
    assert steps.max() * RATE_HZ == pytest.approx(6.0, rel=0.01)


def test_motion_shows_through_a_blend_without_delay():
    turns = [0.3 * np.sin(2 * np.pi * k / 30) for k in range(60)]
    script = [estimate(k, at(0.0 if k < 10 else 2.0, turns[k])) for k in range(60)]
    out = sent(script)
    bone = 3 + 3 * PAPER21.bone("left_upper_arm") + 2
    # Off by no more than the turn of the one instant at which it jumped.
    assert [e.theta[bone] for e in out] == pytest.approx(turns, abs=0.03)


def test_bone_that_flips_is_turned_there():
    script = [estimate(k, at(0.0, 0.0 if k < 10 else 3.0)) for k in range(60)]
    out = sent(script)
    turn = Rotation.from_matrix([e.bone_rotation_in_world[7] for e in out])
    assert (turn[:-1].inv() * turn[1:]).magnitude().max() < 40 / RATE_HZ
    assert out[-1] is script[-1]


def test_pose_that_flips_to_and_fro_stays_between():
    script = [estimate(k, at(0.0, 3.0 * (k % 2))) for k in range(120)]
    out = sent(script)
    limit_rad = BONE_SPEED_RAD_S / RATE_HZ + BONE_NOISE_RAD
    turn = Rotation.from_rotvec([e.theta[24:27] for e in out])
    assert (turn[:-1].inv() * turn[1:]).magnitude().max() <= limit_rad + 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_no_joint_is_faster_than_people_whatever_the_solver_says(seed):
    rng = np.random.default_rng(seed)
    script = []
    for k in range(200):
        theta = rng.normal(size=PAPER21.pose_size) * (1.0 if k % 7 else 0.02)
        gone = rng.random() < 0.1
        script.append(None if gone else (estimate(k, theta), ((1, False), BOTH)[k % 2]))
    out = [e for e in sent([estimate(0), *script]) if e is not None]
    steps = joint_steps_m(out)
    assert np.isfinite(steps).all()
    # Pauses in which nothing measures hold the pose, so every step is one tick.
    assert steps.max() <= JOINT_SPEED_M_S / RATE_HZ + PLACE_NOISE_M + 0.2


def test_change_of_footing_is_blended_from_the_motion_it_had():
    script = [
        (estimate(k, at(0.02 * k + (0.1 if k >= 20 else 0.0))), BOTH if k >= 20 else (1, False))
        for k in range(60)
    ]
    out = sent(script)
    x_m = np.array([e.theta[0] for e in out])
    assert x_m[20] == pytest.approx(0.4)
    assert np.diff(x_m).max() < 0.02 + 1.875 * 0.1 / BLEND_S / RATE_HZ + 1e-9
    assert x_m[-1] == script[-1][0].theta[0]


def test_a_bone_that_turns_goes_on_turning_when_the_footing_changes():
    def turned(k):
        return estimate(k, at(0.0, 0.03 * k + (0.4 if k >= 20 else 0.0)))

    script = [(turned(k), BOTH if k >= 20 else (1, False)) for k in range(60)]
    bone = 3 + 3 * PAPER21.bone("left_upper_arm") + 2
    arm_rad = np.array([e.theta[bone] for e in sent(script)])
    assert arm_rad[20] == pytest.approx(0.6, abs=1e-6)
    assert np.diff(arm_rad).min() > 0.029, "never slower than it turned"


def test_who_is_not_measured_is_held_with_error_bars_that_grow():
    out = sent([estimate(0, at(1.0)), *[None] * 200], hold_s=3.0)
    sigma_deg = [180.0 if e is None else float(e.bone_sigma_deg[0]) for e in out]
    assert (np.diff(sigma_deg) >= 0).all() and sigma_deg[1] < 6.0
    assert sigma_deg[int(2.0 * RATE_HZ) + 1] == 180.0
    assert all(e.theta[0] == 1.0 for e in out[:181]) and out[181:] == [None] * 20
    assert [e.timestamp_ns for e in out[:3]] == [0, 16666667, 33333333]
    assert not out[1].views.any()


def test_return_after_a_pause_is_blended_and_after_a_long_one_is_not():
    back = [estimate(k, at(1.0)) for k in range(60, 120)]
    out = sent([estimate(0), *[None] * 59, *back])
    assert joint_steps_m(out).max() < 1.875 * 1.0 / BLEND_S / RATE_HZ + 1e-9
    assert out[60].bone_sigma_deg[0] == 5.0 and out[-1] is back[-1]
    out = sent([estimate(0), *[None] * 59, *back], hold_s=0.5)
    assert out[59] is None and out[60] is back[0]


def test_measured_body_grows_smoothly():
    taller = BodyShape.from_height(PAPER21, 1.9)
    script = [estimate(k, shape=SHAPE if k < 10 else taller) for k in range(60)]
    out = sent(script)
    assert joint_steps_m(out).max() < 0.02
    for e in out:
        position, _ = forward_kinematics(e.shape, e.theta[None])
        assert e.bone_position_in_world_m == pytest.approx(position[0], abs=1e-12)
    assert out[-1].shape is taller


def test_estimate_that_is_not_a_number_is_not_sent():
    broken = estimate(1, np.full(PAPER21.pose_size, np.nan))
    out = sent([estimate(0), broken, estimate(2)])
    assert np.isfinite(out[1].theta).all() and np.isfinite(out[2].theta).all()
