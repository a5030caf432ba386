import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.calibrate.sync import session as sync_session
from fusecap.calibrate.sync import session_imus
from fusecap.calibrate.sync.cameras import synchronise_cameras
from fusecap.calibrate.sync.curves import clustered_covariance
from fusecap.calibrate.sync.imus import Filmed, TimedSensor, imu_clock
from fusecap.calibrate.sync.session import synchronise
from fusecap.calibrate.sync.signals import common_smooth_s, smoothed, view_of
from fusecap.calibrate.sync.stamp import find_stamp
from fusecap.cli import main
from fusecap.errors import InputError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import SubjectSettings
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session, parse_session
from fusecap.sources.sync_files import Clock, Clocks, read_sync, sync_toml
from session_files import edit, ring, walking_landmarks
from session_files import write_session as write_small

BODY25 = landmark_set_named("body25")


def tracks(rig, points_at, offsets_s, rates_hz, duration_s=8.0, noise_px=1.0, seed=0):
    """Cameras whose times are wrong by what has to be added to them."""
    rng = np.random.default_rng(seed)
    result = []
    for camera, offset_s, rate_hz in zip(rig.cameras, offsets_s, rates_hz, strict=True):
        own_s = np.arange(int(duration_s * rate_hz)) / rate_hz
        people = []
        for point in points_at(own_s + offset_s):
            pixels = camera.project(point) + noise_px * rng.standard_normal((len(point), 2))
            people.append(np.concatenate([pixels, np.full((len(pixels), 1), 0.9)], 1)[None])
        result.append(
            KeypointTrack(
                name=camera.name,
                landmarks=BODY25,
                rate_hz=rate_hz,
                frames=np.arange(len(own_s)),
                times_s=own_s,
                people=tuple(people),
                broken=(),
            )
        )
    return result


def clocks_of(rig, some, *, calibrated=True, max_offset_s=3.0):
    views = [
        view_of(track, camera if calibrated else None)
        for track, camera in zip(some, rig.cameras, strict=True)
    ]
    return synchronise_cameras(
        rig if calibrated else None, views, BODY25.landmark_names, max_offset_s=max_offset_s
    )


def walking(times_s):
    return walking_landmarks(BODY25, times_s)


def standing(times_s):
    return np.repeat(walking_landmarks(BODY25, np.zeros(1)), len(times_s), axis=0)


def repeating(times_s):
    """On the spot, one stride a second, each like the other."""
    return walking_landmarks(BODY25, 0.5 * np.sin(2 * np.pi * times_s))


# Signals


def test_smoothing_keeps_a_line_and_gives_its_slope():
    times_s = np.sort(np.random.default_rng(1).uniform(0, 2, 60))
    value, slope = smoothed(times_s, 3.0 * times_s[:, None] - 1.0, np.linspace(0.2, 1.8, 9), 0.1)
    assert np.allclose(value[:, 0], 3.0 * np.linspace(0.2, 1.8, 9) - 1.0)
    assert np.allclose(slope, 3.0)


def test_smoothing_leaves_out_what_is_missing():
    times_s = np.arange(40) / 30
    values = np.stack([2.0 * times_s, times_s], axis=1)
    values[10:20, 0] = np.nan
    value, _ = smoothed(times_s, values, times_s, 0.03)
    assert np.isnan(value[15, 0]) and np.isfinite(value[15, 1])


def test_errors_that_are_alike_count_once():
    rng = np.random.default_rng(0)
    block = np.repeat(np.arange(50), 20)
    error = rng.standard_normal(50)[block]
    gradient, slope = error[:, None], np.array([[float(len(block))]])
    alike = clustered_covariance(gradient, slope, block)[0, 0]
    assert np.sqrt(alike) == pytest.approx(1 / np.sqrt(50), rel=0.3)


# Cameras


@pytest.mark.slow
def test_cameras_of_different_rates_and_starts_are_found():
    rig, true_s = ring(3), np.array([0.0, 0.7312, -1.4071])
    found = clocks_of(rig, tracks(rig, walking, true_s, [30, 25, 50]))
    assert np.abs(found.offset_s - true_s).max() < 0.005
    assert np.all(np.abs(found.offset_s - true_s)[1:] < 4 * found.error_s[1:])
    before_px, after_px = found.residual_px
    assert np.all(before_px > 10) and np.all(after_px < 1), "as stated, not after a first guess"


@pytest.mark.slow
def test_variable_frame_times_are_used_as_they_are():
    rig, true_s = ring(3), np.array([0.0, 0.5, 0.0])
    some = tracks(rig, walking, true_s, [30, 30, 30])
    kept = np.sort(np.random.default_rng(2).choice(240, 200, replace=False))
    some[1] = replace(
        some[1],
        frames=some[1].frames[kept],
        times_s=some[1].times_s[kept],
        people=tuple(some[1].people[i] for i in kept),
    )
    assert clocks_of(rig, some).offset_s[1] == pytest.approx(0.5, abs=0.006)


@pytest.mark.slow
def test_cameras_of_ten_frames_a_second_are_found():
    rig, true_s = ring(3), np.array([0.0, 0.43, -0.81])
    some = tracks(rig, walking, true_s, [10, 10, 10], 12.0)
    smooth_s = common_smooth_s(some)
    views = [view_of(t, c, smooth_s) for t, c in zip(some, rig.cameras, strict=True)]
    found = synchronise_cameras(rig, views, BODY25.landmark_names, max_offset_s=2.0)
    assert np.abs(found.offset_s - true_s).max() < 0.015


def test_without_calibration_offsets_are_good_to_a_few_frames():
    rig, true_s = ring(3), np.array([0.0, 0.6, -0.4])

    def lively(times_s):
        return walking(times_s + 0.8 * np.sin(1.7 * times_s) * np.sin(0.6 * times_s))

    found = clocks_of(rig, tracks(rig, lively, true_s, [30, 30, 30], 20.0), calibrated=False)
    assert not found.refined
    assert np.abs(found.offset_s - true_s).max() < 0.15


@pytest.mark.slow
def test_drift_is_found_in_two_minutes():
    rig = ring(3)
    some = tracks(rig, walking, [0.0, 0.3, 0.0], [15, 15, 15], 120.0)
    slow = some[2].times_s * (1 - 100e-6)
    found = clocks_of(rig, [some[0], some[1], replace(some[2], times_s=slow)], max_offset_s=1.0)
    assert found.drift_ppm[2] == pytest.approx(100, abs=4 * found.drift_error_ppm[2] + 1)
    assert abs(found.drift_ppm[1]) < 4 * found.drift_error_ppm[1] + 1
    assert found.drift_error_ppm[2] < 25


# Sensors


def turning(seed=0, seconds=12.0):
    """A bone that turns about changing axes, as functions of time."""
    rng = np.random.default_rng(seed)
    rate, phase = rng.uniform(0.3, 1.3, (3, 4)), rng.uniform(0, 6, (3, 4))

    def at(times_s):
        angle = np.sin(2 * np.pi * rate[None] * times_s[:, None, None] + phase).sum(2) * 0.4
        return Rotation.from_rotvec(angle).as_matrix()

    return at, np.arange(0, seconds, 1 / 60)


def test_sensor_mounted_any_way_round_is_found():
    at, times_s = turning()
    filmed = Filmed(
        name="anna", times_s=times_s, bone_names=("left_shank",), rotation=at(times_s)[:, None]
    )
    mounting = Rotation.from_rotvec([0.4, -1.9, 1.1]).as_matrix()
    own_s = np.arange(0, 10, 0.01)
    worn = TimedSensor(bone="left_shank", times_s=own_s, rotation=at(own_s + 1.2345) @ mounting)
    found = imu_clock([worn], filmed, max_offset_s=3.0)
    assert found.offset_s == pytest.approx(1.2345, abs=0.001)
    assert found.peak is not None and found.peak.distinct
    assert found.correlation > 0.99


def test_sensor_at_rest_tells_nothing():
    at, times_s = turning()
    filmed = Filmed(
        name="anna", times_s=times_s, bone_names=("head",), rotation=at(times_s)[:, None]
    )
    still = TimedSensor(bone="head", times_s=times_s, rotation=np.repeat(np.eye(3)[None], 720, 0))
    assert np.isnan(imu_clock([still], filmed, max_offset_s=3.0).offset_s)


def several_clocks(offsets_s):
    """A subject whose sensors, a file each, are on clocks of their own; person and clocks found."""
    at, times_s = zip(*(turning(seed) for seed in range(len(offsets_s))), strict=True)
    bones = ("left_shank", "right_shank", "left_forearm", "right_forearm")[: len(at)]
    person = Filmed(
        name="anna",
        times_s=times_s[0],
        bone_names=bones,
        rotation=np.stack([a(t) for a, t in zip(at, times_s, strict=True)], axis=1),
    )
    subject = SubjectSettings.model_validate(
        {"name": "anna", "imu": [{"bone": b, "file": f"{b}.csv"} for b in bones]}
    )
    own_s = np.arange(0, 10, 0.01)
    sensors = [
        TimedSensor(bone=b, times_s=own_s, rotation=a(own_s + o))
        for a, b, o in zip(at, bones, offsets_s, strict=True)
    ]
    return subject, sensors, person


def plain_track(times_s):
    return ImuTrack(
        times_s=times_s,
        orientation_wxyz=np.tile([1.0, 0, 0, 0], (len(times_s), 1)),
        accel_m_s2=np.zeros((len(times_s), 3)),
    )


def test_sensors_of_one_subject_may_be_on_different_clocks():
    offsets_s = [0.5, 0.5, 1.3, 1.3]
    subject, sensors, person = several_clocks(offsets_s)
    tracks = [plain_track(worn.times_s) for worn in sensors]
    found = session_imus.subject_clocks(subject, tracks, sensors, person, 3.0, None)
    assert sorted(len(clock.bones) for clock in found) == [2, 2]
    by_bone = {bone: clock.offset_s for clock in found for bone in clock.bones}
    for worn, offset_s in zip(sensors, offsets_s, strict=True):
        assert by_bone[worn.bone] == pytest.approx(offset_s, abs=0.001)


def test_sensors_are_given_to_the_people_they_fit(tmp_path):
    people, subjects, worn = [], [], []
    for index, name in enumerate(("anna", "ben")):
        at, times_s = turning(seed=10 + index)
        people.append(
            Filmed(
                # The video has the names the other way round.
                name=("ben", "anna")[index],
                times_s=times_s,
                bone_names=("left_shank",),
                rotation=at(times_s)[:, None],
            )
        )
        subjects.append(
            SubjectSettings.model_validate(
                {"name": name, "imu": [{"bone": "left_shank", "file": "a.csv"}]}
            )
        )
        own_s = np.arange(0, 10, 0.01)
        worn.append([TimedSensor(bone="left_shank", times_s=own_s, rotation=at(own_s + 0.4))])
    session = parse_session(write_small(tmp_path, frames=10))
    session = session.model_copy(update={"subjects": tuple(subjects)})
    starts_m = {"ben": (0.5, 0.5), "anna": (-1.0, 0.0)}
    found = session_imus.wearers(session, subjects, worn, people, 2.0)
    assert [person and person.name for person in found] == ["ben", "anna"]
    notes = session_imus.called_otherwise(subjects, found, starts_m)
    assert len(notes) == 2 and "add start_m = [0.5, 0.5] to 'anna'" in notes[0]


def test_drift_of_a_sensor_is_found_in_two_minutes():
    at, times_s = turning(seconds=130.0)
    rng = np.random.default_rng(3)
    noise = Rotation.from_rotvec(0.02 * rng.standard_normal((len(times_s), 3))).as_matrix()
    filmed = Filmed(
        name="anna",
        times_s=times_s,
        bone_names=("left_shank",),
        rotation=(at(times_s) @ noise)[:, None],
    )
    own_s = np.arange(0, 128, 0.01)
    worn = TimedSensor(bone="left_shank", times_s=own_s, rotation=at(own_s * (1 + 80e-6) + 0.3))
    found = imu_clock([worn], filmed, max_offset_s=1.0)
    assert found.drift_ppm == pytest.approx(80, abs=4 * found.drift_error_ppm)
    assert found.drift_error_ppm < 15


def test_a_limbs_turn_about_itself_does_not_count():
    at, times_s = turning(seed=4)
    angles = Rotation.from_matrix(at(times_s)).as_euler("ZXY")
    late = Rotation.from_matrix(at(times_s - 0.03)).as_euler("ZXY")
    guessed = np.column_stack([angles[:, :2], late[:, 2]])
    bone = Rotation.from_euler("ZXY", guessed).as_matrix()

    def offset_s(name):
        filmed = Filmed(name="a", times_s=times_s, bone_names=(name,), rotation=bone[:, None])
        worn = TimedSensor(bone=name, times_s=times_s, rotation=at(times_s))
        return imu_clock([worn], filmed, max_offset_s=1.0).offset_s

    # Along a shank lies y, whose turn alone is 30 ms late here.
    assert abs(offset_s("left_shank")) < 0.002


def test_foot_stamp_is_one_event_on_both_clocks():
    times_s = np.arange(0, 6, 1 / 60)
    height = 0.1 + np.interp(times_s, [0, 2.5, 2.9, 3.0, 6], [0.0, 0.0, 0.3, 0.0, 0.0])
    ankle = np.stack([np.zeros(360), height, np.zeros(360)], axis=1)
    own_s = np.arange(0, 6, 0.01)
    force = np.tile([0.0, 9.8, 0.0], (600, 1))
    force[200] = [0, 70.0, 0]
    stamp = find_stamp({"left": (times_s, ankle)}, [("left_foot", own_s, force)])
    assert stamp is not None
    assert stamp.offset_s == pytest.approx(1.0, abs=0.03)
    force[400] = [0, 65.0, 0]
    assert find_stamp({"left": (times_s, ankle)}, [("left_foot", own_s, force)]) is None


# Sessions


@pytest.fixture
def small(tmp_path):
    return write_small(tmp_path, frames=120)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("motion", "state", "said"),
    [
        (standing, "not found", "nobody moves"),
        (repeating, "ambiguous", "the motion repeats itself"),
    ],
)
def test_motion_that_cannot_tell_is_refused(small, monkeypatch, motion, state, said):
    some = tracks(ring(4), motion, np.zeros(4), [30] * 4)
    monkeypatch.setattr(sync_session, "open_keypoints", lambda *_: tuple(some))
    found = synchronise(parse_session(small), max_offset_s=3.0)
    assert not found.complete
    for row in found.rows[1:]:
        assert row.state == state and row.verdict is None and said in row.said
    assert all(name == found.reference for name in found.clocks.cameras)


@pytest.mark.slow
def test_offset_beyond_the_range_is_not_made_up(small, monkeypatch):
    some = tracks(ring(4), walking, [0, 0, 0, 2.0], [30] * 4)
    monkeypatch.setattr(sync_session, "open_keypoints", lambda *_: tuple(some))
    row = synchronise(parse_session(small), max_offset_s=0.5).rows[3]
    assert row.state == "not found" and "--max-offset" in row.said


@pytest.mark.slow
def test_camera_that_sees_nobody_is_named(small, monkeypatch):
    some = tracks(ring(4), walking, np.zeros(4), [30] * 4)
    some[2] = replace(some[2], people=tuple(p[:0] for p in some[2].people))
    monkeypatch.setattr(sync_session, "open_keypoints", lambda *_: tuple(some))
    rows = synchronise(parse_session(small), max_offset_s=1.0).rows
    assert "nobody is seen" in rows[2].said
    assert rows[1].verdict in ("good", "usable") and rows[3].verdict in ("good", "usable")


def test_two_sensors_on_one_bone_are_refused_with_words(tmp_path):
    path = write_small(tmp_path, frames=10)
    twice = {"name": "anna", "imu": [{"bone": "head", "file": "a.csv"}] * 2}
    subject = SubjectSettings.model_validate(twice)
    session = parse_session(path).model_copy(update={"subjects": (subject,)})
    with pytest.raises(InputError, match="2 sensors on 'head', expected one per bone"):
        synchronise(session)


def test_one_camera_without_sensors_has_nothing_to_compare(tmp_path):
    path = write_small(tmp_path, frames=10, cameras=1)
    with pytest.raises(InputError, match="one camera and no sensors"):
        synchronise(parse_session(path))


def test_session_uses_its_clocks(small):
    before = open_session(load_session(small))
    clocks = Clocks(cameras={"cam1": Clock(offset_s=0.25, drift_ppm=1000.0)})
    (small.parent / "sync.toml").write_text(sync_toml(clocks, origin="test"))
    edit(small, "[session]", '[session]\nsync = "sync.toml"')
    after = open_session(load_session(small))
    moved = after.keypoints[1].times_s - before.keypoints[1].times_s
    assert moved[0] == pytest.approx(0.25)
    assert moved[-1] == pytest.approx(0.25 + 1e-3 * before.keypoints[1].times_s[-1])
    assert np.array_equal(after.keypoints[0].times_s, before.keypoints[0].times_s)
    assert after.content_hash != before.content_hash


def test_file_round_trip(tmp_path):
    clocks = Clocks(
        cameras={"ca m": Clock(offset_s=-1.5, drift_ppm=12.5, error_s=0.001)},
        imus={"an na": {"left_shank": Clock(offset_s=0.125)}},
    )
    path = tmp_path / "sync.toml"
    path.write_text(sync_toml(clocks, origin='a "test"'))
    again = read_sync(path)
    assert again.camera("ca m") == clocks.camera("ca m")
    assert again.imu("an na", "left_shank") == Clock(offset_s=0.125)
    assert again.camera("other") == Clock()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("fusecap sync 1", "other", "format is 'other'"),
        ("[camera.", "[cameras.", "unknown key 'cameras'; did you mean 'camera'"),
        ("offset_s = 1", "offset = 1", "unknown key 'offset'; did you mean 'offset_s'"),
        ("offset_s = 1", 'offset_s = "x" #', "expected a number"),
        ("drift_ppm = 0", "drift_ppm = 90000", "has another rate_hz"),
        ("offset_s = 1", "offset_s = [", "not valid TOML"),
    ],
)
def test_garbled_file_says_what_is_wrong(tmp_path, old, new, message):
    path = tmp_path / "sync.toml"
    text = sync_toml(Clocks(cameras={"a": Clock(offset_s=1.0)}), origin="test")
    path.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_sync(path)


@pytest.mark.slow
def test_command_finds_cameras_and_sensors_of_the_simulated_demo(tmp_path, monkeypatch, capsys):
    path = write_session(demo_scene(0, seconds=8.0), tmp_path)
    text = path.read_text()
    parts = text.split("offset_s = 0.0")
    true_s = [0.0, -0.4, 0.3, 1.1]
    text = "".join(
        part + (f"offset_s = {-t}" if i < 4 else "")
        for i, (part, t) in enumerate(zip(parts, [*true_s, 0.0], strict=True))
    )
    path.write_text(text.replace('imu_up = "y"', 'imu_up = "y"\noffset_s = -0.6'))
    arguments = ["calibrate", "sync", str(tmp_path), "--write", "--json", "--max-offset", "2"]
    arguments += ["--picture", str(tmp_path / "sync.png")]
    monkeypatch.setattr("sys.argv", ["fusecap", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    report = json.loads(capsys.readouterr().out)
    for row, true in zip(report["clocks"], [*true_s, 0.6, 0.6], strict=True):
        # Flesh carries the sensors late by some 7 ms in the simulation.
        limit_s = 0.006 if row["kind"] == "camera" else 0.015
        assert row["offset_s"] == pytest.approx(true, abs=limit_s)
    assert (tmp_path / "sync.png").stat().st_size > 10_000
    session = load_session(tmp_path)
    assert session.settings.sync == tmp_path / "sync.toml"
    times_s = [track.times_s[0] for track in open_session(session).keypoints]
    assert np.ptp(times_s) < 0.012


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.parametrize("trial", ["balancing", "two-people"])
def test_pose2sim_frames_that_were_dropped_are_found(data_dir, tmp_path, monkeypatch, trial):
    path = Path(__file__).resolve().parents[1] / "examples/pose2sim_clip.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    clip = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = clip
    spec.loader.exec_module(clip)
    folder = data_dir / "pose2sim_demo/v0.8.4_openpose_body25b"
    session = parse_session(clip.write_session(folder, tmp_path, trial))
    whole = sync_session.open_keypoints(session)
    for dropped in ((0, 0, 0, 0), (0, 7, 0, 0), (0, 13, 7, 3)):
        some = [
            replace(
                t, frames=t.frames[: 100 - k], times_s=t.times_s[: 100 - k], people=t.people[k:]
            )
            for t, k in zip(whole, dropped, strict=True)
        ]
        monkeypatch.setattr(sync_session, "open_keypoints", lambda *_, some=some: tuple(some))
        found = synchronise(session)
        frames = np.array([row.offset_s for row in found.rows]) * clip.RATE_HZ
        assert np.abs(frames - dropped).max() < 0.4
