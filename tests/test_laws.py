"""Laws of geometry, clocks and association: what must not matter does not."""

from __future__ import annotations

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from fusecap.geometry.quaternions import from_wxyz, to_wxyz
from fusecap.geometry.same_people import same_people
from fusecap.geometry.triangulation import triangulate
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session_data import BLOCK, SubjectImus
from fusecap.sources.sync_files import Clock
from fusecap.sources.synchronizer import MountedImu, ViewOfPeople, resample_imus, seen_amid
from fusecap.types import Detections
from people_scene import BODY25, circle, observe, ring_of_cameras, walker

seeds = st.integers(0, 2**32 - 1)


# ------------------------------------------------------------------------------------- geometry


@given(seeds)
def test_a_point_seen_is_the_point_that_was_there_whatever_the_order_of_cameras(seed):
    rng = np.random.default_rng(seed)
    rig = ring_of_cameras(5)
    points = rng.uniform([-1.5, 0.0, -1.5], [1.5, 2.0, 1.5], (25, 3))
    keypoints = np.ones((5, 25, 3))
    for view, camera in zip(keypoints, rig.cameras, strict=True):
        view[:, :2] = camera.project(points)
    order = rng.permutation(5)
    turned = rig.subset([rig.names[c] for c in order])
    found, error_px = triangulate(rig, keypoints)
    again, _ = triangulate(turned, keypoints[order])
    np.testing.assert_allclose(found, points, atol=1e-4)
    np.testing.assert_allclose(again, found, atol=1e-6)
    assert error_px.max() < 0.05


@given(seeds, st.floats(-4.0, 4.0), st.floats(-4.0, 4.0))
def test_a_world_that_is_moved_moves_what_is_found_in_it(seed, x_m, angle):
    rng = np.random.default_rng(seed)
    point = rng.uniform([-1.5, 0.0, -1.5], [1.5, 2.0, 1.5], (4, 3))
    camera = ring_of_cameras(4).cameras[seed % 4]
    turn = Rotation.from_euler("y", angle).as_matrix()
    moved = camera.rotation @ turn.T
    there = type(camera)(
        name=camera.name,
        size_px=camera.size_px,
        matrix=camera.matrix,
        distortion=camera.distortion,
        rotation=moved,
        translation=camera.translation - moved @ [x_m, 0.0, 0.0],
    )
    shown = there.project(point @ turn.T + [x_m, 0.0, 0.0])
    np.testing.assert_allclose(shown, camera.project(point), atol=1e-6)


@given(seeds)
def test_quaternions_there_and_back_are_the_same_turn(seed):
    turns = Rotation.random(20, random_state=np.random.default_rng(seed))
    wxyz = to_wxyz(turns)
    assert (wxyz[:, 0] >= 0).all()
    assert (from_wxyz(wxyz).inv() * turns).magnitude().max() < 1e-7
    np.testing.assert_allclose(to_wxyz(from_wxyz(-wxyz)), wxyz, atol=1e-12)


# ------------------------------------------------------------------------------------- clocks


@given(st.floats(-1e4, 1e4), st.floats(-500, 500), st.lists(st.floats(0, 1e4), min_size=2))
def test_a_clock_keeps_the_order_of_times_and_how_far_apart_they_are(offset_s, drift_ppm, own_s):
    own_s = np.sort(own_s)
    session_s = Clock(offset_s=offset_s, drift_ppm=drift_ppm).session_s(own_s)
    assert (np.diff(session_s) >= 0).all()
    np.testing.assert_allclose(
        np.diff(session_s), np.diff(own_s) * (1 + 1e-6 * drift_ppm), atol=1e-9
    )


def crowd(rng: np.random.Generator, count: int) -> np.ndarray:
    """People (n, 25, 3) well apart in a picture."""
    people = rng.uniform(0, 100, (count, 25, 3))
    people[:, :, 0] += 300.0 * np.arange(count)[:, None]
    people[:, :, 2] = 0.9
    return people


@given(seeds, st.integers(1, 6), st.floats(0.001, 0.099), st.floats(-1e3, 1e3))
def test_neither_the_order_of_people_nor_when_time_began_matters_between_frames(
    seed, count, t_s, began_s
):
    rng = np.random.default_rng(seed)
    first = crowd(rng, count)
    second = first + np.array([5.0, 2.0, 0.0])
    plain = seen_amid((0.0, ViewOfPeople(first)), (0.1, ViewOfPeople(second)), t_s, period_s=0.1)
    one, other = rng.permutation(count), rng.permutation(count)
    again = seen_amid(
        (began_s, ViewOfPeople(first[one])),
        (began_s + 0.1, ViewOfPeople(second[other])),
        began_s + t_s,
        period_s=0.1,
    )
    assert plain is not None and again is not None
    assert len(plain.people) == count
    by_place = [np.argsort(view.people[:, 0, 0]) for view in (plain, again)]
    np.testing.assert_allclose(again.people[by_place[1]], plain.people[by_place[0]], atol=1e-6)


@given(seeds)
def test_the_same_people_in_two_pictures_are_the_same_in_any_order(seed):
    rng = np.random.default_rng(seed)
    first = crowd(rng, 5)
    second = (first + rng.normal(size=first.shape) * [3.0, 3.0, 0.0])[rng.permutation(5)[:4]]
    pairs = set(
        zip(*map(np.ndarray.tolist, same_people(first, second, gate_extents=0.25)), strict=True)
    )
    one, other = rng.permutation(5), rng.permutation(4)
    rows, columns = same_people(first[one], second[other], gate_extents=0.25)
    assert set(zip(one[rows].tolist(), other[columns].tolist(), strict=True)) == pairs
    assert len(pairs) == 4


@settings(max_examples=10)
@given(seeds, st.floats(-100.0, 100.0))
def test_sensors_a_block_at_a_time_are_those_all_at_once(seed, began_s):
    rng = np.random.default_rng(seed)
    count = 3 * BLOCK
    times_s = np.cumsum(rng.uniform(0.005, 0.03, count)) + began_s
    imus = [
        MountedImu(
            bone="hips",
            track=ImuTrack(
                times_s=times_s,
                orientation_wxyz=to_wxyz(Rotation.random(count, random_state=rng)),
                accel_m_s2=rng.normal(size=(count, 3)),
            ),
            world_from_imu_world=np.eye(3),
            bone_from_imu=np.eye(3),
            position_in_bone_m=np.zeros(3),
        )
    ]
    asked_s = began_s + np.arange(2 * BLOCK + 7) / 60
    rotations, accelerations = resample_imus(imus, asked_s)
    worn = SubjectImus("anna", imus, asked_s)
    for instant in rng.permutation(len(asked_s))[:50].tolist():
        reading = worn.reading(instant)
        np.testing.assert_array_equal(reading.bone_rotation_in_world, rotations[instant])
        np.testing.assert_array_equal(reading.accel_in_world_m_s2, accelerations[instant])


# ------------------------------------------------------------------------------------- association


@cache
def three_people():
    times_s = np.arange(25) / 30.0
    people = [walker(circle(0.8 + 0.5 * i, 2.0 * i, 0.5), times_s, 1.6 + 0.1 * i) for i in range(3)]
    rig = ring_of_cameras(4)
    return rig, observe(rig, people, np.random.default_rng(11), spurious=0.05)


@settings(max_examples=6)
@given(seeds)
def test_the_order_of_cameras_and_of_detections_changes_nothing_else(seed):
    rig, scene = three_people()
    rng = np.random.default_rng(seed)
    cameras = rng.permutation(len(rig))
    turned = rig.subset([rig.names[c] for c in cameras])
    subjects = [Subject(name="ann"), Subject(name="ben"), Subject(name="cleo")]
    plain, other = (Tracker(each, BODY25, subjects=subjects) for each in (rig, turned))
    followed = 0
    for detections in scene.detections:
        orders = [rng.permutation(len(people)) for people in detections.people]
        shuffled = Detections(
            timestamp_ns=detections.timestamp_ns,
            people=tuple(detections.people[c][orders[c]] for c in cameras),
        )
        given_to = plain.update(detections, {}, detections.timestamp_ns)
        again = other.update(shuffled, {}, detections.timestamp_ns)
        seen = [(u.name, u.state.name, u.person.tolist()) for u in given_to]
        back = []
        for update in again:
            person = [-1] * len(rig)
            for place, number in enumerate(update.person.tolist()):
                camera = int(cameras[place])
                person[camera] = int(orders[camera][number]) if number >= 0 else -1
            back.append((update.name, update.state.name, person))
        assert sorted(back) == sorted(seen)
        followed += len(seen)
    assert followed > 50
