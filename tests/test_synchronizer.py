from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.sources.imu_files import ImuTrack, SharedClock
from fusecap.sources.keypoint_files import KeypointTrack, without_missing
from fusecap.sources.session import SubjectSettings
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.sources.session_sensors import open_imus
from fusecap.sources.synchronizer import (
    MountedImu,
    people_at,
    readings_at,
    resample_imus,
    world_from_imu_world,
)
from fusecap.types import GRAVITY_M_S2
from session_files import write_session

COCO = landmark_set_named("coco17")


def track(people, frames=None, rate_hz=10.0, offset_s=0.0):
    frames = np.arange(len(people)) if frames is None else np.array(frames)
    return KeypointTrack(
        name="cam",
        landmarks=COCO,
        rate_hz=rate_hz,
        frames=frames,
        times_s=frames / rate_hz + offset_s,
        people=tuple(
            without_missing(np.array(p)) if len(p) else np.empty((0, 17, 3)) for p in people
        ),
        broken=(),
    )


def person(x, y=100.0, confidence=0.8):
    return np.column_stack(
        [np.full(17, float(x)), y + 10.0 * np.arange(17), np.full(17, confidence)]
    )


def test_frame_at_the_instant_is_taken_as_it_is():
    moving = track([[person(0.5)], [person(10)], [person(20)]], offset_s=0.03)
    assert people_at(moving, 0.13) is moving.people[1]
    assert people_at(moving, 0.13 + 5e-7) is moving.people[1]


def test_keypoints_between_frames_are_interpolated():
    moving = track([[person(10, confidence=0.4)], [person(20, confidence=0.8)]])
    between = people_at(moving, 0.025)
    assert between.shape == (1, 17, 3)
    assert np.allclose(between[0, :, 0], 12.5) and np.allclose(between[0, :, 2], 0.5)


def test_people_are_matched_whatever_their_order():
    swapped = track([[person(10), person(300)], [person(304), person(12)]])
    between = people_at(swapped, 0.05)
    assert sorted(between[:, 0, 0].tolist()) == [11, 302]


def test_people_too_far_apart_are_not_one_person():
    assert len(people_at(track([[person(10)], [person(300)]]), 0.05)) == 0


def test_person_in_one_of_two_frames_is_missing_between_them():
    between = people_at(track([[person(10)], [person(11), person(300)]]), 0.05)
    assert between[:, 0, 0].tolist() == [10.5]
    assert len(people_at(track([[person(10)], []]), 0.05)) == 0


def test_keypoint_in_one_of_two_frames_is_missing_between_them():
    half = person(10)
    half[5] = 0
    between = people_at(track([[half], [person(11)]]), 0.05)[0]
    assert np.isnan(between[5, :2]).all() and between[5, 2] == 0
    assert np.isfinite(np.delete(between, 5, axis=0)).all()


def test_no_frame_reaches_further_than_half_a_period():
    still = track([[person(10)], [person(10)], [person(10)]], frames=[0, 1, 5])
    assert len(people_at(still, -0.049)) == 1 and len(people_at(still, -0.051)) == 0
    assert len(people_at(still, 0.149)) == 1 and len(people_at(still, 0.3)) == 0
    assert len(people_at(still, 0.451)) == 1
    assert len(people_at(still, 0.549)) == 1 and len(people_at(still, 0.551)) == 0


def frozen(rate_hz, gap_s):
    """A second of one person, a gap without a frame number missing, and another second."""
    count = round(rate_hz)
    times_s = np.arange(2 * count) / rate_hz
    times_s[count:] += gap_s - 1 / rate_hz
    moving = track([[person(10 + i)] for i in range(2 * count)], rate_hz=rate_hz)
    return replace(moving, times_s=times_s), times_s[count - 1] + gap_s / 2


@pytest.mark.parametrize("rate_hz", [10.0, 30.0, 60.0])
def test_freeze_of_a_video_is_not_bridged(rate_hz):
    for gap_s in (0.3, 1.0):
        moving, t_s = frozen(rate_hz, gap_s)
        assert len(people_at(moving, t_s)) == 0
        last_s = t_s - gap_s / 2
        assert len(people_at(moving, last_s + 0.4 / rate_hz)) == 1
        assert people_at(moving, t_s + gap_s / 2 - 0.4 / rate_hz) is moving.people[round(rate_hz)]


@pytest.mark.parametrize(("rate_hz", "gap_s"), [(60.0, 0.09), (10.0, 0.2), (5.0, 0.4)])
def test_gaps_of_a_few_frames_are_bridged(rate_hz, gap_s):
    moving, t_s = frozen(rate_hz, gap_s)
    assert people_at(moving, t_s)[0, 0, 0] == pytest.approx(9.5 + rate_hz)


def test_camera_of_ten_frames_a_second_is_interpolated_throughout():
    moving = track([[person(10 + i)] for i in range(100)], rate_hz=10.0)
    for t_s in np.arange(0.05, 9.85, 0.1):
        assert people_at(moving, t_s)[0, 0, 0] == pytest.approx(10 + 10 * t_s)


@given(st.floats(0, 0.4), st.floats(-200, 200))
def test_constant_velocity_is_reproduced(t_s, velocity):
    moving = track([[person(500 + velocity * 0.1 * frame)] for frame in range(5)])
    assert people_at(moving, t_s)[0, 0, 0] == pytest.approx(500 + velocity * t_s, abs=0.01)


def imu(times_s, rotation, accel=None, *, up="y", heading_deg=0.0, mount=None):
    accel = np.full((len(times_s), 3), np.nan) if accel is None else np.array(accel, float)
    return MountedImu(
        bone="hips",
        track=ImuTrack(
            times_s=np.array(times_s, float),
            orientation_wxyz=rotation.as_quat()[:, [3, 0, 1, 2]],
            accel_m_s2=accel,
        ),
        world_from_imu_world=world_from_imu_world(up, heading_deg),
        bone_from_imu=np.eye(3) if mount is None else mount.as_matrix(),
        position_in_bone_m=np.zeros(3),
    )


def test_orientations_are_slerped_along_the_shorter_arc():
    rotation = Rotation.from_rotvec([[0, 0.2, 0], [0, 0.4, 0]])
    sensor = imu([0, 0.01], rotation)
    flipped = -sensor.track.orientation_wxyz[1]
    sensor.track.orientation_wxyz[1] = flipped
    rotations, _ = resample_imus([sensor], np.array([0.0025, 0.0075]))
    angles = Rotation.from_matrix(rotations[:, 0]).as_rotvec()
    assert np.allclose(angles, [[0, 0.25, 0], [0, 0.35, 0]])


def test_acceleration_is_interpolated_linearly():
    still = Rotation.from_rotvec(np.zeros((2, 3)))
    sensor = imu([0, 0.1], still, [[0, GRAVITY_M_S2, 0], [4, GRAVITY_M_S2 + 2, 0]])
    reading = readings_at([sensor], 0.025)
    assert np.allclose(reading.accel_in_world_m_s2, [[1, 0.5, 0]])


def test_long_gaps_and_the_outside_are_nan():
    sensor = imu([0, 0.05, 0.5, 0.55], Rotation.from_rotvec(np.zeros((4, 3))))
    rotations, accelerations = resample_imus([sensor], np.array([-0.01, 0.02, 0.3, 0.5, 0.56]))
    known = np.isfinite(rotations[:, 0]).all(axis=(1, 2))
    assert known.tolist() == [False, True, False, True, False]
    assert np.isnan(accelerations).all()


def test_missing_acceleration_leaves_the_orientation():
    accel = [[0, 9.8, 0], [np.nan] * 3, [0, 9.8, 0]]
    sensor = imu([0, 0.01, 0.02], Rotation.from_rotvec(np.zeros((3, 3))), accel)
    rotations, accelerations = resample_imus([sensor], np.array([0.0, 0.005, 0.02]))
    assert np.isfinite(rotations).all()
    assert np.isfinite(accelerations[:, 0]).all(axis=1).tolist() == [True, False, True]


def test_single_sample_serves_its_own_instant():
    sensor = imu([0.5], Rotation.from_rotvec([[0, 1, 0]]), [[0, 9.8, 0]])
    rotations, _ = resample_imus([sensor], np.array([0.4, 0.5]))
    assert np.isnan(rotations[0]).all() and np.isfinite(rotations[1]).all()


@given(st.integers(0, 10_000))
def test_bone_orientation_and_acceleration_are_recovered(seed):
    rng = np.random.default_rng(seed)
    world_from_bone, mount = (Rotation.random(rng=rng) for _ in range(2))
    heading_deg, up = float(rng.uniform(-180, 180)), rng.choice(["y", "z"])
    accel_in_world = rng.normal(size=3)
    upright = Y_UP_FROM_Z_UP if up == "z" else np.eye(3)
    turn = Rotation.from_rotvec([0, np.radians(heading_deg), 0]).as_matrix()
    world_from_imu_frame = world_from_bone * mount
    imu_world_from_imu = Rotation.from_matrix((turn @ upright).T) * world_from_imu_frame
    force = world_from_imu_frame.inv().apply(accel_in_world + [0, GRAVITY_M_S2, 0])
    twice = Rotation.concatenate([imu_world_from_imu, imu_world_from_imu])
    sensor = imu([0, 0.01], twice, [force, force], up=up, heading_deg=heading_deg, mount=mount)
    reading = readings_at([sensor], 0.004)
    assert np.allclose(reading.bone_rotation_in_world[0], world_from_bone.as_matrix(), atol=1e-9)
    assert np.allclose(reading.accel_in_world_m_s2[0], accel_in_world, atol=1e-9)


def test_north_of_a_z_up_sensor_world_is_minus_z():
    assert np.allclose(world_from_imu_world("z", 0) @ [0, 1, 0], [0, 0, -1])
    assert np.allclose(world_from_imu_world("z", 90) @ [0, 1, 0], [-1, 0, 0])
    assert np.allclose(world_from_imu_world("z", 77) @ [0, 0, 1], [0, 1, 0])


def test_sensors_of_one_recorder_keep_their_delays(tmp_path, monkeypatch):
    starts = {"a": 655.0, "b": 0.14}

    def read(path, **_):
        return ImuTrack(
            times_s=np.arange(300) / 100,
            orientation_wxyz=np.tile([1.0, 0, 0, 0], (300, 1)),
            accel_m_s2=np.zeros((300, 3)),
            clock=SharedClock(start_s=starts[path.name], period_s=655.36),
        )

    monkeypatch.setattr("fusecap.sources.session_sensors.read_imu", read)
    subject = SubjectSettings.model_validate(
        {"name": "A", "imu": [{"bone": "hips", "file": name} for name in starts]}
    )
    tracks = open_imus(subject)
    assert [round(float(t.times_s[0]), 6) for t in tracks] == [0.0, 0.5]


def test_camera_of_half_the_rate_is_interpolated_onto_the_solve(tmp_path):
    path = write_session(tmp_path, frames=40)
    data = open_session(load_session(path))
    for file in sorted((tmp_path / "keypoints" / "cam1").iterdir()):
        frame = int(file.name.split("_")[1])
        if frame % 2:
            file.unlink()
        else:
            file.rename(file.with_name(f"cam1_{frame // 2:012d}_keypoints.json"))
    text = path.read_text().replace('name = "cam1"', 'name = "cam1"\nrate_hz = 15')
    path.write_text(text)
    halved = open_session(load_session(path))
    assert np.allclose(halved.times_s, data.times_s)
    for instant in range(38):
        full = data.detections(instant).people[1]
        half = halved.detections(instant).people[1]
        assert np.nanmax(np.abs(full[0, :, :2] - half[0, :, :2])) < 1.0
