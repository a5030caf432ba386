"""`fusecap init`: what a folder holds becomes a session file that loads."""

from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from fusecap.cli import app
from fusecap.errors import InputError, SessionError
from fusecap.sources.folder_survey import survey
from fusecap.sources.sensor_bones import bone_of
from fusecap.sources.session_draft import draft
from fusecap.sources.session_file import load_session, parse_session


@pytest.mark.parametrize(
    ("name", "bone"),
    [
        ("S02-Trial-Walk-1-L_LowLeg", "left_shank"),
        ("LTibia_20210820_202113_811", "left_shank"),
        ("femur_r_imu", "right_thigh"),
        ("RightForeArm", "right_forearm"),
        ("L_UpArm", "left_upper_arm"),
        ("right_lower_arm", "right_forearm"),
        ("Sternum", "spine3"),
        ("torso_imu", "spine3"),
        ("Pelvis", "hips"),
        ("RightToe", "right_toes"),
        ("calcn_l_imu", "left_foot"),
        ("RightArm", "right_upper_arm"),
        ("LeftLeg", "left_shank"),
        ("MT_012005D6_009-001_00B421EF", None),
        ("Static", None),
        ("arm", None),
    ],
)
def test_bone_is_read_from_the_sensors_name(name, bone):
    assert bone_of(name) == bone


def keypoint_folder(folder, values):
    folder.mkdir(parents=True)
    person = {"pose_keypoints_2d": [1.0] * values}
    (folder / "a_000000000000_keypoints.json").write_text(json.dumps({"people": []}))
    (folder / "a_000000000001_keypoints.json").write_text(json.dumps({"people": [person]}))


def test_draft_of_keypoints_and_sensors_is_a_session_that_loads(tmp_path):
    keypoint_folder(tmp_path / "left_json", 78)
    keypoint_folder(tmp_path / "right_json", 78)
    (tmp_path / "calibration.toml").write_text("")
    imu = tmp_path / "imu"
    imu.mkdir()
    (imu / "L_Foot.csv").write_text("time_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    (imu / "00B4.csv").write_text("time_s,qw,qx,qy,qz\n0,1,0,0,0\n")
    found = survey(tmp_path)
    assert found.keypoint_format == "openpose-halpe26"
    (tmp_path / "session.toml").write_text(draft(found))
    session = load_session(tmp_path)
    assert [camera.name for camera in session.cameras] == ["left", "right"]
    assert [imu.bone for imu in session.subjects[0].imus] == ["left_foot"]
    assert "00B4.csv" in (tmp_path / "session.toml").read_text()


@pytest.mark.parametrize(("accel", "up"), [("0,9.8,0", "y"), ("0,0,9.8", "z"), ("0,-9.8,0", "z")])
def test_up_axis_of_sensors_is_read_from_their_accelerations(tmp_path, accel, up):
    rows = "".join(f"{row / 60},1,0,0,0,{accel}\n" for row in range(20))
    for bone in ("head", "hips"):
        (tmp_path / f"{bone}.csv").write_text(f"time_s,qw,qx,qy,qz,ax,ay,az\n{rows}")
    (tmp_path / "session.toml").write_text(draft(survey(tmp_path)))
    assert [imu.imu_up for imu in load_session(tmp_path).subjects[0].imus] == [up, up]


def test_command_writes_once_and_never_over_a_session(tmp_path):
    (tmp_path / "cam1.mp4").write_bytes(b"")
    result = CliRunner().invoke(app, ["init", str(tmp_path)])
    assert result.exit_code == 0 and "cam1.mp4" in (tmp_path / "session.toml").read_text()
    again = CliRunner().invoke(app, ["init", str(tmp_path)])
    assert isinstance(again.exception, SessionError)


def test_networks_that_are_here_are_named_where_videos_need_them(tmp_path, monkeypatch):
    cache = tmp_path / "cache" / "models"
    cache.mkdir(parents=True)
    monkeypatch.setenv("FUSECAP_CACHE", str(cache.parent))

    def drafted(name):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "cam1.mp4").write_bytes(b"")
        assert CliRunner().invoke(app, ["init", str(folder)]).exit_code == 0
        return parse_session(folder).detector

    assert drafted("nothing").model is None
    for file in ("blazepose-lite.tflite", "blazepose-full.tflite", "blazepose-person.tflite"):
        (cache / file).touch()
    blaze = drafted("blazepose")
    assert (blaze.model, blaze.person_model) == ("blazepose-full", "blazepose-person")
    (cache / "rtmo-s.onnx").touch()
    assert (drafted("whole").model, drafted("again").person_model) == ("rtmo-s", None)
    for file in ("rtmpose-m-halpe26.onnx", "rtmdet-nano-person.onnx"):
        (cache / file).touch()
    assert drafted("usual").model is None
    only_keypoints = survey(tmp_path / "nothing")
    keypoint_folder(tmp_path / "nothing" / "cam1_json", 78)
    assert "[detector]" in draft(only_keypoints, {"model": "rtmo-s"})
    assert "[detector]" not in draft(survey(tmp_path / "nothing"), {"model": "rtmo-s"})


def test_folder_without_a_recording_is_refused_with_words(tmp_path):
    with pytest.raises(InputError, match="no video"):
        draft(survey(tmp_path))
    with pytest.raises(InputError, match="no such folder"):
        survey(tmp_path / "nowhere")
