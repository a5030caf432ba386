import time

import numpy as np
import pytest

from fusecap.batch.solve import solve_session
from fusecap.errors import InputError, SessionError
from fusecap.sources.session_cameras import open_keypoints
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session, parse_session
from session_files import edit, imu_csv, write_session

CAMERA = '[session]\nname = "a"\ncalibration = "c.toml"\n[[camera]]\nname = "left"\nkeypoints="k"\n'


def complaint(tmp_path, text):
    (tmp_path / "session.toml").write_text(text)
    with pytest.raises(SessionError) as caught:
        parse_session(tmp_path)
    assert "session.toml" in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(("table", "most"), [("camera", 256), ("subject", 64)])
def test_tables_beyond_the_budget_are_refused_at_once(tmp_path, table, most):
    keypoints = 'keypoints = "k"\n' if table == "camera" else ""
    text = "".join(f'[[{table}]]\nname = "x{i}"\n{keypoints}' for i in range(20_000))
    started_s = time.process_time()
    found = complaint(tmp_path, CAMERA + text)
    assert f"[[{table}]] tables; at most {most}" in found
    assert time.process_time() - started_s < 5


@pytest.mark.parametrize(
    ("added", "expected"),
    [
        ("rat_hz = 3\n", ["[[camera]] 'left'", "unknown key 'rat_hz'", "'rate_hz'"]),
        ('rate_hz = "fast"\n', ["[[camera]] 'left' rate_hz", "'fast'", "a number"]),
        ("rate_hz = true\n", ["rate_hz", "True", "a number"]),
        ("rate_hz = 0\n", ["rate_hz", "0", "above zero"]),
        ('[estimator]\nwindow = "long"\n', ["window", "'long'"]),
        ("[estimator]\nwindow = 2000\n", ["window", "1000"]),
        ("rate_hz = -25\n", ["rate_hz", "-25", "above zero"]),
        ("offset_s = nan\n", ["offset_s", "nan", "finite"]),
        ("offset_s = inf\n", ["offset_s", "finite"]),
        ('format = "openpose-body52"\n', ["format", "did you mean 'openpose-body25'"]),
        ('[[camera]]\nname = "left"\nkeypoints = "k"\n', ["two [[camera]]", "'left'"]),
        ('[[camera]]\nname = "b"\n', ["'b'", "neither keypoints, video nor live"]),
        ('[[camera]]\nname = ""\nvideo="v.mp4"\n', ["name", "empty"]),
        ('[[subject]]\nname = "A"\n[[subject]]\nname = "A"\n', ["two [[subject]]", "'A'"]),
        ('[[subject]]\nname = "A"\nheight_m = 178\n', ["height_m is 178", "metres", "1.78"]),
        ('[[subject]]\nname = "A"\nheight_m = 1780\n', ["millimetres", "1.78"]),
        ('[[subject]]\nname = "A"\nheight_m = 5.9\n', ["5.9", "metres"]),
        ('[[subject]]\nname = "A"\nstart_m = [1]\n', ["start_m"]),
        ('[[subject]]\nname = "A"\ntpose_s = [3, 1]\n', ["tpose_s", "start before the end"]),
        ('[[subject]]\nname = "A"\nbone_lengths_m = {shin = 0.4}\n', ["'A'", "'shin'"]),
        ('[subject]\nname = "A"\n', ["[[subject]]"]),
        ("[estimator]\nweights = {positon = 1}\n", ["weights", "'position'"]),
        ("[estimator]\nweights = {floor = -1}\n", ["floor", "-1", "zero or more"]),
        ("[estimator]\nmax_iterations = 0\n", ["max_iterations", "at least 1"]),
    ],
)
def test_wrong_value_is_named_with_place_and_remedy(tmp_path, added, expected):
    text = complaint(tmp_path, CAMERA + added)
    for part in expected:
        assert part in text


IMU = CAMERA + '[[subject]]\nname = "A"\n[[subject.imu]]\nbone = "left_shank"\nfile = "x.csv"\n'


@pytest.mark.parametrize(
    ("added", "expected"),
    [
        ('format = "xsense-mt"\n', ["[[subject.imu]] 'left_shank' format", "'xsens-mt'"]),
        ("bone_from_imu_wxyz = [1, 0, 0]\n", ["bone_from_imu_wxyz"]),
        ("bone_from_imu_wxyz = [0, 0, 0, 0]\n", ["bone_from_imu_wxyz", "norm is 0"]),
        ('imu_up = "x"\n', ["imu_up", "y, z"]),
        ("headin_deg = 3\n", ["'heading_deg'"]),
    ],
)
def test_wrong_imu_value_is_named(tmp_path, added, expected):
    text = complaint(tmp_path, IMU + added)
    for part in expected:
        assert part in text


def test_unknown_bone_of_an_imu_names_the_nearest(tmp_path):
    text = complaint(tmp_path, IMU.replace("left_shank", "left_shnk"))
    assert "'left_shnk'" in text and "'left_shank'" in text


def test_several_errors_are_all_listed(tmp_path):
    text = complaint(tmp_path, CAMERA + "rate_hz = 0\noffset_s = nan\n")
    assert len(text.splitlines()) == 2


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('[session]\nname = "x"\n', "nothing to solve"),
        ("", "[session]"),
        ('[[session]]\nname = "x"\n', "write [session]"),
        ("[session", "not valid TOML"),
        (CAMERA.replace('name = "a"', 'name = "a"\nup = "x"'), "y, z, -y"),
        (CAMERA.replace('name = "a"', 'name = "a"\nfloor = 1'), "true or false"),
        (CAMERA.replace('name = "a"', 'name = "a"\nmax_subjects = 0'), "at least 1"),
        (CAMERA.replace('name = "a"', 'name = "a"\nvolume_m = [1, 0, 0, 1]'), "min < max"),
        ("extra = 1\n" + CAMERA, "unknown key 'extra'"),
    ],
)
def test_broken_session_is_refused(tmp_path, text, expected):
    assert expected in complaint(tmp_path, text)


def test_session_that_is_not_text_is_refused(tmp_path):
    (tmp_path / "session.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(SessionError, match="UTF-8"):
        parse_session(tmp_path)


def test_missing_session_is_refused(tmp_path):
    with pytest.raises(SessionError, match="no such file"):
        load_session(tmp_path)


def test_missing_inputs_are_all_listed(tmp_path):
    (tmp_path / "session.toml").write_text(IMU)
    with pytest.raises(SessionError) as caught:
        load_session(tmp_path)
    text = str(caught.value)
    assert all(name in text for name in ("c.toml", "'left' keypoints", "x.csv"))


def test_paths_start_at_the_session_folder(tmp_path):
    write_session(tmp_path, frames=2)
    session = load_session(tmp_path)
    assert session.cameras[0].keypoints == tmp_path / "keypoints" / "cam0"
    assert session.folder == tmp_path and session.settings.floor


def test_frames_follow_the_camera_tables_order(tmp_path):
    write_session(tmp_path, frames=5)
    data = open_session(load_session(tmp_path))
    assert data.rig.names == ("cam0", "cam1", "cam2", "cam3")
    frames = list(data.frames())
    assert len(frames) == 5
    assert frames[3][0] == 100_000_000
    assert [len(people) for people in frames[3][1].people] == [1, 1, 1, 1]
    assert frames[3][2] == {}


def test_camera_that_the_calibration_lacks_is_named(tmp_path):
    path = write_session(tmp_path, frames=2)
    edit(path, 'name = "cam1"', 'name = "cam9"')
    with pytest.raises(InputError, match="cam9"):
        open_session(load_session(path))


def test_mixed_keypoint_formats_are_refused(tmp_path):
    path = write_session(tmp_path, frames=2)
    edit(path, 'name = "cam1"', 'name = "cam1"\nformat = "openpose-coco17"')
    with pytest.raises(SessionError, match="one format for all"):
        open_session(load_session(path))


def test_video_without_keypoints_says_what_to_do(tmp_path):
    path = write_session(tmp_path, frames=2)
    (tmp_path / "v.mp4").touch()
    edit(path, 'keypoints = "keypoints/cam1"', 'video = "v.mp4"')
    with pytest.raises(SessionError, match="'cam1' has a video but no keypoints"):
        open_session(load_session(path))


def imu_session(folder, *, offset_s=0.0, extra="bone_from_imu_wxyz = [1, 0, 0, 0]"):
    times_s = np.arange(200) / 100
    identity = np.tile([1.0, 0, 0, 0], (200, 1))
    (folder / "hips.csv").write_text(imu_csv(times_s, identity))
    (folder / "session.toml").write_text(
        '[session]\nname = "imu"\nrate_hz = 50\n[[subject]]\nname = "A"\n'
        f'[[subject.imu]]\nbone = "hips"\nfile = "hips.csv"\noffset_s = {offset_s}\n{extra}\n'
    )
    return folder


def test_session_without_cameras_yields_readings(tmp_path):
    data = open_session(load_session(imu_session(tmp_path)))
    assert len(data.rig) == 0 and data.landmarks is None
    timestamp_ns, detections, readings = list(data.frames())[10]
    assert timestamp_ns == 200_000_000 and detections.people == ()
    assert np.allclose(readings["A"].accel_in_world_m_s2, 0, atol=1e-6)


def test_without_cameras_a_session_is_solved_as_often_as_sensors_measure(tmp_path):
    imu_session(tmp_path)
    edit(tmp_path / "session.toml", "rate_hz = 50\n", "")
    data = open_session(load_session(tmp_path))
    assert data.session.settings.rate_hz == pytest.approx(100.0)
    assert len(data.times_s) == 200 and np.allclose(np.diff(data.times_s), 0.01)


def test_tpose_gives_the_offset_of_the_sensor(tmp_path):
    imu_session(tmp_path, extra="")
    edit(tmp_path / "session.toml", 'name = "A"', 'name = "A"\ntpose_s = [0, 0.5]')
    data = open_session(load_session(tmp_path))
    turned = [data.imus[0].reading(i).bone_rotation_in_world for i in range(len(data.times_s))]
    assert np.allclose(turned, np.eye(3), atol=1e-9)


def test_tpose_may_face_any_way(tmp_path):
    imu_session(tmp_path, extra="")
    edit(
        tmp_path / "session.toml",
        'name = "A"',
        'name = "A"\ntpose_s = [0, 0.5]\ntpose_facing_deg = 90',
    )
    data = open_session(load_session(tmp_path))
    turned = [data.imus[0].reading(i).bone_rotation_in_world[0] for i in range(len(data.times_s))]
    facing = np.array(turned) @ [0.0, 0.0, 1.0]
    assert np.allclose(facing, [1, 0, 0], atol=1e-9)


def test_sensor_without_offset_or_tpose_is_refused(tmp_path):
    with pytest.raises(SessionError, match="tpose_s"):
        open_session(load_session(imu_session(tmp_path, extra="")))


def test_tpose_outside_the_recording_is_refused(tmp_path):
    imu_session(tmp_path, extra="")
    edit(tmp_path / "session.toml", 'name = "A"', 'name = "A"\ntpose_s = [10, 11]')
    with pytest.raises(SessionError, match=r"from 0 to 1\.99 s"):
        open_session(load_session(tmp_path))


def test_clocks_that_never_meet_are_refused(tmp_path):
    path = write_session(tmp_path, frames=10)
    imu_session(tmp_path / "keypoints", offset_s=0.0)
    text = path.read_text() + (
        '[[subject]]\nname = "A"\n[[subject.imu]]\nbone = "hips"\n'
        'file = "keypoints/hips.csv"\nbone_from_imu_wxyz = [1, 0, 0, 0]\noffset_s = 1e9\n'
    )
    path.write_text(text)
    with pytest.raises(SessionError, match="offset_s"):
        open_session(load_session(path))


def test_solve_times_stay_in_step_with_the_first_camera(tmp_path):
    path = write_session(tmp_path, frames=10)
    edit(path, 'name = "cam0"', 'name = "cam0"\noffset_s = 0.01')
    data = open_session(load_session(path))
    steps = (data.times_s - data.keypoints[0].times_s[0]) * 30
    assert np.allclose(steps, np.round(steps), atol=1e-9)
    assert data.times_s[0] >= 0 and data.times_s[-1] <= 9 / 30 + 0.01 + 1e-9


def test_hash_follows_content_and_not_place(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_session(tmp_path / name, frames=3)
    hashes = [open_session(load_session(tmp_path / n)).content_hash for n in ("a", "b")]
    assert hashes[0] == hashes[1]
    edit(tmp_path / "b" / "calibration.toml", "700.0", "701.0")
    assert open_session(load_session(tmp_path / "b")).content_hash != hashes[0]


def test_camera_that_is_live_only_cannot_be_solved(tmp_path):
    text = '[session]\nname = "a"\n[[camera]]\nname = "left"\nlive = "webcam:0"\n'
    (tmp_path / "session.toml").write_text(text)
    with pytest.raises(SessionError, match="'left' is live only"):
        open_keypoints(load_session(tmp_path))


def test_a_session_may_ask_for_each_instant_alone(tmp_path):
    path = write_session(tmp_path)
    together = solve_session(open_session(load_session(tmp_path))).take
    edit(path, "[session]", "[estimator]\nwindow = 1\n\n[session]")
    alone = solve_session(open_session(load_session(tmp_path))).take
    np.testing.assert_allclose(together.theta[0, :, :3], alone.theta[0, :, :3], atol=0.1)
    assert (together.theta[0] != alone.theta[0]).any(axis=1).all()


def test_a_window_of_two_is_refused(tmp_path):
    edit(write_session(tmp_path), "[session]", "[estimator]\nwindow = 2\n\n[session]")
    with pytest.raises(InputError, match="3-1000 instants, or 1"):
        solve_session(open_session(load_session(tmp_path)))


def test_cameras_whose_names_differ_in_odd_characters_have_folders_of_their_own(tmp_path):
    path = tmp_path / "session.toml"
    cameras = "".join(
        f'[[camera]]\nname = "{name}"\nvideo = "v.mp4"\n' for name in ("a/1", "a?1", "A_1")
    )
    path.write_text(f'[session]\nname = "s"\ncalibration = "c.toml"\n{cameras}')
    session = parse_session(path)
    folders = [session.detection_folder(camera).name for camera in session.cameras]
    assert folders == ["a_1", "a_1_2", "A_1_3"]
