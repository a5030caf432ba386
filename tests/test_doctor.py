import re
import shutil
import tarfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.doctor import diagnose
from fusecap.geometry.camera import Rig
from session_files import calibration_toml, edit, imu_csv, ring, write_session


def said(path, severity=None):
    return [str(f) for f in diagnose(path) if severity in (None, f.severity)]


def test_sound_session_has_no_findings(tmp_path):
    assert said(write_session(tmp_path)) == []


def test_errors_of_the_session_file_are_findings(tmp_path):
    path = write_session(tmp_path, frames=3)
    edit(path, "rate_hz = 30", "rate_hz = 0\nflor = true")
    assert any("'floor'" in text for text in said(path, "error"))
    assert said(tmp_path / "nothing", "error") != []


def test_all_missing_files_are_found_at_once(tmp_path):
    path = write_session(tmp_path, frames=5)
    shutil.rmtree(tmp_path / "keypoints" / "cam1")
    shutil.rmtree(tmp_path / "keypoints" / "cam3")
    (tmp_path / "calibration.toml").unlink()
    text = "\n".join(said(path, "error"))
    assert all(name in text for name in ("'cam1'", "'cam3'", "calibration"))


def test_calibration_and_keypoint_errors_are_found_together(tmp_path):
    path = write_session(tmp_path, frames=5)
    edit(tmp_path / "calibration.toml", "700.0", "-700.0")
    for file in (tmp_path / "keypoints" / "cam1").iterdir():
        file.write_text("{")
    text = "\n".join(said(path, "error"))
    assert "focal" in text and "none of the 5 keypoint files" in text


@pytest.mark.parametrize(
    ("name", "expected"), [("a.npy", "holds 3 cameras, 4 of"), ("a.csv", "is a file")]
)
def test_a_keypoint_file_that_cannot_be_read_is_an_error(tmp_path, name, expected):
    path = write_session(tmp_path, frames=5)
    table = tmp_path / name
    if name == "a.npy":
        np.save(table, np.zeros((3, 5, 33, 2)))
    else:
        table.write_text("x,y\n")
    text = re.sub(
        r"(?m)^(keypoints = ).*|^format = .*\n", f'keypoints = "{name}"', path.read_text()
    )
    path.write_text(text)
    assert any(expected in each for each in said(path, "error"))


def test_share_of_truncated_files_is_stated(tmp_path):
    path = write_session(tmp_path, frames=20)
    for file in sorted((tmp_path / "keypoints" / "cam2").iterdir())[:4]:
        file.write_text(file.read_text()[:50])
    assert any("4 of 20 keypoint files (20.0%)" in text for text in said(path, "warning"))


def test_turned_camera_disagrees_with_the_others(tmp_path):
    path = write_session(tmp_path)
    cameras = list(ring().cameras)
    turn = Rotation.from_rotvec([0.1, 0.0, 0.0]).as_matrix()
    cameras[2] = replace(
        cameras[2],
        rotation=turn @ cameras[2].rotation,
        translation=turn @ cameras[2].translation,
    )
    (tmp_path / "calibration.toml").write_text(calibration_toml(Rig(cameras=tuple(cameras))))
    findings = [f for f in diagnose(path) if "disagrees" in f.found]
    assert [f.where for f in findings] == ["camera 'cam2'"]
    assert "fusecap calibrate extrinsics" in findings[0].remedy


@pytest.mark.slow
def test_late_camera_is_told_its_offset(tmp_path):
    path = write_session(tmp_path, frames=120)
    edit(path, 'name = "cam1"', 'name = "cam1"\noffset_s = 0.4')
    findings = [f for f in diagnose(path) if "disagrees" in f.found]
    assert [f.where for f in findings] == ["camera 'cam1'"]
    assert "-0.40 s" in findings[0].remedy


def test_wrong_up_axis_is_found_by_the_people(tmp_path):
    path = write_session(tmp_path)
    edit(path, "rate_hz = 30", 'rate_hz = 30\nup = "z"')
    assert any('set up = "y"' in text for text in said(path, "warning"))


def test_calibration_of_another_scale_is_found_by_the_people(tmp_path):
    path = write_session(tmp_path)
    (tmp_path / "calibration.toml").write_text(calibration_toml(ring(), unit_per_metre=3))
    assert any("as their limbs measure" in text for text in said(path, "warning"))


def test_camera_without_people_is_found(tmp_path):
    path = write_session(tmp_path, frames=20)
    for file in (tmp_path / "keypoints" / "cam2").iterdir():
        file.write_text('{"people": []}')
    assert any("'cam2': sees people in 0.0%" in text for text in said(path, "warning"))


def test_nobody_in_any_camera_is_an_error(tmp_path):
    path = write_session(tmp_path, frames=5)
    for file in (tmp_path / "keypoints").glob("*/*.json"):
        file.write_text('{"people": []}')
    assert any("no camera sees anyone" in text for text in said(path, "error"))


def test_keypoints_of_another_resolution_are_found(tmp_path):
    path = write_session(tmp_path, frames=10)
    text = (tmp_path / "calibration.toml").read_text()
    (tmp_path / "calibration.toml").write_text(text.replace("[1280, 720]", "[4096, 2160]"))
    assert any("another resolution" in text for text in said(path, "warning"))
    (tmp_path / "calibration.toml").write_text(text.replace("[1280, 720]", "[320, 180]"))
    assert any("outside the 320 x 180 image" in text for text in said(path, "warning"))


def test_keypoints_in_another_order_are_found(tmp_path):
    path = write_session(tmp_path, frames=10)
    text = path.read_text().replace("[[camera]]", '[[camera]]\nformat = "openpose-body25b"')
    path.write_text(text)
    errors = said(path, "error")
    assert len(errors) == 4 and "'openpose-body25'" in errors[0]


def test_recordings_of_different_length_are_found(tmp_path):
    path = write_session(tmp_path, frames=60)
    for file in sorted((tmp_path / "keypoints" / "cam3").iterdir())[20:]:
        file.unlink()
    assert any("end at different times: 'cam3'" in text for text in said(path, "warning"))


def test_single_camera_is_a_warning(tmp_path):
    path = write_session(tmp_path, frames=5, cameras=1)
    assert any("depth is not observed" in text for text in said(path, "warning"))


def imu_session(folder, *, accel=None, rate_hz=100, extra=""):
    times_s = np.arange(100) / rate_hz
    quaternion = np.tile([1.0, 0, 0, 0], (100, 1))
    (folder / "hips.csv").write_text(imu_csv(times_s, quaternion, accel))
    (folder / "session.toml").write_text(
        '[session]\nname = "imu"\n[[subject]]\nname = "A"\n[[subject.imu]]\nbone = "hips"\n'
        f'file = "hips.csv"\nbone_from_imu_wxyz = [1, 0, 0, 0]\n{extra}\n'
    )
    return folder


def test_sound_imu_session_only_lacks_cameras(tmp_path):
    assert [f.severity for f in diagnose(imu_session(tmp_path))] == ["info"]


@pytest.mark.parametrize(
    ("accel", "expected"),
    [
        ([0, 0, 1.0], "units of g"),
        ([0, 0, 0.01], "gravity has been removed"),
        ([0, 9.8, 0], 'imu_up is z, gravity points along y: hips; set imu_up = "y"'),
        ([9.8, 0, 0], "90 deg away"),
        ([0, 0, -9.8], "gravity points along -z"),
    ],
)
def test_odd_accelerations_are_found(tmp_path, accel, expected):
    path = imu_session(tmp_path, accel=np.tile(accel, (100, 1)))
    assert any(expected in text for text in said(path))


def test_rate_gaps_and_damage_of_an_imu_are_found(tmp_path):
    path = imu_session(tmp_path, rate_hz=15, extra="rate_hz = 100")
    file = tmp_path / "hips.csv"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:10] + lines[20:]))
    text = "\n".join(said(path, "warning"))
    assert (
        "rate_hz says 100" in text
        and "15.0 Hz" in text
        and "samples lost: hips 10 in 1 gap;" in text
    )


def test_imu_without_mounting_is_an_error(tmp_path):
    path = imu_session(tmp_path)
    edit(tmp_path / "session.toml", "bone_from_imu_wxyz = [1, 0, 0, 0]\n", "")
    assert any("tpose_s" in text for text in said(path, "error"))


@pytest.mark.slow
@pytest.mark.real_data
def test_pose2sim_clip_read_in_the_wrong_order_is_told_the_right_one(data_dir, tmp_path):
    folder = data_dir / "pose2sim_demo/v0.8.4_openpose_body25b"
    with tarfile.open(folder / "pose_json.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    trial = "S00_P00_SingleParticipant/S00_P00_T01_BalancingTrial/pose"
    text = f'[session]\nname = "a"\ncalibration = "{folder}/Calib.qca.txt"\nup = "z"\n'
    for camera in ("01", "02", "03", "04"):
        text += f'[[camera]]\nname = "cam_{camera}"\nformat = "openpose-body25b"\n'
        text += f'keypoints = "{trial}/cam{camera}_json"\n'
    (tmp_path / "session.toml").write_text(text)
    assert said(tmp_path, "error") == []
    (tmp_path / "session.toml").write_text(text.replace('"openpose-body25b"', '"openpose-body25"'))
    errors = said(tmp_path, "error")
    assert len(errors) == 4 and all("'openpose-body25b'" in error for error in errors)


@pytest.mark.slow
@pytest.mark.real_data
def test_shelf_is_sound_and_its_wrong_axis_is_found(data_dir, tmp_path):
    with tarfile.open(data_dir / "shelf/openpose_body25.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    text = f'[session]\nname = "shelf"\nrate_hz = 25\ncalibration = "{data_dir}/shelf/calibs"\n'
    text += 'up = "z"\n'
    text += "".join(f'[[camera]]\nname = "{c}"\nkeypoints = "{c}"\n' for c in "01234")
    (tmp_path / "session.toml").write_text(text)
    assert said(tmp_path) == []
    edit(tmp_path / "session.toml", 'up = "z"', 'up = "y"')
    assert any('set up = "z"' in line for line in said(tmp_path, "warning"))
    edit(tmp_path / "session.toml", 'up = "y"', 'up = "z"')
    edit(tmp_path / "session.toml", 'name = "2"', 'name = "2"\noffset_s = 0.4')
    late = [f for f in diagnose(tmp_path) if "disagrees" in f.found]
    assert [f.where for f in late] == ["camera '2'"] and "-0.40 s" in late[0].remedy


def test_folder_without_a_session_file_is_told_the_next_commands(tmp_path):
    (tmp_path / "cam1.mp4").write_bytes(b"")
    (tmp_path / "00B421E6.csv").write_text("time_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    found = {finding.where: str(finding) for finding in diagnose(tmp_path)}
    assert "1 video, 1 sensor" in found["session.toml"]
    assert "fusecap init" in found["session.toml"]
    assert "empty file" in found["camera 'cam1'"]
    assert "fusecap calibrate board" in found["calibration"]
    assert "--identify" in found["sensors"]
    assert "fusecap calibrate sync" in found["clocks"]


def test_empty_folder_is_told_what_belongs_there(tmp_path):
    (only,) = diagnose(tmp_path)
    assert only.severity == "error" and "no video" in only.found
