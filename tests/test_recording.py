"""The log of a live run: exact, readable by others, and by us after every kind of damage."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkOffsets
from fusecap.errors import InputError
from fusecap.kernels.records import COLUMNS, find_records
from fusecap.live.devices.source import SessionClock
from fusecap.live.recorder import Recorder
from fusecap.recording import reader
from fusecap.recording.index import RecordingIndex
from fusecap.recording.layout import DECODERS, POSE, Known, pose_message
from fusecap.recording.reader import RecordedEvent, RecordedPose, Recording
from fusecap.recording.setup_json import setup_from_values, setup_values
from fusecap.recording.told import told_by
from fusecap.recording.writer import RecordingWriter
from fusecap.setup import SessionSetup
from fusecap.sources.session import Session
from fusecap.types import CameraImage, CameraSample, Command, CommandKind, ImuSample, Tick
from live_fakes import estimate_of, wait_for
from recorded_run import UNIX_NS, record, same_event, simulated_run
from scenes import ring

SECOND_NS = 1_000_000_000


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return simulated_run(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "whole.mcap"
    with path.open("wb") as file:
        record(file, *run)
    return path


@pytest.fixture(scope="module")
def short(run, tmp_path_factory) -> Path:
    """A dozen instants in eight chunks."""
    path = tmp_path_factory.mktemp("recording") / "short.mcap"
    with path.open("wb") as file:
        record(file, run[0], run[1][:400], flush_every=50)
    return path


def small_setup() -> SessionSetup:
    session = Session.model_validate(
        {
            "session": {"name": "small", "calibration": "/home/anna/secret/rig.toml"},
            "camera": [
                {"name": "cam0", "video": "/home/anna/secret/left.mp4"},
                {"name": "cam1", "live": "rtsp://admin:hunter2@10.0.0.5/stream"},
            ],
            "subject": [{"name": 'NaN "Infinity"/é', "imu": [{"bone": "head", "live": "lsl:x"}]}],
        },
        context={"file": Path("/home/anna/secret/session.toml")},
    )
    landmarks = LANDMARK_SETS["halpe26"].calibrated(
        LandmarkOffsets(
            everyone={"nose": (0.1, 1 / 3, -0.0)}, subjects={"a": {"left_ear": (0.04, 0.0, 1e-17)}}
        )
    )
    rig = ring(2, distortion=(0.1, -0.02, 1e-3, 1 / 3, 1e-9))
    return SessionSetup(session=session, rig=rig, landmarks=landmarks, simulated=True)


def events_in(path: Path) -> list[RecordedEvent]:
    return [item for item in Recording(path).items() if isinstance(item, RecordedEvent)]


# Exact


def test_setup_survives_json_to_the_bit():
    setup = small_setup()
    again = setup_from_values(json.loads(json.dumps(setup_values(setup))), Path("/x/run.mcap"))
    assert again.landmarks == setup.landmarks and again.simulated
    assert again.rig.packed.tobytes() == setup.rig.packed.tobytes()
    assert again.rig.names == setup.rig.names
    assert again.session.settings.name == "small" and again.session.path == Path("/x/run.mcap")
    assert again.session.subjects[0].imus[0].bone == "head"


def test_recording_tells_no_folders_and_no_passwords():
    text = json.dumps(setup_values(small_setup()))
    assert "left.mp4" in text and "10.0.0.5" in text
    assert "secret" not in text and "hunter2" not in text


numbers = st.floats(allow_nan=True, allow_infinity=True)
times = st.integers(-(10**15), 10**15)


@settings(max_examples=30)
@given(
    people=st.integers(0, 2).flatmap(lambda n: arrays(np.float64, (n, 26, 3), elements=numbers)),
    orientation=arrays(np.float64, 4, elements=numbers),
    accel=arrays(np.float64, 3, elements=numbers),
    at_ns=times,
)
def test_any_sample_reads_back_to_the_same_bits(
    tmp_path_factory, people, orientation, accel, at_ns
):
    setup = small_setup()
    subject = setup.session.subjects[0].name
    events = [
        CameraSample(camera=1, timestamp_ns=at_ns, people=people),
        ImuSample(
            subject=subject,
            bone="head",
            timestamp_ns=at_ns,
            orientation_wxyz=orientation,
            accel_m_s2=accel,
        ),
        Command(kind=CommandKind.TPOSE, subject=subject),
        Tick(timestamp_ns=at_ns),
    ]
    path = tmp_path_factory.mktemp("any") / "any.mcap"
    with path.open("wb") as file:
        record(file, setup, [(event, None) for event in events])
    back = events_in(path)
    assert all(same_event(a, b.event) for a, b in zip(events, back, strict=True))
    assert [item.number for item in back] == [1, 2, 3, 4]


def test_events_read_back_in_the_order_of_the_run(run, whole):
    _, taken = run
    back = events_in(whole)
    assert len(back) == len(taken)
    assert all(same_event(event, item.event) for (event, _), item in zip(taken, back, strict=True))


def test_poses_read_back_to_the_same_bits(run, whole):
    recorded = [item for item in Recording(whole).items() if isinstance(item, RecordedPose)]
    sent = [
        person
        for _, step in run[1]
        if step is not None
        for person in step.people.values()
        if person is not None
    ]
    assert len(recorded) == len(sent) > 80
    for pose, estimate in zip(recorded, sent, strict=True):
        assert pose.name == estimate.name and pose.timestamp_ns == estimate.timestamp_ns
        assert pose.theta.tobytes() == estimate.theta.tobytes()
        assert pose.bone_sigma_deg.tobytes() == estimate.bone_sigma_deg.tobytes()
        assert pose.position_sigma_m.tobytes() == estimate.position_sigma_m.tobytes()


def test_poses_from_before_there_was_a_mark_count_as_measured():
    known = Known.of(setup_values(small_setup()))
    values = json.loads(pose_message(estimate_of(7)))
    assert not any(values["views"]), "sensors alone may have told"
    assert DECODERS[POSE](values, known)["measured"] is True
    assert DECODERS[POSE](values | {"measured": False}, known)["measured"] is False
    del values["measured"]
    assert DECODERS[POSE](values, known)["measured"] is True


# As others read it


def test_the_mcap_librarys_reader_finds_every_message(run, whole):
    _, taken = run
    with whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_messages())
    assert summary is not None and summary.statistics is not None
    counts = {
        summary.channels[channel].topic: count
        for channel, count in summary.statistics.channel_message_counts.items()
    }
    assert counts["/tick"] == sum(isinstance(event, Tick) for event, _ in taken)
    assert counts["/camera/cam1/keypoints"] > 50 and counts["/imu/anna/head"] > 50
    assert counts["/command"] == 1 and counts["/pose/anna"] > 40 and counts["/body/ben"] >= 1
    assert len(messages) == sum(counts.values())
    for schema, channel, message in messages:
        assert channel.message_encoding == "json" and schema is not None
        assert schema.encoding == "jsonschema"
        values = json.loads(message.data, parse_constant=pytest.fail)
        described = json.loads(schema.data)
        known = set(described["properties"])
        assert set(described.get("required", known)) <= set(values) <= known
        if channel.topic.startswith(("/imu", "/camera", "/tick")):
            assert message.publish_time == values["timestamp_ns"] + UNIX_NS


def test_scene_stands_upright_where_z_is_up(tmp_path):
    setup = small_setup()
    path = tmp_path / "scene.mcap"
    estimate = estimate_of(SECOND_NS)
    with path.open("wb") as file:
        writer = RecordingWriter(
            file, setup_values(setup), cameras=setup.rig.names, unix_minus_session_ns=UNIX_NS
        )
        writer.poses([estimate], SECOND_NS)
        writer.poses([estimate], SECOND_NS + 50_000_000)
        writer.finish()
    with path.open("rb") as file:
        scenes = [
            (schema, json.loads(message.data))
            for schema, channel, message in make_reader(file).iter_messages(topics="/scene")
        ]
    assert len(scenes) == 1, "ten a second at most"
    schema, scene = scenes[0]
    assert schema is not None and schema.name == "foxglove.SceneUpdate"
    entity = scene["entities"][0]
    assert entity["id"] == "anna" and entity["timestamp"] == {"sec": 1_700_000_001, "nsec": 0}
    line = entity["lines"][0]
    assert line["type"] == 2 and len(line["indices"]) == 2 * (len(line["points"]) - 1)
    for point, position in zip(line["points"], estimate.bone_position_in_world_m, strict=True):
        assert [point["x"], point["z"], -point["y"]] == pytest.approx(position, abs=1e-4)


@pytest.mark.parametrize("options", [{"use_chunking": False}, {"enable_crcs": False}])
def test_a_log_that_another_tool_has_rewritten_still_reads(run, short, tmp_path, options):
    path = tmp_path / "rewritten.mcap"
    channels: dict[int, int] = {}
    with short.open("rb") as source, path.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, **options)
        writer.start()
        for found in reader.iter_metadata():
            writer.add_metadata(found.name, found.metadata)
        for schema, channel, found in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if channel.id not in channels:
                made = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "json", made)
            writer.add_message(
                channels[channel.id],
                found.log_time,
                found.data,
                found.publish_time,
                found.sequence,
            )
        writer.finish()
    back = events_in(path)
    assert all(
        same_event(event, item.event) for (event, _), item in zip(run[1][:400], back, strict=True)
    )


# Damage


@settings(max_examples=60)
@given(share=st.floats(0, 1))
def test_a_file_cut_anywhere_opens_with_what_came_before(run, short, tmp_path_factory, share):
    content = short.read_bytes()
    path = tmp_path_factory.mktemp("cut") / "cut.mcap"
    path.write_bytes(content[: int(share * len(content))])
    try:
        recording = Recording(path)
    except InputError:
        assert int(share * len(content)) < len(header_of(short))
        return
    back = [item for item in recording.items() if isinstance(item, RecordedEvent)]
    taken = [event for event, _ in run[1]]
    assert all(same_event(a, item.event) for a, item in zip(taken, back, strict=False))
    assert recording.loss.missing_events == 0
    assert recording.loss.unread_bytes >= 0


places = st.floats(0, 1, exclude_max=True)


@settings(max_examples=100)
@given(
    flips=st.lists(st.tuples(places, st.booleans(), st.integers(1, 255)), min_size=1, max_size=4)
)
def test_flipped_bytes_lose_data_but_never_change_it(run, short, tmp_path_factory, flips):
    content = bytearray(short.read_bytes())
    end = content.index(b"fusecap end") - 20
    in_the_end = False
    for share, last, bits in flips:
        at = end + int(60 * share) if last else int(len(content) * share)
        content[at] ^= bits
        in_the_end = in_the_end or at >= end
    path = tmp_path_factory.mktemp("flip") / "flip.mcap"
    path.write_bytes(content)
    try:
        recording = Recording(path)
        back = [item for item in recording.items() if isinstance(item, RecordedEvent)]
    except InputError:
        return
    taken = [event for event, _ in run[1][:400]]
    assert all(same_event(taken[item.number - 1], item.event) for item in back)
    if recording.loss.finished and not in_the_end:
        assert recording.loss.missing_events == len(taken) - len(back)


@settings(max_examples=100)
@given(tail=st.binary(max_size=400))
def test_garbage_after_the_header_is_survived(whole, tmp_path_factory, tail):
    path = tmp_path_factory.mktemp("garbage") / "garbage.mcap"
    path.write_bytes(header_of(whole) + tail)
    assert list(Recording(path).items()) == []


def header_of(path: Path) -> bytes:
    """Everything before the first chunk."""
    content = path.read_bytes()
    at = 8
    while content[at] != Opcode.CHUNK:
        at += 9 + struct.unpack_from("<Q", content, at + 1)[0]
    return content[:at]


def chunk_record(data: bytes, size: int, crc: int = 0) -> bytes:
    content = struct.pack("<QQQII", 0, 0, size, crc, 4) + b"zstd" + struct.pack("<Q", len(data))
    return struct.pack("<BQ", Opcode.CHUNK, len(content) + len(data)) + content + data


@pytest.mark.parametrize("length", [2**63, 2**40, 2**64 - 1])
def test_a_record_longer_than_the_file_ends_the_reading(whole, tmp_path, length):
    path = tmp_path / "long.mcap"
    path.write_bytes(header_of(whole) + struct.pack("<BQ", Opcode.CHUNK, length) + b"xyz")
    recording = Recording(path)
    assert list(recording.items()) == [] and recording.loss.unread_bytes == 12


def test_many_chunks_that_unpack_to_far_more_than_the_file_are_refused(
    whole, tmp_path, monkeypatch
):
    monkeypatch.setattr(reader, "MAX_BYTES", 1 << 20)
    bomb = chunk_record(zstandard.compress(bytes(1 << 18)), 1 << 18)
    path = tmp_path / "bombs.mcap"
    path.write_bytes(header_of(whole) + bomb * 60)
    with pytest.raises(InputError, match="unpacks to more than"):
        list(Recording(path).items())


def test_a_chunk_that_would_unpack_to_terabytes_is_left_out(whole, tmp_path):
    bomb = zstandard.compress(bytes(1 << 20))
    absurd = bytearray(bomb)
    assert zstandard.get_frame_parameters(bytes(absurd)).content_size == 1 << 20
    at = bomb.index(struct.pack("<I", 1 << 20))
    absurd[at : at + 4] = struct.pack("<I", 0xFFFFFFFF)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(
        header_of(whole)
        + chunk_record(bomb, 2**62)
        + chunk_record(bytes(absurd), 100)
        + chunk_record(bomb, 100)
    )
    recording = Recording(path)
    assert list(recording.items()) == [] and recording.loss.broken_chunks == 3


def message(schema: str, values: object, number: int) -> bytes:
    """A chunk's content: one schema, one channel, one message."""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    def one(opcode: int, content: bytes) -> bytes:
        return struct.pack("<BQ", opcode, len(content)) + content

    described = struct.pack("<H", 1) + text(schema) + text("jsonschema") + text("{}")
    channel = struct.pack("<HH", 1, 1) + text("/x") + text("json") + struct.pack("<I", 0)
    content = struct.pack("<HIQQ", 1, number, 0, 0) + json.dumps(values).encode()
    data = one(3, described) + one(4, channel) + one(5, content)
    return chunk_record(zstandard.compress(data), len(data), zlib.crc32(data))


@pytest.mark.parametrize(
    ("schema", "values"),
    [
        ("fusecap.Tick", {"timestamp_ns": 2**70}),
        ("fusecap.Tick", {"timestamp_ns": "soon"}),
        ("fusecap.Tick", [1]),
        ("fusecap.Tick", {}),
        ("fusecap.Keypoints", {"camera": 9, "timestamp_ns": 0, "people": []}),
        ("fusecap.Keypoints", {"camera": 0, "timestamp_ns": 0, "people": [[[1, 2, 3]]]}),
        ("fusecap.Keypoints", {"camera": 0, "timestamp_ns": 0, "people": [[1], [1, 2]]}),
        ("fusecap.Keypoints", {"camera": 0, "timestamp_ns": 0, "people": "everyone"}),
        ("fusecap.Imu", {"subject": "eve", "bone": "head", "timestamp_ns": 0}),
        ("fusecap.Imu", {"subject": ["a"], "bone": {}, "timestamp_ns": 0}),
        ("fusecap.Command", {"kind": "format_disk", "subject": ""}),
        ("fusecap.Pose", {"name": "anna", "timestamp_ns": 0, "theta": [1], "bone_sigma_deg": []}),
        ("fusecap.Body", {"name": "anna", "height_m": "x", "offsets_m": []}),
        ("fusecap.Body", {"name": "anna", "height_m": 1.0, "offsets_m": [[1, 2, 3]]}),
    ],
)
def test_messages_that_do_not_fit_are_counted(whole, tmp_path, schema, values):
    path = tmp_path / "odd.mcap"
    path.write_bytes(
        header_of(whole)
        + message(schema, values, 1)
        + message("fusecap.Tick", {"timestamp_ns": 7}, 2)
    )
    recording = Recording(path)
    items = list(recording.items())
    assert [item.event.timestamp_ns for item in items if isinstance(item, RecordedEvent)] == [7]
    assert recording.loss.malformed == 1 and recording.loss.missing_events == 1


def test_deeply_nested_json_is_one_malformed_message(whole, tmp_path):
    path = tmp_path / "deep.mcap"
    deep = message("fusecap.Tick", 0, 1)
    data = b"[" * 200_000
    one = struct.pack("<HIQQ", 1, 1, 0, 0) + data
    described = zstandard.decompress(deep[9 + 32 + 4 + 8 :], 1000)
    start = described[: described.index(b"\x05" + struct.pack("<Q", 23))]
    content = start + struct.pack("<BQ", 5, len(one)) + one
    packed = chunk_record(zstandard.compress(content), len(content), zlib.crc32(content))
    path.write_bytes(header_of(whole) + packed)
    recording = Recording(path)
    assert list(recording.items()) == [] and recording.loss.malformed == 1


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is not an MCAP log"),
        (b"PK\x03\x04" + bytes(100), "is not an MCAP log"),
        (b"\x89MCAP0\r\n", "holds no recording of fusecap"),
    ],
)
def test_other_files_are_refused(tmp_path, content, says):
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says):
        Recording(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file; expected a recording"):
        Recording(tmp_path / "none.mcap")
    with pytest.raises(InputError, match="is a folder"):
        Recording(tmp_path)


def test_a_later_format_says_so(whole, tmp_path):
    path = tmp_path / "later.mcap"
    path.write_bytes(whole.read_bytes().replace(b"fusecap recording 1", b"fusecap recording 2", 1))
    with pytest.raises(InputError, match=r"'fusecap recording 2'.*update fusecap"):
        Recording(path)


def test_a_damaged_setup_is_refused(whole, tmp_path):
    path = tmp_path / "damaged.mcap"
    path.write_bytes(whole.read_bytes().replace(b'"size_px": [1', b'"size_px": [2', 1))
    with pytest.raises(InputError, match=r"header is damaged.*checksum"):
        Recording(path)


def test_a_strangers_setup_is_refused_in_one_line():
    values = setup_values(small_setup())
    for key, wrong in (
        ("rig", [[]]),
        ("rig", [{"name": "cam0", "size_px": [1]}]),
        ("rig", [values["rig"][0] | {"matrix": [1, 2]}]),
        ("rig", [values["rig"][0] | {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}]),
        ("landmarks", {}),
        ("landmarks", values["landmarks"] | {"landmark_names": ["hose"]}),
        ("landmarks", values["landmarks"] | {"offsets": {"everyone": {"nose": [1]}}}),
        ("session", {"session": {"name": "x", "rate_hz": -1}}),
        ("session", "all of it"),
    ):
        with pytest.raises(InputError) as refused:
            setup_from_values(values | {key: wrong}, Path("run.mcap"))
        assert "\n" not in str(refused.value)


# The recorder's thread


class Disk:
    """A file that takes `room` bytes, or waits until it is told to go on."""

    def __init__(self, path: Path, room: int | None = None) -> None:
        self.room = room
        self.stalled = False
        self._file = path.open("xb")

    def write(self, data: bytes) -> int:
        wait_for(lambda: not self.stalled)
        if self.room is not None and self._file.tell() + len(data) > self.room:
            self._file.write(data[: max(0, self.room - self._file.tell())])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._file.write(data)

    def __getattr__(self, name):
        return getattr(self._file, name)


@pytest.fixture
def clock():
    return SessionClock()


def test_what_a_recorder_was_told_is_in_its_file(run, tmp_path, clock):
    setup, taken = run
    recorder = Recorder(tmp_path / "new" / "run.mcap", setup, clock)
    for event, step in taken:
        recorder.on_event(event, clock.now_ns())
        if step is not None:
            recorder.on_step(step, clock.now_ns())
    recorder.close()
    recording = Recording(recorder.path)
    back = [item for item in recording.items() if isinstance(item, RecordedEvent)]
    assert len(back) == len(taken) and recording.loss.finished and recording.from_start
    assert recorder.status().problem == "" and recorder.status().megabytes > 0.1


def test_a_full_disk_ends_the_recording_and_nothing_else(run, tmp_path, clock):
    setup, taken = run
    said: list[str] = []
    recorder = Recorder(
        tmp_path / "full.mcap",
        setup,
        clock,
        report=said.append,
        open_file=lambda path: Disk(path, room=150_000),
    )
    for event, step in taken:
        recorder.on_event(event, clock.now_ns())
        if step is not None:
            recorder.on_step(step, clock.now_ns())
    wait_for(lambda: recorder.status().problem)
    recorder.on_event(taken[0][0], clock.now_ns())
    recorder.close()
    assert "No space left on device" in recorder.status().problem
    assert len(said) == 1 and "what was written until then is kept" in said[0]
    recording = Recording(recorder.path)
    list(recording.items())
    assert not recording.loss.finished and recording.loss.missing_events == 0


def test_a_disk_that_stalls_loses_pictures_first_and_then_ends(run, tmp_path, clock, monkeypatch):
    monkeypatch.setattr("fusecap.live.recorder.QUEUE_BYTES", 400_000)
    monkeypatch.setattr("fusecap.live.recorder.IMAGE_BYTES", 200_000)
    setup, taken = run
    disks: list[Disk] = []

    def open_file(path: Path) -> Disk:
        disks.append(Disk(path))
        return disks[-1]

    recorder = Recorder(tmp_path / "slow.mcap", setup, clock, images=True, open_file=open_file)
    disks[0].stalled = True
    picture = CameraImage(camera=0, timestamp_ns=0, image=np.zeros((100, 100, 3), np.uint8))
    count = 0
    while not recorder.status().problem:
        recorder.on_event(taken[count][0], clock.now_ns())
        recorder.on_image(picture)
        count += 1
    disks[0].stalled = False
    recorder.close()
    assert recorder.images_left_out > 0
    assert "too slow" in recorder.status().problem
    recording = Recording(recorder.path)
    back = [item for item in recording.items() if isinstance(item, RecordedEvent)]
    assert len(back) < count and recording.loss.missing_events == 0
    assert "too slow" in recording.loss.note and recording.loss.finished


def test_a_deleted_file_is_noticed(run, tmp_path, clock, monkeypatch):
    monkeypatch.setattr("fusecap.live.recorder.LOOK_S", 0.0)
    recorder = Recorder(tmp_path / "gone.mcap", run[0], clock)
    recorder.path.unlink()
    wait_for(lambda: recorder.status().problem)
    recorder.close()
    assert "moved or deleted" in recorder.status().problem


def test_a_disk_that_fills_is_announced(run, tmp_path, clock, monkeypatch):
    monkeypatch.setattr("fusecap.live.recorder.LOOK_S", 0.0)
    monkeypatch.setattr("fusecap.live.recorder.WARN_MINUTES", 1e12)
    said: list[str] = []
    recorder = Recorder(tmp_path / "room.mcap", run[0], clock, report=said.append)
    wait_for(lambda: said)
    recorder.close()
    assert len(said) == 1 and "MB left" in said[0] and recorder.status().problem == ""


def test_no_recording_is_begun_where_it_cannot_be(run, tmp_path, clock, monkeypatch):
    (tmp_path / "there.mcap").write_bytes(b"precious")
    with pytest.raises(InputError, match="exists; choose another name"):
        Recorder(tmp_path / "there.mcap", run[0], clock)
    assert (tmp_path / "there.mcap").read_bytes() == b"precious"
    with pytest.raises(InputError, match="cannot write"):
        Recorder(tmp_path / "there.mcap" / "x.mcap", run[0], clock)
    monkeypatch.setattr("fusecap.live.recorder.MIN_FREE_BYTES", 10**18)
    with pytest.raises(InputError, match="MB left, expected"):
        Recorder(tmp_path / "small.mcap", run[0], clock)


def test_pictures_are_recorded_as_jpeg(run, tmp_path, clock):
    recorder = Recorder(tmp_path / "seen.mcap", run[0], clock, images=True)
    picture = np.full((48, 64, 3), (10, 200, 60), np.uint8)
    recorder.on_image(CameraImage(camera=2, timestamp_ns=5, image=picture))
    recorder.close()
    import base64

    import cv2

    with recorder.path.open("rb") as file:
        schema, channel, found = next(iter(make_reader(file).iter_messages()))
    assert channel.topic == "/camera/cam3/image"
    assert schema is not None and schema.name == "foxglove.CompressedImage"
    jpeg = np.frombuffer(base64.b64decode(json.loads(found.data)["data"]), np.uint8)
    back = cv2.imdecode(jpeg, cv2.IMREAD_COLOR)
    assert back is not None and np.abs(back.astype(int) - picture).max() < 8


# Killed

RECORD_UNTIL_KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from fusecap.live.recorder import Recorder
from fusecap.live.devices.source import SessionClock
from recorded_run import simulated_run

folder = Path(sys.argv[1])
setup, taken = simulated_run(folder / "session", seconds=4.0)
clock = SessionClock()
recorder = Recorder(folder / "killed.mcap", setup, clock)
start_ns = None
for event, step in taken:
    at_ns = getattr(event, "timestamp_ns", 0)
    start_ns = clock.now_ns() - at_ns if start_ns is None else start_ns
    time.sleep(max(0.0, 1e-9 * (start_ns + at_ns - clock.now_ns())))
    recorder.on_event(event, clock.now_ns())
    if step is not None:
        recorder.on_step(step, clock.now_ns())
        print(clock.now_ns(), flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
def test_a_killed_run_loses_at_most_its_last_second(tmp_path, rng):
    process = subprocess.Popen(
        [sys.executable, "-c", RECORD_UNTIL_KILLED, tmp_path, Path(__file__).parent],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    instants = int(rng.integers(90, 220))
    last_ns = [int(process.stdout.readline()) for _ in range(instants)][-1]
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    recording = Recording(tmp_path / "killed.mcap")
    back = [item for item in recording.items() if isinstance(item, RecordedEvent)]
    assert not recording.loss.finished and recording.loss.missing_events == 0
    assert last_ns - back[-1].arrival_ns <= SECOND_NS
    with recording.path.open("rb") as file:
        found = 0
        with contextlib.suppress(EndOfFile, struct.error):
            for _ in StreamReader(file).records:
                found += 1
    assert found > len(back)


def records_by_hand(data: bytes) -> list[tuple[int, ...]]:
    """As `find_records` has them, by struct."""
    found, at = [], 0
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        at += 9
        if length > len(data) - at or (opcode == 5 and length < 22):
            break
        told = struct.unpack_from("<HIQQ", data, at) if opcode == 5 else (0, 0, 0, 0)
        found.append((opcode, at, at + length, *told))
        at += length
    return found


@given(
    records=st.lists(
        st.tuples(
            st.sampled_from([3, 4, 5, 5, 5, 7]),
            st.binary(max_size=60),
            st.sampled_from([0, 0, 0, 0, 1, -1, 1 << 63]),
        )
    ),
    tail=st.binary(max_size=30),
)
def test_records_are_found_as_struct_finds_them(records, tail):
    data = b"".join(
        struct.pack("<BQ", opcode, max(len(content) + off, 0)) + content
        for opcode, content, off in records
    )
    data = np.frombuffer(data + tail, np.uint8)
    rows = np.zeros((100, COLUMNS), np.int64)
    count = find_records(data, 5, 22, rows)
    expected = np.array(records_by_hand(bytes(data)), np.uint64).reshape(-1, COLUMNS)
    assert count == len(expected)
    assert (rows[:count].view(np.uint64) == expected).all() and not rows[count:].any()


# The index that a finished recording tells


def places(index: RecordingIndex) -> dict[str, list[tuple[int, int, int]]]:
    of_all = index.poses | index.keypoints
    return {
        name: [(*some.at(row), some.times_ns[row]) for row in range(len(some.times_ns))]
        for name, some in of_all.items()
    }


def test_what_a_recording_tells_is_what_is_found_in_it(whole, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[:-1])
    told, found = (RecordingIndex(Recording(path), keypoints_hz=10) for path in (whole, cut))
    assert told_by(whole) is not None and told_by(cut) is None
    assert places(told) == places(found) and len(places(told)) > 4
    assert {name: body.height_m for name, body in told.bodies.items()} == {
        name: body.height_m for name, body in found.bodies.items()
    }


def test_a_recording_of_another_tool_tells_nothing(short, tmp_path):
    """Its index lacks the times; that of ours with other counts of events is not believed."""
    data = short.read_bytes()
    for spoilt in (
        data.replace(b"fusecap times /", b"fusecap tunes /"),
        data.replace(b"events", b"evints"),
    ):
        path = tmp_path / "other.mcap"
        path.write_bytes(spoilt)
        assert spoilt != data and told_by(path) is None
        assert places(RecordingIndex(Recording(path))) == places(RecordingIndex(Recording(short)))


def test_a_spoilt_index_never_shows_another_pose(short, tmp_path):
    """Bytes of the end changed, with its checksum made right: a pose is what it was, or gone."""
    data = short.read_bytes()
    right = RecordingIndex(Recording(short))
    poses = {
        (name, pose.timestamp_ns): pose.theta.tobytes()
        for name, some in right.poses.items()
        for pose in (right.read(some, row) for row in range(len(some.times_ns)))
        if isinstance(pose, RecordedPose)
    }
    (summary_at,) = struct.unpack_from("<Q", data, len(data) - 28)
    index_at = data.index(bytes([Opcode.MESSAGE_INDEX]) + struct.pack("<Q", 6 + 16))
    rng = np.random.default_rng(0)
    believed = 0
    for trial in range(150):
        spoilt = bytearray(data)
        low, high = ((summary_at, len(data) - 37), (index_at, summary_at))[trial % 2]
        for at in rng.integers(low, high, 3):
            spoilt[at] = rng.integers(256)
        summary = bytes(spoilt[summary_at:-8])
        spoilt[-12:-8] = struct.pack("<I", zlib.crc32(summary[:-4]))
        path = tmp_path / "spoilt.mcap"
        path.write_bytes(spoilt)
        believed += told_by(path) is not None
        try:
            index = RecordingIndex(Recording(path))
        except InputError:
            continue
        for name, some in index.poses.items():
            for row in range(len(some.times_ns)):
                pose = index.read(some, row)
                if isinstance(pose, RecordedPose):
                    assert poses[name, pose.timestamp_ns] == pose.theta.tobytes()
    assert 20 < believed < 140


def test_an_index_that_is_named_again_and_again_is_not_read_as_often(short, tmp_path):
    data = short.read_bytes()
    (summary_at,) = struct.unpack_from("<Q", data, len(data) - 28)
    rows = records_by_hand(data[summary_at:-37])
    _, first, end, *_ = next(row for row in rows if row[0] == Opcode.CHUNK_INDEX)
    copies = data[summary_at + first - 9 : summary_at + end] * 20_000
    bomb = data[summary_at:-37] + copies + data[-37:-12]
    path = tmp_path / "bomb.mcap"
    path.write_bytes(data[:summary_at] + bomb + struct.pack("<I", zlib.crc32(bomb)) + data[-8:])
    assert told_by(path) is None
    assert places(RecordingIndex(Recording(path))) == places(RecordingIndex(Recording(short)))


def test_times_beyond_any_clock_are_survived(whole, tmp_path):
    packed = message("fusecap.Pose", {"name": "anna"}, 1)
    data = zstandard.decompress(packed[9 + 32 + 4 + 8 :], 1000)
    late = data.replace(struct.pack("<HIQQ", 1, 1, 0, 0), struct.pack("<HIQQ", 1, 1, 0, 2**64 - 1))
    assert late != data
    path = tmp_path / "late.mcap"
    packed = chunk_record(zstandard.compress(late), len(late), zlib.crc32(late))
    path.write_bytes(header_of(whole) + packed)
    recording = Recording(path)
    assert not RecordingIndex(recording).poses and recording.loss.malformed == 1


def one_record(opcode: int, *content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, sum(map(len, content))) + b"".join(content)


def texts(*values: str) -> bytes:
    return b"".join(struct.pack("<I", len(value)) + value.encode() for value in values)


SCHEMA = one_record(3, struct.pack("<H", 1), texts("fusecap.Pose", "jsonschema", "{}"))


def channel(number: int) -> bytes:
    about = texts("/pose/anna", "json"), struct.pack("<I", 0)
    return one_record(4, struct.pack("<HH", number, 1), *about)


def moment(number: int, at_ns: int) -> bytes:
    return one_record(5, struct.pack("<HIQQ", number, 1, 0, UNIX_NS + at_ns), b"{}")


def indexed(whole: Path, path: Path, *records: bytes) -> tuple[RecordingIndex, Recording]:
    data = b"".join(records)
    packed = chunk_record(zstandard.compress(data), len(data), zlib.crc32(data))
    path.write_bytes(header_of(whole) + packed)
    recording = Recording(path)
    return RecordingIndex(recording), recording


def test_two_channels_of_one_topic_are_one_in_their_order(whole, tmp_path):
    records = [SCHEMA, channel(1), channel(2), *(moment(1 + n % 2, n) for n in range(6))]
    index, _ = indexed(whole, tmp_path / "two.mcap", *records)
    assert index.poses["anna"].times_ns.tolist() == [*range(6)]


def test_a_broken_channel_loses_none_of_the_others_messages(whole, tmp_path):
    broken = one_record(4, struct.pack("<HH", 2, 1), struct.pack("<I", 1 << 30))
    records = SCHEMA, channel(1), broken, moment(1, 5), moment(1, 6)
    index, recording = indexed(whole, tmp_path / "broken.mcap", *records)
    assert index.poses["anna"].times_ns.tolist() == [5, 6]
    assert recording.loss.malformed == 1 and not recording.loss.broken_chunks
