from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.errors import InputError
from fusecap.motion.files.amc import parse_amc, parse_asf
from fusecap.motion.files.bvh import parse_bvh
from fusecap.motion.motion_folder import MotionFolder
from fusecap.motion.retarget import retarget, sole_heights_m
from motion_texts import BVH_TEXT, amc_text, asf_text

SHAPE = BodyShape.from_height(PAPER21, 1.75)

# The leg splay of the source's rest pose taken out, neck and head upright.
STANDING = {
    "lfemur": (0.0, 0.0, -20.0),
    "rfemur": (0.0, 0.0, 20.0),
    "lowerneck": (-16.0, 0.0, 0.0),
    "upperneck": (21.0, 0.0, 0.0),
    "head": (11.0, 0.0, 0.0),
}


def pose(skeleton=PAPER21, **bones):
    source = parse_asf(asf_text(), "01.asf")
    return retarget(parse_amc(amc_text([STANDING | bones]), source, "01_01.amc"), skeleton)


def joint(theta, name):
    position, _ = forward_kinematics(SHAPE, theta)
    return position[0, PAPER21.bone(name)]


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
def test_a_standing_source_is_our_rest_pose(skeleton):
    theta = pose(skeleton)
    body = theta[0, 3:].reshape(-1, 3)
    assert body.shape == (skeleton.bone_count, 3)
    neck = skeleton.bone("neck")
    others = np.delete(body, neck, axis=0)
    np.testing.assert_allclose(others, 0.0, atol=1e-7)
    # Halfway between two bones that lean by -16 and 5 degrees, each brought upright.
    np.testing.assert_allclose(body[neck], 0.0, atol=1e-7)


def test_soles_reach_the_floor():
    heights = sole_heights_m(SHAPE, pose())
    assert heights.min() == pytest.approx(0.0, abs=1e-9)
    assert heights.max() < 0.01


def test_knees_bend_backwards_and_elbows_forwards():
    bent = pose(ltibia=(60.0,), lradius=(60.0,))
    assert joint(bent, "left_foot")[2] < joint(bent, "left_shank")[2] - 0.2
    assert joint(bent, "left_hand")[2] > joint(bent, "left_forearm")[2] + 0.15


def test_left_is_left():
    theta = pose()
    assert joint(theta, "left_hand")[0] > 0.5 > -0.5 > joint(theta, "right_hand")[0]


def test_pronation_turns_the_forearm_about_its_length():
    theta = pose(lwrist=(40.0,))
    vector = theta[0, 3:].reshape(-1, 3)[PAPER21.bone("left_forearm")]
    assert np.rad2deg(np.linalg.norm(vector)) == pytest.approx(40.0)
    np.testing.assert_allclose(vector[1:], 0.0, atol=1e-6)


def test_the_spine_shares_a_bend_evenly():
    bend = (10.0, 0.0, 0.0)
    theta = pose(lowerback=bend, upperback=bend, thorax=bend)
    spine = [PAPER21.bone(name) for name in ("spine", "spine1", "spine2", "spine3")]
    angles = np.rad2deg(theta[0, 3:].reshape(-1, 3)[spine])
    np.testing.assert_allclose(angles, np.tile([7.5, 0.0, 0.0], (4, 1)), atol=1e-6)


def test_unknown_joints_are_named():
    with pytest.raises(InputError, match=r"no joint for .*lfemur.*unknown meaning: Arm, Hand"):
        retarget(parse_bvh(BVH_TEXT, "a.bvh"), PAPER21)


@pytest.fixture(scope="module")
def cmu(data_dir: Path) -> MotionFolder:
    folder = data_dir / "cmu_mocap"
    if not folder.is_dir():
        pytest.skip(f"no CMU motion at {folder}")
    return MotionFolder(folder)


@pytest.mark.real_data
@pytest.mark.slow
def test_one_take_in_two_formats_is_one_motion(cmu):
    for ours, theirs, metres in (
        ("asfamc/01/01_01", "bvh/fairmotion_01_01", 1e-4),
        ("asfamc/02/02_01", "expmap/train/walking/walking_1", 1.0),  # file has no bone lengths
        ("bvh/06_07", "expmap/test/basketball/basketball_1", 1.0),
    ):
        a, b = retarget(cmu[ours], PAPER21), retarget(cmu[theirs], PAPER21)
        frames = min(len(a), len(b))
        np.testing.assert_allclose(a[-frames:, :3], b[-frames:, :3], atol=metres)
        np.testing.assert_allclose(a[-frames:, 3:], b[-frames:, 3:], atol=0.02)


@pytest.mark.real_data
@pytest.mark.slow
@pytest.mark.parametrize("take", ["asfamc/02/02_01", "bvh/06_01", "expmap/test/walking/walking_1"])
def test_walkers_go_where_the_chest_faces_on_the_floor(cmu, take):
    motion = cmu[take]
    theta = retarget(motion, PAPER21)
    _, rotation = forward_kinematics(SHAPE, theta)
    velocity = np.diff(theta[:, [0, 2]], axis=0)
    chest = rotation[:-1, PAPER21.bone("spine3")][:, [0, 2], 2]
    cosine = np.sum(velocity * chest, axis=1) / np.linalg.norm(velocity, axis=1)
    assert np.median(cosine) > 0.95
    lowest = sole_heights_m(SHAPE, theta).min(axis=1)
    assert lowest.min() > -0.03 and np.median(lowest) < 0.06
