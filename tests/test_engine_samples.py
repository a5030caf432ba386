"""Buffers of a live run: samples in any order, one instant out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.engine.cameras import Cameras
from fusecap.engine.samples import AHEAD_NS, KEPT_NS, MAX_SAMPLES, Samples
from fusecap.engine.sensors import HOLD_S, Sensors
from fusecap.sources.session import ImuSettings, SubjectSettings
from fusecap.types import CameraSample, ImuSample

MS = 1_000_000


def person(x_px):
    return np.column_stack([np.full(5, x_px), np.arange(5) * 20.0, np.full(5, 0.8)])[None]


def camera_at(*times_ms, camera=0, count=1, rate_hz=100.0):
    cameras = Cameras([rate_hz] * count, 5)
    for t in times_ms:
        cameras.take(CameraSample(camera=camera, timestamp_ns=t * MS, people=person(float(t))))
    return cameras


def worn(**mounting):
    imu = ImuSettings.model_validate({"bone": "head", "live": "lsl:x", "imu_up": "y", **mounting})
    return Sensors([SubjectSettings.model_validate({"name": "anna", "imu": [imu.model_dump()]})])


def sample(t_ms, angle_rad=0.0, accel=(0.0, 9.80665, 0.0), **changes):
    x, y, z, w = Rotation.from_rotvec([0.0, angle_rad, 0.0]).as_quat()
    fields = {
        "subject": "anna",
        "bone": "head",
        "timestamp_ns": round(t_ms * MS),
        "orientation_wxyz": np.array([w, x, y, z]),
        "accel_m_s2": np.array(accel),
    }
    return ImuSample(**{**fields, **changes})


def heading_rad(reading):
    return Rotation.from_matrix(reading.bone_rotation_in_world[0]).as_rotvec()[1]


@given(st.permutations(list(range(10))))
def test_order_of_arrival_does_not_matter(order):
    samples = Samples[int]()
    for t in order:
        samples.insert(t, t)
    samples.insert(3, -1)
    assert [samples.at(i) for i in range(len(samples))] == [(t, t) for t in range(10)]


def test_samples_far_from_the_instant_are_left_out():
    samples = Samples[int]()
    samples.insert(0, 0)
    samples.forget_before(KEPT_NS + 1)
    samples.insert(1 - MS, 1)
    samples.insert(KEPT_NS + 1 + AHEAD_NS + 1, 2)
    assert len(samples) == 0
    samples.insert(1, 3)
    samples.insert(KEPT_NS + 1 + AHEAD_NS, 4)
    assert len(samples) == 2


def test_a_flood_does_not_grow_without_bound():
    samples = Samples[int]()
    for t in range(MAX_SAMPLES + 7):
        samples.insert(t, t)
    assert len(samples) == MAX_SAMPLES and samples.at(0) == (7, 7), "the oldest go"


def test_a_gap_is_not_taken_for_the_period():
    samples = Samples[int]()
    for t in (0, 10, 20, 30, 1900, 1910, 1920):
        samples.insert(t * MS, t)
    assert samples.period_s(1910 * MS) == pytest.approx(0.01)


def test_one_early_sample_does_not_make_the_period():
    samples = Samples[int]()
    for t in (0, 5, 20, 35):
        samples.insert(t * MS, t)
    assert samples.period_s(35 * MS) == pytest.approx(0.015)
    assert samples.period_s(5 * MS) is None, "not enough samples yet"


def test_camera_is_interpolated_on_the_instants_of_the_solve():
    detections = camera_at(0, 10, 20).detections(13 * MS)
    assert detections.people[0][0, 0, 0] == pytest.approx(13.0)
    assert detections.looked == (True,)


def test_newest_picture_holds_for_half_a_period():
    cameras = camera_at(0, 10, 20)
    assert cameras.detections(24 * MS).people[0][0, 0, 0] == 20.0
    assert len(cameras.detections(26 * MS).people[0]) == 0


def test_frozen_camera_is_not_bridged_and_soon_no_longer_looks():
    cameras = camera_at(0, 10, 20, 30, 40, 1000, 1010)
    assert len(cameras.detections(300 * MS).people[0]) == 0
    assert cameras.detections(540 * MS).looked == (True,)
    assert cameras.detections(541 * MS).looked == (False,)
    assert cameras.detections(1000 * MS).looked == (True,)


def test_camera_that_never_delivered_does_not_look():
    assert camera_at(0, 10, count=2).detections(0).looked == (True, False)


def test_unusable_camera_samples_are_left_out():
    cameras = camera_at(0)
    cameras.take(CameraSample(camera=1, timestamp_ns=10 * MS, people=person(0.0)))
    cameras.take(CameraSample(camera=-1, timestamp_ns=10 * MS, people=person(0.0)))
    cameras.take(CameraSample(camera=0, timestamp_ns=10 * MS, people=person(0.0)[:, :3]))
    cameras.take(CameraSample(camera=0, timestamp_ns=10 * MS, people=person(0.0)[0]))
    assert len(cameras.detections(0).people[0]) == 1
    assert len(cameras.detections(10 * MS).people[0]) == 0


def test_keypoint_without_a_place_is_missing():
    odd = person(1.0)
    odd[0, 0, 0], odd[0, 1, 1], odd[0, 2, 2], odd[0, 3, 2] = np.nan, np.inf, np.nan, 7.0
    cameras = camera_at()
    cameras.take(CameraSample(camera=0, timestamp_ns=0, people=odd))
    found = cameras.detections(0).people[0][0]
    assert np.isnan(found[:4, :2]).all() and (found[:4, 2] == 0).all() and found[4, 2] == 0.8


def test_orientation_is_on_the_shorter_arc_and_acceleration_on_a_line():
    sensors = worn(bone_from_imu_wxyz=[1, 0, 0, 0])
    sensors.take(sample(0, 0.2, (0, 9.80665, 0)))
    flipped = -sample(10, 0.4).orientation_wxyz
    sensors.take(sample(10, accel=(1, 9.80665, 0), orientation_wxyz=flipped))
    reading = sensors.readings(2_500_000)["anna"]
    assert heading_rad(reading) == pytest.approx(0.25)
    turned = Rotation.from_rotvec([0, 0.25, 0]).apply([0.25, 0, 0])
    assert reading.accel_in_world_m_s2[0] == pytest.approx(turned)


def test_sensor_holds_for_20_ms_and_is_never_extrapolated():
    sensors = worn(bone_from_imu_wxyz=[1, 0, 0, 0])
    sensors.take(sample(0, 0.2))
    sensors.take(sample(10, 0.3))
    assert heading_rad(sensors.readings(round((0.01 + HOLD_S) * 1e9))["anna"]) == pytest.approx(0.3)
    assert sensors.readings(round((0.011 + HOLD_S) * 1e9)) == {}


def test_sensor_gap_over_a_tenth_of_a_second_is_not_bridged():
    sensors = worn(bone_from_imu_wxyz=[1, 0, 0, 0])
    for t_ms in (0, 10, 120, 130):
        sensors.take(sample(t_ms))
    assert "anna" not in sensors.readings(60 * MS)
    assert "anna" in sensors.readings(120 * MS)


def test_sensors_know_when_a_sample_is_still_to_come():
    sensors = worn(bone_from_imu_wxyz=[1, 0, 0, 0])
    assert sensors.waiting(0) == []
    sensors.take(sample(10))
    assert sensors.waiting(10 * MS) == [False] and sensors.waiting(11 * MS) == [True]
    assert sensors.waiting(60 * MS) == [True], "as long as it is fresh"
    assert sensors.waiting(60 * MS + 1) == sensors.waiting(2000 * MS) == []


def test_unusable_sensor_samples_are_left_out():
    sensors = worn(bone_from_imu_wxyz=[1, 0, 0, 0])
    sensors.take(sample(0, orientation_wxyz=np.full(4, np.nan)))
    sensors.take(sample(0, orientation_wxyz=np.zeros(4)))
    sensors.take(sample(0, bone="tail"))
    sensors.take(sample(0, subject="nobody"))
    assert sensors.readings(0) == {}
    sensors.take(sample(0, accel=(0.0, np.inf, 0.0)))
    sensors.take(sample(0))
    accel = sensors.readings(0)["anna"].accel_in_world_m_s2
    assert np.isnan(accel).all(), "of two samples of one time the first stays"


def test_sensor_says_nothing_before_its_mounting_is_known():
    sensors = worn()
    for t_ms in range(0, 1000, 10):
        sensors.take(sample(t_ms, 0.7))
    assert sensors.readings(500 * MS) == {}
    assert "taken by 1 sensors" in sensors.mount_in_tpose("anna", 0.5)
    assert heading_rad(sensors.readings(500 * MS)["anna"]) == pytest.approx(0.5)
    turned = Rotation.from_matrix(sensors.mountings["anna", "head"]).as_rotvec()
    assert turned == pytest.approx([0.0, 0.2, 0.0]), "0.7 rad in the world, of which she faces 0.5"


def test_tpose_of_a_sensor_that_moved_is_refused():
    sensors = worn()
    for t_ms in range(0, 1000, 10):
        sensors.take(sample(t_ms, 0.3 * t_ms / 1000))
    said = sensors.mount_in_tpose("anna", 0.0)
    assert "refused" in said and "head by" in said and "stand still" in said
    assert sensors.readings(500 * MS) == {}


@pytest.mark.parametrize(("still_ms", "found"), [(1010, "taken"), (990, "refused")])
def test_tpose_needs_a_second_of_standing_still(still_ms, found):
    sensors = worn()
    for t_ms in range(0, 1910, 10):
        sensors.take(sample(t_ms, 0.0 if t_ms > 1900 - still_ms else 1.0))
    assert found in sensors.mount_in_tpose("anna", 0.0)


def test_tpose_of_silent_sensors_is_refused():
    assert "no sensor is heard" in worn().mount_in_tpose("anna", 0.0)
