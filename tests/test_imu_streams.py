import json
import math
import random
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fusecap.believable import MOST_PEOPLE, surest
from fusecap.body.landmarks import landmark_set_named
from fusecap.errors import InputError
from fusecap.inputs import KEYPOINTS
from fusecap.sources.imu_streams.lsl import sensor_channels
from fusecap.sources.imu_streams.mvn import mvn_packet
from fusecap.sources.imu_streams.osc import osc_packet
from fusecap.sources.keypoint_files import read_people
from fusecap.sources.live_sensor import MAX_DATAGRAM_BYTES, Packet, Refused
from fusecap.sources.synchronizer import world_from_imu_world
from fusecap.types import ImuSample
from imu_packets import mvn, mvn_segments, mvn_trackers, osc_bundle, osc_message

HALF = math.sqrt(0.5)
COCO = landmark_set_named("coco17")


def test_osc_message_of_python_osc_is_read():
    packet = osc_packet(osc_message("arm", 1.25, (HALF, 0.0, HALF, 0.0), (1.0, 2.0, 3.0)).dgram)
    (sample,) = packet.samples
    assert packet.refused == () and sample.sensor == "arm" and sample.stamp_ns == 1_250_000_000
    assert np.allclose(sample.orientation_wxyz, [HALF, 0.0, HALF, 0.0], atol=1e-7)
    assert sample.accel_m_s2.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(("seconds", "accel"), [(None, None), (None, (0, 0, 9)), (2.0, None)])
def test_osc_time_and_acceleration_may_be_left_out(seconds, accel):
    (sample,) = osc_packet(osc_message(seconds=seconds, accel=accel).dgram).samples
    assert sample.stamp_ns == (None if seconds is None else 2_000_000_000)
    assert np.isnan(sample.accel_m_s2).all() == (accel is None)


def test_osc_bundle_gives_its_time_to_messages_without_one():
    messages = [osc_message("a", None), osc_message("b", 3.0)]
    first, second = osc_packet(osc_bundle(messages, 1_700_000_000.5).dgram).samples
    since_1900_s = 1_700_000_000.5 + 2_208_988_800
    assert first.stamp_ns == pytest.approx(since_1900_s * 1e9, abs=1e6)
    assert second.stamp_ns == 3_000_000_000
    (now,) = osc_packet(osc_bundle(messages[:1]).dgram).samples
    assert now.stamp_ns is None


def test_one_bad_osc_message_spares_the_others_of_its_bundle():
    bad = osc_message("bad", quaternion=(2.0, 0.0, 0.0, 0.0))
    packet = osc_packet(osc_bundle([osc_message("a"), bad, osc_message("b")]).dgram)
    assert [sample.sensor for sample in packet.samples] == ["a", "b"]
    assert packet.refused == ("the quaternion's norm is 2, expected 1",)


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"", "does not end"),
        (b"hello\0\0\0", "neither a message nor a bundle"),
        (b"#bundle\0" + bytes(8) + struct.pack(">i", -4), "an element of -4 bytes"),
        (b"#bundle\0" + bytes(8) + struct.pack(">i", 400), "an element of 400 bytes"),
        (b"#bundle\0" + bytes(3), "cut short"),
        (osc_message().dgram[:-4], "cut short"),
        (osc_message().dgram + bytes(4), "longer than its types"),
        (osc_message("").dgram, "name is empty"),
        (osc_message("x" * 300).dgram, "does not end"),
        (osc_message(quaternion=(1, 0)).dgram, "6 numbers"),
        (osc_message(quaternion=(math.nan, 0, 0, 0)).dgram, "norm is nan"),
        (osc_message(accel=(math.inf, 0, 0)).dgram, "acceleration is inf"),
        (osc_message(seconds=1e300).dgram, "time is 1e+300 s"),
        (b"/fusecap/imu\0\0\0\0,ss\0a\0\0\0b\0\0\0", "types ',ss'"),
    ],
)
def test_osc_that_does_not_follow_the_layout_is_refused_with_a_reason(datagram, reason):
    packet = osc_packet(datagram)
    assert packet.samples == () and reason in packet.refused[0]


def test_osc_float_time_is_refused_once_it_is_coarse():
    def message(seconds):
        return b"/fusecap/imu\0\0\0\0,sfffff\0a\0\0\0" + struct.pack(">5f", seconds, 1, 0, 0, 0)

    assert osc_packet(message(100.5)).samples[0].stamp_ns == 100_500_000_000
    assert "send a double" in osc_packet(message(1e6)).refused[0]


def test_osc_message_of_another_address_is_passed_over():
    other = osc_message().dgram.replace(b"/fusecap/imu", b"/fusecap/xyz")
    assert osc_packet(other) == Packet()


def test_deeply_nested_osc_bundles_are_refused():
    packet = osc_message().dgram
    for _ in range(400):
        packet = b"#bundle\0" + bytes(7) + b"\1" + struct.pack(">i", len(packet)) + packet
    assert "deep" in osc_packet(packet).refused[0]


def test_mvn_tracker_gives_its_orientation_and_specific_force():
    upside_down = (0.0, 1.0, 0.0, 0.0)
    packet = mvn_packet(mvn_trackers({1: upside_down, 14: (1, 0, 0, 0)}, (0.0, 0.0, 2.0)))
    pelvis, forearm = packet.samples
    assert pelvis.sensor == "Pelvis?character=0&data=sensor" and pelvis.counter == 7
    assert pelvis.stamp_ns == 1_500_000_000
    assert np.allclose(pelvis.accel_m_s2, [0, 0, -11.80665], atol=1e-5)
    assert forearm.sensor.startswith("LeftForeArm?")
    assert np.allclose(forearm.accel_m_s2, [0, 0, 11.80665], atol=1e-5)


def test_mvn_tracker_of_68_bytes_before_2018_is_read_alike():
    numbers = (1, 0, 0, 0, 0.0, 0.0, 2.0, 1, 2, 3, 4, 5, 6, 7, 8, 9)
    (sample,) = mvn_packet(mvn(b"23", [(1, numbers)])).samples
    assert np.allclose(sample.accel_m_s2, [0, 0, 11.80665], atol=1e-5)


def test_mvn_segments_of_a_split_sample_come_with_their_own_identities():
    first = mvn_packet(mvn_segments({1: (1, 0, 0, 0)}, datagram=0))
    last = mvn_packet(mvn_segments({23: (HALF, 0, 0, HALF), 24: (1, 0, 0, 0)}, datagram=0x81))
    assert [s.sensor for s in first.samples] == ["Pelvis?character=0&data=segment"]
    assert [s.sensor for s in last.samples] == ["LeftToe?character=0&data=segment"]
    assert np.isnan(first.samples[0].accel_m_s2).all()


def test_mvn_contents_of_other_types_are_passed_over():
    assert mvn_packet(mvn(b"12", [])) == Packet()
    assert mvn_packet(mvn(b"13", [(1, (1.0,))])) == Packet()


@pytest.mark.parametrize(
    ("datagram", "reason"),
    [
        (b"MXTP02", "a header of 24"),
        (b"MXTQ02" + bytes(18), "MXTP"),
        (mvn_segments({1: (1, 0, 0, 0)})[:-1], "31 bytes found"),
        (mvn_segments({1: (1, 0, 0, 0)})[:11] + b"\x02" + bytes(12), "2 items"),
        (mvn_trackers({1: (0, 0, 0, 0)}), "Pelvis: the quaternion's norm is 0"),
        (mvn_trackers({1: (1, 0, 0, 0)}, (math.nan, 0, 1)), "acceleration is nan"),
    ],
)
def test_mvn_that_does_not_follow_the_layout_is_refused_with_a_reason(datagram, reason):
    packet = mvn_packet(datagram)
    assert packet.samples == () and reason in packet.refused[0]


def test_mvn_segment_needs_the_mounting_that_the_documentation_states():
    """In the T-pose MVN's segments are identity (x forward, y left, z up); so are our bones."""
    (sample,) = mvn_packet(mvn_segments({14: (1, 0, 0, 0)})).samples
    w, x, y, z = (0.5, -0.5, -0.5, -0.5)
    bone_from_imu = Rotation.from_quat([x, y, z, w])
    assert np.allclose(bone_from_imu.apply([1, 0, 0]), [0, 0, 1])
    w, x, y, z = sample.orientation_wxyz
    imu_world_from_imu = Rotation.from_quat([x, y, z, w]).as_matrix()
    for heading_deg, forward in ((-90.0, [0, 0, 1]), (0.0, [1, 0, 0])):
        world_from_bone = (
            world_from_imu_world("z", heading_deg)
            @ imu_world_from_imu
            @ bone_from_imu.inv().as_matrix()
        )
        assert np.allclose(world_from_bone @ [0, 0, 1], forward)
        assert np.allclose(world_from_bone @ [0, 1, 0], [0, 1, 0])


def mutations(valid, rng):
    """One damaged datagram: bits turned, cut, grown, parts repeated or swapped."""
    data = bytearray(rng.choice(valid))
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(data)) if data else 0
        match rng.randrange(7):
            case 0 if data:
                data[at] ^= 1 << rng.randrange(8)
            case 1 if data:
                data[at] = rng.choice((0, 1, 127, 128, 255))
            case 2:
                del data[at:]
            case 3:
                data += rng.randbytes(rng.randint(1, 40))
            case 4:
                data[at:at] = data[: rng.randint(0, 64)]
            case 5 if len(data) > at + 4:
                data[at : at + 4] = struct.pack(">i", rng.choice((-1, -4, 2**31 - 1, 0, 65536)))
            case _ if len(data) > at + 4:
                data[at : at + 4] = struct.pack(">f", rng.choice((math.nan, math.inf, -1e38, 0.0)))
    return bytes(data[:MAX_DATAGRAM_BYTES])


OSC = [
    osc_message().dgram,
    osc_message(seconds=None, accel=None).dgram,
    osc_bundle([osc_message("a"), osc_message("b", None)], 1_700_000_000.0).dgram,
    osc_bundle([osc_bundle([osc_message("a")]), osc_message("c")]).dgram,
]
MVN = [
    mvn_segments(dict.fromkeys(range(1, 24), (1, 0, 0, 0))),
    mvn_trackers(dict.fromkeys(range(1, 18), (HALF, 0, HALF, 0)), (0.1, 0.2, 0.3)),
    mvn(b"12", []),
]


def is_usable(packet):
    for sample in packet.samples:
        ImuSample(
            subject="A",
            bone="hips",
            timestamp_ns=sample.stamp_ns or 0,
            orientation_wxyz=sample.orientation_wxyz,
            accel_m_s2=sample.accel_m_s2,
        )
        assert abs(np.linalg.norm(sample.orientation_wxyz) - 1) < 1e-9
        accel = sample.accel_m_s2
        assert np.isnan(accel).all() or np.abs(accel).max() < 1e4
        assert len(sample.sensor) < 250
    assert all(0 < len(reason) < 200 for reason in packet.refused)
    return True


def fuzz(parse, valid, count, seed):
    rng = random.Random(seed)
    tracemalloc.start()
    try:
        for _ in range(count):
            assert is_usable(parse(mutations(valid, rng)))
        assert tracemalloc.get_traced_memory()[1] < 2_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(("parse", "valid"), [(osc_packet, OSC), (mvn_packet, MVN)])
def test_2000_damaged_datagrams_give_samples_or_reasons_in_little_memory(parse, valid):
    fuzz(parse, valid, 2_000, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize(("parse", "valid"), [(osc_packet, OSC), (mvn_packet, MVN)])
def test_20000_damaged_datagrams_give_samples_or_reasons_in_little_memory(parse, valid):
    fuzz(parse, valid, 20_000, seed=1)


@given(st.binary(max_size=400))
@settings(max_examples=500, deadline=None)
def test_any_bytes_give_samples_or_reasons(data):
    assert is_usable(osc_packet(data)) and is_usable(mvn_packet(data))
    assert is_usable(osc_packet(b"#bundle\0" + data)) and is_usable(mvn_packet(b"MXTP23" + data))


LABELS = [f"{s}_{c}" for s in ("arm", "leg") for c in ("qw", "qx", "qy", "qz", "ax", "ay", "az")]


def test_lsl_channels_are_found_by_their_labels_in_any_order_and_spelling():
    channels = sensor_channels("s", LABELS, [""] * 14, "leg")
    assert channels.orientation_wxyz == (7, 8, 9, 10) and channels.accel == (11, 12, 13)
    mixed = [f"Leg Orientation{c}" for c in "XYZW"] + [f"leg.acc_{c}" for c in "xyz"]
    channels = sensor_channels("s", mixed, ["", "", "", "", "g", "g", "g"], "")
    assert channels.orientation_wxyz == (3, 0, 1, 2)
    sample = channels.sample([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0], 5)
    assert sample.orientation_wxyz.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert sample.accel_m_s2.tolist() == [0.0, 0.0, 9.80665] and sample.stamp_ns == 5
    with pytest.raises(Refused, match="norm"):
        channels.sample([0.0] * 7, 5)


def test_lsl_stream_without_labels_is_taken_by_its_length():
    assert sensor_channels("s", [""] * 4, [""] * 4, "").accel is None
    assert sensor_channels("s", [""] * 7, [""] * 7, "").accel == (4, 5, 6)


@pytest.mark.parametrize(
    ("labels", "sensor", "expected"),
    [
        ([""] * 8, "", "8 channels without labels"),
        (LABELS, "", "2 sensors among its 14 channels"),
        (LABELS, "lag", "no sensor 'lag' among its 14 channels; did you mean 'leg'?"),
        (["Fp1", "Cz"], "", "no four channels make up a quaternion"),
        (["qw"] * 5000, "", "at most 4096"),
    ],
)
def test_lsl_stream_without_the_sensor_says_what_is_there(labels, sensor, expected):
    with pytest.raises(InputError, match="lsl:s") as caught:
        sensor_channels("s", labels, [""] * len(labels), sensor)
    assert expected in str(caught.value)


@given(st.lists(st.text(max_size=12), max_size=20), st.text(max_size=8))
@settings(deadline=None)
def test_lsl_labels_of_any_kind_end_in_channels_or_an_input_error(labels, sensor):
    try:
        channels = sensor_channels("s", labels, [""] * len(labels), sensor)
    except InputError:
        return
    assert max(channels.orientation_wxyz) < len(labels)


PERSON = [10.0, 20.0, 0.5] * 17
GARBLED = [
    "[" * 100_000,
    '{"people":' + "[" * 5000 + "]" * 5000 + "}",
    "{}",
    "5",
    '{"people": 5}',
    '{"people": {"a": 1}}',
    '{"people": ["pose_keypoints_2d"]}',
    '{"people": [{"pose_keypoints_2d": {"a": 1}}]}',
    json.dumps({"people": [{"pose_keypoints_2d": [[1, 2]] * 51}]}),
    json.dumps({"people": [{"pose_keypoints_2d": ["x"] * 51}]}),
    json.dumps({"people": [{"pose_keypoints_2d": [10**400] * 51}]}),
    '{"people": [{"pose_keypoints_2d": [' + ",".join(["1" * 5000] * 51) + "]}]}",
    "\0\1\2",
    '{"people": [{"pose_keypoints_2d": [1,',
]


@pytest.mark.parametrize("text", GARBLED)
def test_garbled_keypoint_file_counts_as_broken(tmp_path, text):
    path = tmp_path / "a_000.json"
    path.write_text(text)
    assert read_people(path, COCO) is None


def test_keypoint_file_of_50_megabytes_is_refused_by_its_size(tmp_path):
    path = tmp_path / "a_000.json"
    with path.open("wb") as file:
        file.truncate(50_000_000)
    tracemalloc.start()
    try:
        assert read_people(path, COCO) is None
        assert tracemalloc.get_traced_memory()[1] < (KEYPOINTS.most_bytes or 0)
    finally:
        tracemalloc.stop()


def test_numbers_that_are_no_pixels_count_as_missing(tmp_path):
    wild = list(PERSON)
    wild[0:9] = [math.nan, 1.0, 0.9, 1e300, 1.0, 0.9, 5.0, -math.inf, 0.9]
    path = tmp_path / "a_000.json"
    path.write_text(json.dumps({"people": [{"pose_keypoints_2d": wild}]}))
    read = read_people(path, COCO)
    assert read is not None
    people = surest(read)
    assert people.shape == (1, 17, 3) and (people[0, :3, 2] == 0).all()
    assert np.isnan(people[0, :3, :2]).all() and (people[0, 3:, 2] == 0.5).all()


def test_of_a_crowd_the_surest_are_kept():
    crowd = np.tile(np.array(PERSON).reshape(1, 17, 3), (500, 1, 1))
    crowd[100, :, 2] = 0.9
    people = surest(crowd)
    assert people.shape == (MOST_PEOPLE, 17, 3) and (people[:, 0, 2] == 0.9).sum() == 1


@given(
    st.recursive(
        st.one_of(st.none(), st.booleans(), st.floats(), st.integers(), st.text()),
        lambda x: (
            st.lists(x) | st.dictionaries(st.sampled_from(["people", "pose_keypoints_2d", "a"]), x)
        ),
    )
)
@settings(max_examples=100, deadline=None)
def test_any_json_is_people_broken_or_an_input_error(tmp_path_factory, value):
    path = tmp_path_factory.getbasetemp() / "any_000.json"
    path.write_text(json.dumps({"people": [value, {"pose_keypoints_2d": value}]}))
    try:
        people = read_people(path, COCO)
    except InputError:
        return
    assert people is None or people.shape[1:] == (17, 3)
