import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fusecap.batch.detect import (
    ExpectedPeople,
    detect_videos,
    detector_options,
    loose_videos,
    session_videos,
    video_setup,
)
from fusecap.batch.overlay import draw_overlays
from fusecap.body.landmarks import landmark_set_named
from fusecap.cli import app
from fusecap.detect.build import build_detector
from fusecap.detect.detector import DetectorOptions
from fusecap.errors import InputError, SessionError
from fusecap.exports.overlay import PeopleNumbers
from fusecap.setup import setup_of
from fusecap.sources.detection_files import read_record
from fusecap.sources.keypoint_files import read_keypoints
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_data import content_hash, open_session
from fusecap.sources.session_file import load_session
from fusecap.sources.video import Video, probe
from session_files import calibration_toml, edit, ring, walking_landmarks
from tiny_networks import constant_network
from video_files import number_of, stripe, write_video

COCO = landmark_set_named("coco17")


class NumberReader:
    """Finds one person whose keypoints lie at x = the frame's number; nobody in frame 3."""

    landmarks = COCO

    def __init__(self, identity="reader 1", stop_after=None):
        self.identity = identity
        self.calls = 0
        self.resets = 0
        self.predicted = []
        self._stop_after = stop_after

    def detect(self, images, predicted):
        self.calls += 1
        if self.calls == self._stop_after:
            signal.raise_signal(signal.SIGINT)
        self.predicted.append([len(some) for some in predicted])
        return tuple(self._people(image) for image in images)

    def reset(self):
        self.resets += 1

    def _people(self, image):
        if image is None or number_of(image) == 3:
            return np.empty((0, 17, 3))
        person = np.column_stack([np.full(17, number_of(image) + 1.5), np.arange(17) + 1.0])
        person = np.column_stack([person, np.full(17, 0.8)])
        person[16] = [np.nan, np.nan, 0.0]
        return person[None]


def two_videos(folder):
    folder.mkdir(exist_ok=True)
    a = write_video(folder / "a.mp4", 12, rate_hz=30)
    b = write_video(folder / "b.mp4", 24, rate_hz=60)
    return loose_videos([a, b], folder / "keypoints")


def track(camera):
    return read_keypoints(camera.folder, name=camera.name, landmarks=COCO, rate_hz=1.0)


def read_numbers(camera):
    return [None if len(p) == 0 else round(p[0, 0, 0] - 1.5) for p in track(camera).people]


def test_every_frame_of_every_camera_gets_its_keypoints(tmp_path):
    cameras = two_videos(tmp_path)
    shown = []
    found = detect_videos(cameras, NumberReader(), progress=lambda *step: shown.append(step))
    expected = [n if n != 3 else None for n in range(24)]
    assert read_numbers(cameras[0]) == expected[:12] and read_numbers(cameras[1]) == expected
    assert found.frames_detected == 36 and not found.interrupted
    assert shown[-1] == ("detecting frames", 36, 36)
    assert found.cameras["b"].people_per_frame == pytest.approx(23 / 24)
    assert found.cameras["b"].mean_confidence == pytest.approx(0.8)
    person = track(cameras[0]).people[0][0]
    assert np.isnan(person[16, 0]) and person[16, 2] == 0 and person[4].tolist() == [1.5, 5.0, 0.8]
    record = read_record(cameras[1].folder)
    assert record is not None and record.complete and record.video.name == "b.mp4"
    assert record.times_ns.tolist() == cameras[1].video.times_ns.tolist()
    assert json.dumps(found.as_json())


def test_without_a_calibration_people_are_expected_where_they_were(tmp_path):
    detector = NumberReader()
    detect_videos(two_videos(tmp_path), detector)
    # b's frames 0 to 4: nobody known, then one; frame 3 is empty.
    assert [counts[1] for counts in detector.predicted[:5]] == [0, 1, 1, 1, 0]
    assert detector.resets == 1


def test_second_run_detects_nothing(tmp_path):
    cameras = two_videos(tmp_path)
    first = detect_videos(cameras, NumberReader())
    again = NumberReader()
    second = detect_videos(cameras, again)
    assert again.calls == 0 and second.frames_detected == 0
    assert second.cameras == first.cameras
    assert second.as_json()["frames_per_s"] is None


def test_interrupted_run_is_valid_and_goes_on_with_its_block(tmp_path):
    cameras = two_videos(tmp_path)
    found = detect_videos(cameras, NumberReader(stop_after=7))
    assert found.interrupted and found.frames_detected == 11
    assert read_numbers(cameras[1]) == [0, 1, 2, None, 4, 5, 6]
    record = read_record(cameras[1].folder)
    assert record is not None and not record.complete
    rest = NumberReader()
    assert detect_videos(cameras, rest).frames_detected == 25
    assert rest.calls == 24 and rest.resets == 1
    whole = two_videos(tmp_path / "whole")
    detect_videos(whole, NumberReader())
    for camera, other in zip(cameras, whole, strict=True):
        for path in camera.folder.glob("*_keypoints.json"):
            assert path.read_text() == (other.folder / path.name).read_text()


def drifting_detector(folder):
    """Where it finds someone depends on where it found them before, until boxes are found anew."""
    heatmaps = np.zeros((1, 17, 32, 24), np.float32)
    rng = np.random.default_rng(3)
    heatmaps[0, np.arange(17), rng.integers(4, 30, 17), rng.integers(4, 22, 17)] = 0.9
    pose = constant_network(folder / "pose.onnx", ("n", 3, 128, 96), {"maps": heatmaps})
    boxes = {
        "dets": np.array([[[100.5, 80.5, 500.5, 400.5, 0.9]]]),
        "labels": np.zeros((1, 1), np.int64),
    }
    person = constant_network(folder / "rtmdet.onnx", (1, 3, 640, 640), boxes)
    options = DetectorOptions(model=str(pose), person_model=str(person), person_every=5)
    return build_detector(options, threads=1)


@pytest.mark.parametrize("stop_after", [3, 13, 30])
def test_interrupted_and_resumed_is_the_same_as_uninterrupted(tmp_path, monkeypatch, stop_after):
    monkeypatch.setattr("fusecap.batch.detect.BLOCK_INSTANTS", 8)
    detector = drifting_detector(tmp_path)

    asked = []

    def stop(what, done, total):
        if what == "detecting frames" and done >= stop_after and not asked:
            asked.append(done)
            signal.raise_signal(signal.SIGINT)

    whole = two_videos(tmp_path / "whole")
    # Copies, for x264 makes other bytes of the same pictures now and then, and records name them.
    copied = shutil.copytree(tmp_path / "whole", tmp_path / "stopped")
    stopped = loose_videos([copied / "a.mp4", copied / "b.mp4"], copied / "keypoints")
    detect_videos(whole, detector)
    assert detect_videos(stopped, detector, progress=stop).interrupted
    (stopped[1].folder / "b_000000000001_keypoints.json").unlink()
    assert not detect_videos(stopped, detector).interrupted
    for camera, other in zip(stopped, whole, strict=True):
        names = [path.name for path in sorted(camera.folder.glob("*.json"))]
        assert names == [path.name for path in sorted(other.folder.glob("*.json"))]
        texts = [(camera.folder / name).read_text() for name in names[1:]]
        assert texts == [(other.folder / name).read_text() for name in names[1:]]
        assert len(set(texts)) > 3


def test_frame_lost_in_the_middle_is_detected_again_alone(tmp_path):
    cameras = two_videos(tmp_path)
    detect_videos(cameras, NumberReader())
    (cameras[1].folder / "b_000000000009_keypoints.json").unlink()
    detector = NumberReader()
    assert detect_videos(cameras, detector).frames_detected == 1
    assert read_numbers(cameras[1])[9] == 9


@pytest.mark.parametrize("change", ["detector", "video"])
def test_another_detector_or_video_starts_over(tmp_path, change):
    cameras = two_videos(tmp_path)
    detect_videos(cameras, NumberReader())
    identity = "reader 2" if change == "detector" else "reader 1"
    if change == "video":
        write_video(tmp_path / "b.mp4", 10, rate_hz=60, picture=lambda n: stripe(n + 50))
        cameras = loose_videos([tmp_path / "a.mp4", tmp_path / "b.mp4"], tmp_path / "keypoints")
    found = detect_videos(cameras, NumberReader(identity))
    assert found.frames_detected == (36 if change == "detector" else 10)
    if change == "video":
        assert read_numbers(cameras[1]) == list(range(50, 60))


def test_keypoints_of_others_are_never_overwritten(tmp_path):
    cameras = two_videos(tmp_path)
    cameras[1].folder.mkdir(parents=True)
    (cameras[1].folder / "b_000000000000_keypoints.json").write_text("mine")
    with pytest.raises(InputError, match="holds files that fusecap did not write"):
        detect_videos(cameras, NumberReader())
    assert (cameras[1].folder / "b_000000000000_keypoints.json").read_text() == "mine"


def test_what_a_killed_start_left_is_no_obstacle(tmp_path):
    cameras = two_videos(tmp_path)
    cameras[0].folder.mkdir(parents=True)
    (cameras[0].folder / ".detection.json.77.part").write_text("{")
    assert detect_videos(cameras, NumberReader()).frames_detected == 36


def test_times_of_a_variable_rate_survive(tmp_path):
    times_s = np.cumsum([0.0, 0.033, 0.1, 0.017, 0.2, 0.033])
    path = write_video(tmp_path / "a.mkv", 6, times_s=times_s)
    cameras = loose_videos([path], tmp_path / "keypoints")
    detect_videos(cameras, NumberReader())
    assert track(cameras[0]).times_s == pytest.approx(times_s, abs=1e-9)
    given = read_keypoints(
        cameras[0].folder, name="a", landmarks=COCO, rate_hz=10.0, own_times=False
    )
    assert given.times_s == pytest.approx(np.arange(6) / 10)


def test_rounded_times_of_a_constant_rate_are_taken_as_constant(tmp_path):
    path = write_video(tmp_path / "a.mkv", 10, rate_hz=60)
    assert np.ptp(np.diff(Video(path).times_ns)) > 0
    cameras = loose_videos([path], tmp_path / "keypoints")
    detect_videos(cameras, NumberReader())
    assert track(cameras[0]).times_s == pytest.approx(np.arange(10) / 60, abs=1e-12)


def test_broken_record_says_what_to_do(tmp_path):
    cameras = two_videos(tmp_path)
    cameras[0].folder.mkdir(parents=True)
    (cameras[0].folder / "detection.json").write_text('{"format": "fusecap keypoints 1"')
    with pytest.raises(InputError, match="delete the folder and detect again"):
        detect_videos(cameras, NumberReader())


def test_overlay_shows_every_frame(tmp_path):
    cameras = two_videos(tmp_path)[:1]
    detect_videos(cameras, NumberReader())
    (path,) = draw_overlays(cameras, COCO).files
    info = probe(path)
    assert path.name == "a_overlay.mp4" and info.frames == 12 and info.rate_hz == 30.0
    assert info.size_px == (64, 48)


def test_people_keep_their_numbers():
    body = np.column_stack([np.zeros(17), np.linspace(0, 100, 17), np.full(17, 0.9)])
    left, right = body + [100, 0, 0], body + [300, 0, 0]
    numbers = PeopleNumbers()
    assert numbers.update(np.stack([left, right])) == [1, 2]
    assert numbers.update(np.stack([right + [5, 0, 0], left - [5, 0, 0]])) == [2, 1]
    assert numbers.update(np.empty((0, 17, 3))) == []
    assert numbers.update(np.stack([left, body + [700, 0, 0]])) == [1, 3]


# Sessions


def video_session(folder, frames=12, size=(64, 48)):
    """Two cameras of a ring with a video each."""
    rig = ring(2)
    folder.mkdir(exist_ok=True)
    text = '[session]\nname = "test"\ncalibration = "calibration.toml"\n'
    for camera in rig.cameras:
        write_video(
            folder / f"{camera.name}.mp4", frames, rate_hz=25, picture=lambda n: stripe(n, size)
        )
        text += f'\n[[camera]]\nname = "{camera.name}"\nvideo = "{camera.name}.mp4"\n'
    calibration = calibration_toml(rig).replace("[1280, 720]", str(list(size)))
    (folder / "calibration.toml").write_text(calibration)
    (folder / "session.toml").write_text(text)
    return folder / "session.toml"


def test_detected_videos_make_a_session_that_opens(tmp_path):
    session = load_session(video_session(tmp_path))
    with pytest.raises(SessionError, match="a video but no keypoints yet; run: fusecap detect"):
        open_session(session)
    detect_videos(session_videos(session, undetected=True), NumberReader())
    data = open_session(session)
    assert data.landmarks is not None and data.landmarks.name == "coco17"
    assert data.session.settings.rate_hz == 25.0
    assert data.times_s == pytest.approx(np.arange(12) / 25)
    assert data.detections(5).people[1][0, 0, 0] == 6.5


def test_rate_and_offset_of_the_session_count_more_than_the_videos(tmp_path):
    path = video_session(tmp_path)
    edit(path, 'name = "test"', 'name = "test"\nrate_hz = 50')
    edit(path, 'video = "cam1.mp4"', 'video = "cam1.mp4"\nrate_hz = 100\noffset_s = 0.2')
    session = load_session(path)
    detect_videos(session_videos(session), NumberReader())
    data = open_session(session)
    assert data.session.settings.rate_hz == 50
    assert data.keypoints[0].times_s == pytest.approx(np.arange(12) / 25)
    assert data.keypoints[1].times_s == pytest.approx(np.arange(12) / 100 + 0.2)


def test_keypoints_of_a_video_that_was_replaced_are_not_used(tmp_path):
    session = load_session(video_session(tmp_path))
    detect_videos(session_videos(session), NumberReader())
    write_video(tmp_path / "cam1.mp4", 5)
    resolved = with_detections(session)
    assert [camera.keypoints is None for camera in resolved.cameras] == [False, True]


def test_hash_of_a_session_covers_video_and_detector(tmp_path):
    def hashed(identity):
        session = load_session(tmp_path / "s" / "session.toml")
        shutil.rmtree(tmp_path / "s" / "keypoints", ignore_errors=True)
        detect_videos(session_videos(session), NumberReader(identity))
        return content_hash(with_detections(session))

    video_session(tmp_path / "s")
    first = hashed("reader 1")
    assert hashed("reader 1") == first
    assert hashed("reader 2") != first


def test_stated_format_that_differs_from_the_detected_one_is_an_error(tmp_path):
    path = video_session(tmp_path)
    edit(path, 'video = "cam0.mp4"', 'video = "cam0.mp4"\nformat = "openpose-body25"')
    session = load_session(path)
    detect_videos(session_videos(session), NumberReader())
    with pytest.raises(SessionError, match="holds openpose-coco17; leave format out"):
        open_session(session)


def test_detector_table_and_command_line_change_options(tmp_path):
    path = video_session(tmp_path)
    table = '[detector]\nmodel = "nets/pose.xml"\nperson_model = "some-name"\nperson_every = 5\n\n'
    edit(path, "[[camera]]", table + "[[camera]]")
    options = detector_options(load_session(path), runtime="openvino", person_every=None)
    assert options.model == str(tmp_path / "nets" / "pose.xml")
    assert (options.person_model, options.person_every) == ("some-name", 5)
    assert options.runtime == "openvino" and not options.packed
    edit(path, "person_every = 5", "person_evry = 5")
    with pytest.raises(SessionError, match="did you mean 'person_every'"):
        load_session(path)


def test_video_of_another_size_than_calibrated_is_refused(tmp_path):
    path = video_session(tmp_path)
    session = load_session(path)
    assert video_setup(session, session_videos(session), COCO) is not None
    edit(tmp_path / "calibration.toml", "[64, 48]", "[128, 96]")
    with pytest.raises(SessionError, match="shows 64 x 48 px, but is calibrated for 128 x 96"):
        video_setup(session, session_videos(session), COCO)


def test_two_videos_of_one_name_are_refused(tmp_path):
    paths = [write_video(tmp_path / f"a{suffix}", 3) for suffix in (".mp4", ".mkv")]
    with pytest.raises(InputError, match="two videos are called a"):
        loose_videos(paths, tmp_path / "out")


# Commands


@pytest.fixture
def invoke(monkeypatch):
    """Runs a command with a reader of numbers for a detector; options it was built with."""
    built = []

    def build(options, progress=None):
        built.append(options)
        return NumberReader()

    monkeypatch.setattr("fusecap.detect.build.build_detector", build)

    def run(*arguments):
        return CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)

    run.built = built
    return run


def test_detect_command_on_a_session(tmp_path, invoke):
    session = video_session(tmp_path)
    result = invoke("detect", session, "--person-every", 3, "--packed", "--overlay", "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["frames_detected"] == 24 and report["landmark_set"] == "coco17"
    assert report["cameras"]["cam1"]["frames"] == 12
    assert [Path(file).name for file in report["files"]] == ["cam0_overlay.mp4", "cam1_overlay.mp4"]
    assert invoke.built[0].person_every == 3 and invoke.built[0].packed
    table = invoke("detect", session)
    assert "12 of 12" in table.stdout and "nothing new" in table.stdout


def test_detect_command_on_loose_videos(tmp_path, invoke):
    two_videos(tmp_path)
    report = json.loads(invoke("detect", tmp_path, "--json").stdout)
    assert set(report["cameras"]) == {"a", "b"}
    assert (tmp_path / "keypoints" / "b" / "b_000000000023_keypoints.json").is_file()
    one = json.loads(
        invoke("detect", tmp_path / "a.mp4", "--out", tmp_path / "other", "--json").stdout
    )
    assert list(one["cameras"]) == ["a"] and (tmp_path / "other" / "a").is_dir()


def test_camera_that_sees_nobody_is_named(tmp_path, invoke):
    write_video(tmp_path / "dark.mp4", 5, picture=lambda n: stripe(3))
    result = invoke("detect", tmp_path / "dark.mp4")
    assert "camera 'dark' sees people in 0.0 % of its frames" in " ".join(result.stderr.split())


def test_detect_command_refuses_in_words(tmp_path, invoke):
    assert invoke("detect", tmp_path, "--runtime", "opnvino").exit_code == 2
    with pytest.raises(InputError, match="no videos; expected one per camera"):
        invoke("detect", tmp_path)
    session = video_session(tmp_path / "s")
    with pytest.raises(InputError, match="expected it alone"):
        invoke("detect", session, session)


def test_solve_detects_first_and_only_once(tmp_path, invoke):
    session = video_session(tmp_path)
    with pytest.raises(InputError, match="nobody could be followed in 12 instants"):
        invoke("solve", session)
    files = sorted((tmp_path / "keypoints").rglob("*_keypoints.json"))
    written_ns = [path.stat().st_mtime_ns for path in files]
    assert len(files) == 24
    with pytest.raises(InputError, match="nobody could be followed"):
        invoke("solve", session)
    assert [path.stat().st_mtime_ns for path in files] == written_ns


# Predictions


@pytest.mark.slow
def test_a_view_that_lost_someone_is_told_where_they_are(tmp_path):
    rig = ring(4)
    video_session(tmp_path, frames=1)
    (tmp_path / "calibration.toml").write_text(calibration_toml(rig))
    setup = setup_of(load_session(tmp_path / "session.toml"), rig, COCO)
    times_s = np.arange(20) / 30
    points = walking_landmarks(COCO, times_s)
    images = [[camera.project(p) for camera in rig.cameras] for p in points]
    expected = ExpectedPeople(setup, periods_s=[1 / 30] * 4, landmark_count=17)
    nobody = np.empty((0, 17, 3))
    stranger = np.column_stack([np.linspace(10, 60, 17), np.linspace(10, 90, 17), np.full(17, 0.7)])
    for n in range(19):
        now_ns = round(times_s[n] * 1e9)
        expected.at(now_ns)
        people = [np.column_stack([xy, np.full(17, 0.9)])[None] for xy in images[n]]
        people[1] = np.concatenate([people[1], stranger[None]])
        if n > 12:
            people[3] = nobody
        expected.learn(now_ns, people)
    found = expected.at(round(times_s[19] * 1e9))
    assert [len(some) for some in found] == [1, 2, 1, 1]
    for camera in (0, 3):
        distance = np.linalg.norm(found[camera][0, :, :2] - images[19][camera], axis=1)
        assert np.median(distance) < 15
    assert np.array_equal(found[1][1], stranger)


def test_slow_cameras_people_stand_for_it_between_its_frames():
    expected = ExpectedPeople(None, periods_s=[1 / 60, 1 / 30], landmark_count=17)
    person = np.ones((1, 17, 3))
    expected.learn(0, [person, person])
    expected.learn(17_000_000, [person, None])
    assert [len(some) for some in expected.at(33_000_000)] == [1, 1]
    expected.learn(50_000_000, [person[:0], None])
    assert [len(some) for some in expected.at(60_000_000)] == [0, 0]
