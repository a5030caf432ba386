from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fusecap.body.motion_model import load_demo_motion
from fusecap.body.pose import forward_kinematics
from fusecap.body.prior import PosePrior, load_prior, save_prior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.errors import InputError, MotionError
from fusecap.motion.retarget import sole_heights_m
from fusecap.motion.shipped import DEMO_CLIPS
from fusecap.motion.train_prior import ACKNOWLEDGEMENT, mirrored, train_prior
from motion_texts import amc_text, asf_text

SKELETONS = [PAPER21, EXTENDED23]


@pytest.fixture
def motion_folder(tmp_path, rng) -> Path:
    """Six takes of one subject who swings both knees and one elbow."""
    (tmp_path / "01.asf").write_text(asf_text())
    for take in range(6):
        phase = np.linspace(0, 6, 240) + rng.uniform(0, 6)
        frames = [
            {
                "root": (0.01 * i + 50 * take, 15, 0, 0, 0, 0),
                "ltibia": (30 + 30 * np.sin(p),),
                "rtibia": (30 - 30 * np.sin(p),),
                "lradius": (45 + 40 * np.sin(2 * p),),
            }
            for i, p in enumerate(phase)
        ]
        (tmp_path / f"01_{take:02d}.amc").write_text(amc_text(frames))
    return tmp_path


@pytest.mark.slow
def test_training_twice_gives_the_same_prior(motion_folder):
    first, report = train_prior(motion_folder, PAPER21, mirror=False)
    second, _ = train_prior(motion_folder, PAPER21, mirror=False)
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.basis, second.basis)
    assert report.training_takes == 5 and len(report.held_out) == 1
    assert report.explained_held_out > 0.9


@pytest.mark.slow
def test_progress_reaches_the_end(motion_folder):
    seen = []
    train_prior(motion_folder, PAPER21, progress=lambda _, done, total: seen.append((done, total)))
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert seen[-1][0] == seen[-1][1]


@pytest.mark.slow
def test_a_take_in_two_places_counts_once(motion_folder):
    copy = motion_folder / "copy"
    copy.mkdir()
    (copy / "01.asf").write_text(asf_text())
    (copy / "walk.amc").write_text((motion_folder / "01_00.amc").read_text())
    _, report = train_prior(motion_folder, PAPER21)
    assert report.duplicate_takes == ("copy/walk",)


def test_too_little_motion_to_train_on_is_an_input_error(tmp_path):
    (tmp_path / "01.asf").write_text(asf_text())
    (tmp_path / "01_01.amc").write_text(amc_text([{}, {}]))
    with pytest.raises(InputError, match="frames are left to train on"):
        train_prior(tmp_path, PAPER21)


@pytest.mark.parametrize("skeleton", SKELETONS, ids=lambda s: s.name)
def test_a_mirror_image_mirrors_the_joints(skeleton, rng):
    shape = BodyShape.from_height(skeleton, 1.75)
    poses = rng.normal(size=(4, skeleton.pose_size - 6))
    upright = np.zeros((4, 6))
    position, _ = forward_kinematics(shape, np.hstack([upright, poses]))
    image, _ = forward_kinematics(shape, np.hstack([upright, mirrored(skeleton, poses)]))
    left, right = skeleton.bone("left_hand"), skeleton.bone("right_hand")
    np.testing.assert_allclose(image[:, left], position[:, right] * [-1, 1, 1], atol=1e-12)
    np.testing.assert_allclose(mirrored(skeleton, mirrored(skeleton, poses)), poses)


@pytest.mark.parametrize("skeleton", SKELETONS, ids=lambda s: s.name)
def test_the_shipped_prior_fits_its_skeleton(skeleton):
    prior = load_prior(skeleton)
    size = skeleton.pose_size - 6
    assert prior.mean.shape == (size,)
    assert prior.recipe["acknowledgement"] == ACKNOWLEDGEMENT
    rank = len(prior.sigma)
    np.testing.assert_allclose(prior.basis.T @ prior.basis, np.eye(rank), atol=1e-12)
    np.testing.assert_allclose(prior.projector @ prior.basis, 0.0, atol=1e-12)
    x = prior.basis @ prior.sigma
    assert x @ prior.precision @ x == pytest.approx(rank)
    for matrix in (prior.projector, prior.precision):
        assert matrix.flags.c_contiguous and matrix.dtype == np.float64


def test_the_mean_pose_stands_with_arms_down():
    theta = np.concatenate([np.zeros(6), load_prior(PAPER21).mean])[None]
    position, _ = forward_kinematics(BodyShape.from_height(PAPER21, 1.75), theta)
    height = dict(zip(PAPER21.bone_names, position[0, :, 1], strict=True))
    for side in ("left", "right"):
        assert height[f"{side}_forearm"] < height[f"{side}_upper_arm"] - 0.15
        assert height[f"{side}_foot"] < height["hips"] - 0.7


def test_a_saved_prior_loads_as_it_was(tmp_path):
    prior = load_prior(PAPER21)
    save_prior(prior, tmp_path / "prior.npz")
    loaded = load_prior(PAPER21, tmp_path / "prior.npz")
    np.testing.assert_allclose(loaded.basis, prior.basis, atol=1e-7)
    assert loaded.recipe == prior.recipe


def test_a_prior_of_another_skeleton_is_refused(tmp_path):
    save_prior(load_prior(PAPER21), tmp_path / "prior.npz")
    with pytest.raises(MotionError, match="for skeleton 'paper21', not 'extended23'"):
        load_prior(EXTENDED23, tmp_path / "prior.npz")


def test_a_file_that_is_no_prior_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no pose prior at"):
        load_prior(PAPER21, tmp_path / "absent.npz")
    save_prior(load_prior(PAPER21), tmp_path / "prior.npz")
    whole = (tmp_path / "prior.npz").read_bytes()
    for content in (b"", b"text", whole[: len(whole) // 2]):
        (tmp_path / "broken.npz").write_bytes(content)
        with pytest.raises(InputError, match="not a pose prior"):
            load_prior(PAPER21, tmp_path / "broken.npz")
    np.savez(tmp_path / "other.npz", mean=np.zeros(3))
    with pytest.raises(InputError, match="not a pose prior"):
        load_prior(PAPER21, tmp_path / "other.npz")
    arrays = dict.fromkeys(("mean", "basis", "sigma", "acceleration"), 0)
    np.savez(tmp_path / "list.npz", recipe=np.array(json.dumps([])), **arrays)
    with pytest.raises(MotionError, match="for skeleton 'None'"):
        load_prior(PAPER21, tmp_path / "list.npz")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a["mean"].__setitem__(0, np.nan), "not a number"),
        (lambda a: a["sigma"].__setitem__(0, 0.0), "not positive"),
        (lambda a: a["basis"].__setitem__((0, 0), 2.0), "from orthonormal"),
        (lambda a: a["acceleration"].__setitem__(3, 0.0), "acceleration"),
    ],
)
def test_an_impossible_prior_is_refused(change, message):
    prior = load_prior(PAPER21)
    names = ("mean", "basis", "sigma", "acceleration")
    arrays = {name: getattr(prior, name).copy() for name in names}
    change(arrays)
    with pytest.raises(MotionError, match=message):
        PosePrior(skeleton_name="paper21", recipe={}, **arrays)


def test_arrays_of_another_skeleton_are_refused():
    wide = load_prior(EXTENDED23)
    with pytest.raises(MotionError, match="have shapes"):
        PosePrior(
            skeleton_name="paper21",
            mean=wide.mean,
            basis=wide.basis,
            sigma=wide.sigma,
            acceleration=wide.acceleration,
            recipe={},
        )


def test_the_demo_never_trained_the_prior():
    trained = load_prior(PAPER21).recipe["training_takes"]
    assert isinstance(trained, list)
    assert not {clip.take for clip in DEMO_CLIPS} & set(trained)


def test_the_demo_stands_on_the_floor_and_keeps_apart():
    names, _, rate_hz, theta = load_demo_motion()
    assert len(names) == 3 and rate_hz == 60.0 and theta.shape == (3, 720, 66)
    shape = BodyShape.from_height(PAPER21, 1.75)
    joints = [forward_kinematics(shape, t)[0] for t in theta]
    for t in theta:
        lowest = sole_heights_m(shape, t).min(axis=1)
        assert lowest.min() > -1e-3 and np.median(lowest) < 0.06
        assert np.all(np.linalg.norm(t[:, 3:].reshape(-1, 3), axis=1) <= np.pi + 1e-9)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        apart = np.linalg.norm(joints[i][:, :, None] - joints[j][:, None], axis=-1)
        assert apart.min() > 0.15
    passing_m = np.linalg.norm(theta[0][:, [0, 2]] - theta[1][:, [0, 2]], axis=1).min()
    assert 0.5 < passing_m < 1.0
    assert np.abs(theta[:2][..., [0, 2]]).max() < 2.0
    assert theta[2][:, 0].max() < -2.0


@pytest.mark.real_data
@pytest.mark.slow
def test_training_again_reproduces_the_shipped_prior(data_dir):
    folder = data_dir / "cmu_mocap"
    if not folder.is_dir():
        pytest.skip(f"no CMU motion at {folder}")
    prior, report = train_prior(folder, PAPER21)
    shipped = load_prior(PAPER21)
    np.testing.assert_allclose(prior.mean, shipped.mean, atol=1e-3)
    np.testing.assert_allclose(prior.projector, shipped.projector, atol=1e-3)
    np.testing.assert_allclose(prior.sigma, shipped.sigma, rtol=1e-3)
    assert report.explained_held_out > 0.92
