"""What cannot be measured is refused or counts as missing; never a library's error, or for ever."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace

import garbage
import numpy as np
import pytest

import fusecap
from fusecap.associate.options import TrackerOptions
from fusecap.believable import (
    MOST_DETECTIONS,
    MOST_PEOPLE,
    believable_detections,
    believable_reading,
    surest,
    surest_of_views,
)
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.prior import load_prior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.engine.cameras import Cameras
from fusecap.errors import FusecapError, InputError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.geometry.camera import Camera
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions, Weights
from fusecap.solve.pose_solver import ImuSites
from fusecap.sources.keypoint_files import read_people
from fusecap.types import CameraSample, Detections, ImuReading


@pytest.fixture(scope="module")
def scene():
    return demo_scene(seconds=1.0)


@pytest.mark.slow
def test_garbage_is_refused_or_solved_in_time_and_forgotten():
    """In a process of its own, where arrays of other shapes are not caught by the tests' checks."""
    command = [sys.executable, garbage.__file__, "--steps", "300", "--seed", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_time_that_is_not_after_the_last_one_is_refused_and_changes_nothing(scene):
    one, other = garbage.OfEstimator(scene), garbage.OfEstimator(scene)
    for instant in range(4):
        for each in (one, other):
            each.step(instant, 1 + instant * 16_666_667, None)
        for past in (0, 1 + instant * 16_666_667):
            with pytest.raises(InputError, match="is not after the last one"):
                one.step(instant, past, None)
    now_ns = 1 + 4 * 16_666_667
    assert one.step(4, now_ns, None) and other.step(4, now_ns, None)
    expected = other.estimator.predict(now_ns)
    np.testing.assert_array_equal(one.estimator.predict(now_ns), expected)


@pytest.mark.parametrize("entry", [1e160, 1e30, np.inf, np.nan, -1.0])
def test_a_turn_that_is_none_is_no_measurement(entry):
    rotation = np.stack([np.eye(3), np.eye(3)])
    rotation[1, 0, 0] = entry
    accel = np.array([[0.0, 9.8, 0.0], [0.0, 1e9, 0.0]])
    kept = believable_reading(
        ImuReading(bone_rotation_in_world=rotation, accel_in_world_m_s2=accel), 2
    )
    assert np.isfinite(kept.bone_rotation_in_world[0]).all()
    assert np.isnan(kept.bone_rotation_in_world[1]).all()
    assert np.isfinite(kept.accel_in_world_m_s2[0]).all()
    assert np.isnan(kept.accel_in_world_m_s2[1]).all()


@pytest.mark.parametrize("entry", [np.nan, 1e160])
def test_a_first_pose_of_garbage_is_none_and_the_next_instant_finds_one(scene, entry):
    front = garbage.OfEstimator(scene)
    sensors = len(front.estimator.model.sites.bone)
    keypoints = np.full((len(scene.rig), 25, 3), entry)
    observation = fusecap.Observation(
        timestamp_ns=0,
        keypoints=keypoints,
        imu=ImuReading(
            bone_rotation_in_world=np.full((sensors, 3, 3), entry),
            accel_in_world_m_s2=np.full((sensors, 3), entry),
        ),
    )
    started = time.perf_counter()
    assert front.estimator.update(observation, np.full((25, 3), entry)) is None
    assert time.perf_counter() - started < 1.0
    assert front.step(1, 16_666_667, None)


def test_crowds_are_refused_by_the_sorter_and_thinned_by_the_reader(scene, tmp_path):
    front = garbage.OfPipeline(scene)
    crowd = np.repeat(scene.detections[0].people[0][:1], 2000, axis=0)
    people = (crowd, *scene.detections[0].people[1:])
    with pytest.raises(InputError, match=f"2000; keep the {MOST_PEOPLE} surest"):
        front.pipeline.step(Detections(timestamp_ns=1, people=people), {})
    crowd[1000:1010, :, 2] = 1.0
    crowd[:1000, :, 2] = crowd[1010:, :, 2] = 0.5
    kept = surest(crowd)
    assert len(kept) == MOST_PEOPLE and (kept[:, 0, 2] == 1.0).sum() == 10
    values = np.nan_to_num(crowd).ravel().tolist()
    rows = [{"pose_keypoints_2d": values[75 * n : 75 * n + 75]} for n in range(200)]
    path = tmp_path / "a_000.json"
    path.write_text(str({"people": rows}).replace("'", '"'))
    read = read_people(path, landmark_set_named("body25"))
    assert read is not None and len(read) == MOST_PEOPLE


def test_more_people_than_can_be_paired_are_refused(scene):
    cameras = tuple(replace(scene.rig.cameras[0], name=str(n)) for n in range(17))
    tracker = fusecap.Tracker(fusecap.Rig(cameras=cameras), scene.landmark_set)
    people = (np.repeat(scene.detections[0].people[0][:1], 64, axis=0),) * 17
    with pytest.raises(InputError, match=f"at most {MOST_DETECTIONS}"):
        tracker.update(Detections(timestamp_ns=1, people=people), {}, 1)


def test_a_crowd_in_many_views_is_thinned_to_the_surest(scene):
    """31 cameras that see 40 people each: more than a sorter takes."""
    one = scene.detections[0].people[0][0]
    people = [np.repeat(one[None], 40, axis=0) for _ in range(31)]
    for view in people:
        view[:, :, 2] = np.linspace(0.2, 0.9, 40)[:, None]
    cameras = Cameras((60.0,) * 31, len(one))
    for camera, view in enumerate(people):
        cameras.take(CameraSample(timestamp_ns=0, camera=camera, people=view))
    found = cameras.detections(0)
    assert sum(map(len, found.people)) == MOST_DETECTIONS
    assert min(view[:, 0, 2].min() for view in found.people) > 0.29
    rig = fusecap.Rig(cameras=tuple(replace(scene.rig.cameras[0], name=str(n)) for n in range(31)))
    checked = believable_detections(found, len(rig), len(one))
    assert believable_detections(checked, len(rig), len(one)) is checked
    few = surest_of_views(people[:3])
    assert all(a is b for a, b in zip(few, people[:3], strict=True))
    crowd = surest_of_views([np.repeat(one[None], 2000, axis=0)])
    assert len(crowd[0]) == MOST_PEOPLE


ODD = (np.nan, np.inf, -np.inf, -1.0, 1e300, -1e160)


@pytest.mark.parametrize("odd", ODD)
def test_what_a_scene_is_made_of_is_checked(odd):
    camera = demo_scene(seconds=0.1).rig.cameras[0]
    shape = BodyShape.from_height(PAPER21, 1.7)
    prior = load_prior(PAPER21)
    builders = [
        lambda: replace(camera, matrix=camera.matrix * odd),
        lambda: replace(camera, rotation=camera.rotation * odd),
        lambda: BodyShape.from_height(PAPER21, odd),
        lambda: replace(shape, height_m=odd),
        lambda: shape.with_lengths({"left_shank": odd}),
        lambda: replace(prior, sigma=prior.sigma * odd),
        lambda: Weights(position=odd),
        lambda: SolverOptions(max_iterations=10**9),
        lambda: SolverOptions(initial_damping=odd),
        lambda: SolverOptions(floor_radius_m=odd),
        lambda: TrackerOptions(gate_m=odd),
    ]
    for build in builders:
        with np.errstate(all="ignore"), pytest.raises(FusecapError):
            build()
    if abs(odd) != 1.0:  # a metre the other way is a place
        for build in (
            lambda: replace(camera, translation=np.full(3, odd)),
            lambda: replace(camera, distortion=np.full(5, odd)),
            lambda: replace(shape, offsets_m=shape.offsets_m * odd),
            lambda: SubjectModel(name="a", start_m=(odd, 0.0)),
            lambda: ImuSites(bone=(0,), position_m=np.full((1, 3), odd)),
        ):
            with np.errstate(all="ignore"), pytest.raises(FusecapError):
                build()


@pytest.mark.parametrize("side", [-5, 0, 10**7])
def test_a_picture_of_impossible_size_is_refused(side):
    with pytest.raises(FusecapError, match="image size"):
        replace(demo_scene(seconds=0.1).rig.cameras[0], size_px=(side, 100))


def test_a_skeleton_without_bones_is_refused():
    with pytest.raises(FusecapError):
        Skeleton(name="none", bone_names=(), parents=())


@pytest.mark.parametrize("tiny", [5e-324, 1e-300, 1e-20])
def test_a_lens_with_hardly_any_distortion_is_a_lens(tiny):
    camera = demo_scene(seconds=0.1).rig.cameras[0]
    lens = replace(camera, distortion=np.array([0.1, 0.0, 0.0, 0.0, tiny]))
    assert isinstance(lens, Camera) and lens.max_radius_squared > 1.0
    assert np.isfinite(lens.packed[:-2]).all()
