"""The twin is frozen: what it is made of, and that its parts leave each other alone."""

from __future__ import annotations

from fnmatch import fnmatch
from typing import Any

import numpy as np
import pytest

from fusecap.body.motion_model import load_twin_motion
from fusecap.body.pose import forward_kinematics
from fusecap.body.prior import load_prior
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.evaluate.imu_noise import IMUS_6, IMUS_13
from fusecap.evaluate.twin import (
    COMPARABLE_BONES,
    GROUPS,
    HEIGHTS_M,
    VOLUME_M,
    told_by_height,
    twin_group_simulation,
    twin_sequence,
    twin_sequences,
    twin_simulation,
    twin_training_sequences,
)
from fusecap.motion.shipped import TEST_CLIPS, TRAINING_CLIPS
from fusecap.motion.train_prior import CMU_HELD_OUT


def test_eight_sequences_of_five_subjects_of_ten_seconds():
    sequences = twin_sequences()
    assert len(sequences) == 8
    assert {sequence.subject for sequence in sequences} == set(HEIGHTS_M)
    for sequence in sequences:
        assert sequence.theta.shape == (600, 66) and sequence.rate_hz == 60.0
        assert sequence.shape.height_m == HEIGHTS_M[sequence.subject]
    assert twin_sequence("S5 FS1").take == "bvh/14_08"
    with pytest.raises(InputError, match="did you mean 'S5 FS1'"):
        twin_sequence("S5 FS11")


def test_test_takes_are_held_out_and_training_takes_are_not():
    recipe: Any = load_prior(PAPER21).recipe
    trained = set(recipe["training_takes"])
    for clip in TEST_CLIPS:
        assert any(fnmatch(clip.take, pattern) for pattern in CMU_HELD_OUT)
        assert clip.take not in trained
    for clip in TRAINING_CLIPS:
        assert clip.take in trained
    motion = load_twin_motion()
    assert motion.takes == tuple(clip.take for clip in (*TEST_CLIPS, *TRAINING_CLIPS))
    used = {sequence.take for sequence in twin_training_sequences()}
    assert used.isdisjoint(sequence.take for sequence in twin_sequences())


def test_bones_deviate_by_a_few_percent_alike_on_both_sides():
    for sequence in (*twin_sequences(), *twin_training_sequences()):
        true = np.linalg.norm(sequence.shape.offsets_m[1:], axis=1)
        told = np.linalg.norm(told_by_height(sequence.shape).offsets_m[1:], axis=1)
        deviation = true / told - 1
        assert 0.01 < deviation.std() < 0.06 and np.abs(deviation).max() <= 0.061
        for bone, name in enumerate(PAPER21.bone_names[1:]):
            if name.startswith("left_"):
                other = PAPER21.bone(name.replace("left_", "right_")) - 1
                assert deviation[bone] == pytest.approx(deviation[other])


def test_feet_stand_on_the_floor():
    for sequence in (*twin_sequences(), *twin_training_sequences()):
        position, _ = forward_kinematics(sequence.shape, sequence.theta)
        assert 0.0 < position[..., 1].min() < 0.05


def test_fewer_cameras_and_sensors_see_what_they_see_in_the_full_capture():
    sequence = twin_sequences()[1]
    full = twin_simulation(sequence)
    part = twin_simulation(sequence, cameras=3, imus=6)
    assert len(full.rig) == 8 and full.imus["S2"].bones == IMUS_13
    assert part.rig.names == full.rig.names[:3]
    assert set(part.imus["S2"].bones) == set(IMUS_6)
    for whole, fewer in zip(full.detections, part.detections, strict=True):
        for one, other in zip(whole.people[:3], fewer.people, strict=True):
            assert np.array_equal(one, other, equal_nan=True)
    kept = [IMUS_13.index(bone) for bone in part.imus["S2"].bones]
    assert np.array_equal(part.imus["S2"].accel_m_s2, full.imus["S2"].accel_m_s2[:, kept])
    assert twin_simulation(sequence, cameras=0, imus=0).imus == {}


def test_seeds_and_sequences_draw_their_own_faults():
    first, second = twin_sequences()[:2]
    offsets = [
        twin_simulation(sequence, seed=seed).landmark_offsets_m[0]
        for sequence, seed in ((first, 0), (first, 1), (second, 0))
    ]
    assert not np.allclose(offsets[0], offsets[1])
    own = offsets[2] * first.shape.height_m / second.shape.height_m
    assert not np.allclose(offsets[0], own)


@pytest.mark.parametrize(("cameras", "imus"), [(9, 13), (-1, 13), (8, 5)])
def test_what_the_twin_does_not_have_is_refused(cameras, imus):
    with pytest.raises(InputError, match="the twin"):
        twin_simulation(twin_sequences()[0], cameras=cameras, imus=imus)


@pytest.mark.parametrize("name", list(GROUPS))
def test_groups_keep_apart_and_bystanders_outside(name):
    scene = twin_group_simulation(name, cameras=2, imus=0)
    assert len(scene.subjects) == (4 if name == "quad" else 2)
    places = []
    for person in scene.people:
        x, z = person.theta[:, 0], person.theta[:, 2]
        inside = (VOLUME_M[0] < x) & (x < VOLUME_M[1]) & (VOLUME_M[2] < z) & (z < VOLUME_M[3])
        assert not inside.any() if person.bystander else inside.all()
        places.append(forward_kinematics(person.shape, person.theta)[0])
    for index, one in enumerate(places):
        for other in places[:index]:
            assert np.linalg.norm(one[:, 0] - other[:, 0], axis=-1).min() > 0.3
    if name == "close":
        apart = np.linalg.norm(places[0][:, 0] - places[1][:, 0], axis=-1)
        assert 0.4 < apart.mean() < 0.65


def test_unknown_group_is_refused():
    with pytest.raises(InputError, match="did you mean 'duo'"):
        twin_group_simulation("dua")


def test_comparable_bones_are_all_but_hands_and_toes():
    assert len(COMPARABLE_BONES) == 17
    assert not any("hand" in name or "toes" in name for name in COMPARABLE_BONES)
