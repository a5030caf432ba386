"""Files as programs and computers in the field write them, and what `init` makes of folders."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LANDMARK_SETS, landmark_set_named
from fusecap.errors import InputError
from fusecap.sources.folder_survey import survey
from fusecap.sources.imu_files import imu_format_of, read_imu, sensor_names
from fusecap.sources.sensor_bones import bone_of
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_data import open_session
from fusecap.sources.session_draft import draft
from fusecap.sources.session_file import load_session, parse_session
from session_files import calibration_toml, edit, imu_csv, ring, write_session
from video_files import write_video

TIMES_S = np.arange(20) / 50
TURNED = Rotation.from_rotvec(np.linspace(0, 1, 20)[:, None] * [0.3, 1.0, -0.2])
UP = TURNED.inv().apply([0.0, 0.0, 9.80665])


def wxyz(rotation):
    return rotation.as_quat()[:, [3, 0, 1, 2]]


def plain_rows():
    return [line.split(",") for line in imu_csv(TIMES_S, wxyz(TURNED)).strip().split("\n")]


def same_samples(track):
    read = Rotation.from_quat(track.orientation_wxyz[:, [1, 2, 3, 0]])
    assert np.degrees((read.inv() * TURNED).magnitude()).max() < 1e-3
    assert np.allclose(track.accel_m_s2, UP, atol=1e-4)
    assert np.allclose(track.times_s, TIMES_S, atol=2e-6)
    return True


@pytest.mark.parametrize(
    ("delimiter", "comma", "encoding", "quote"),
    [
        (";", True, "utf-8", ""),
        ("\t", True, "utf-8", ""),
        (",", True, "utf-8", '"'),
        (",", False, "utf-16", ""),
        (",", False, "utf-8-sig", ""),
        (",", False, "utf-8", '"'),
        ("\t", True, "utf-16", '"'),
    ],
)
def test_tables_of_other_computers_are_read(tmp_path, delimiter, comma, encoding, quote):
    rows = [
        [quote + (cell.replace(".", ",") if comma else cell) + quote for cell in row]
        for row in plain_rows()
    ]
    path = tmp_path / "imu.csv"
    path.write_text("\n".join(delimiter.join(row) for row in rows) + "\n", encoding=encoding)
    assert imu_format_of(path) == "csv"
    assert same_samples(read_imu(path, format="csv"))


def test_commas_in_numbers_and_between_cells_are_refused(tmp_path):
    path = tmp_path / "imu.csv"
    header, *rows = plain_rows()
    rows = [[f"{float(cell):.4f}".replace(".", ",") for cell in row] for row in rows]
    path.write_text("\n".join(",".join(row) for row in [header, *rows]) + "\n")
    with pytest.raises(InputError, match="decimal sign is a comma"):
        read_imu(path, format="csv")


@pytest.mark.parametrize(
    ("unit", "per_second", "epoch"),
    [("ms", 1e3, 0), ("us", 1e6, 0), ("ms", 1e3, 1.55e9), ("us", 1e6, 1.55e9), ("ns", 1e9, 0)],
)
def test_times_have_the_unit_of_their_column_and_may_count_from_1970(
    tmp_path, unit, per_second, epoch
):
    header, *rows = plain_rows()
    for row in rows:
        row[0] = f"{(float(row[0]) + epoch) * per_second:.3f}"
    units = ["ms", *[""] * 7]
    path = tmp_path / "imu.csv"
    lines = [[f"time_{unit}", *header[1:]], units, *rows]
    path.write_text("\n".join(",".join(row) for row in lines) + "\n")
    assert same_samples(read_imu(path, format="csv"))


@pytest.mark.parametrize("euler", [False, True])
@pytest.mark.parametrize("free", [False, True])
def test_dot_is_read_in_every_payload_mode(tmp_path, euler, free):
    head = "Euler_X,Euler_Y,Euler_Z" if euler else "Quat_W,Quat_X,Quat_Y,Quat_Z"
    angles = TURNED.as_euler("xyz", degrees=True) if euler else wxyz(TURNED)
    accel = TURNED.apply(UP) - [0, 0, 9.80665] if free else UP
    names = ",".join(("FreeAcc_" if free else "Acc_") + axis for axis in "XYZ")
    lines = ["sep=,", "SyncStatus:,Synced", f"PacketCounter,SampleTimeFine,{head},{names}"]
    for k, t in enumerate(TIMES_S):
        cells = ",".join(f"{v:.7f}" for v in [*angles[k], *accel[k]])
        lines.append(f"{k + 1},{5_000_000 + round(t * 1e6)},{cells}")
    path = tmp_path / "dot.csv"
    path.write_text("\n".join(lines) + "\n")
    assert imu_format_of(path) == "xsens-dot"
    assert same_samples(read_imu(path, format="xsens-dot"))


def test_accelerations_never_vanish_without_a_note(tmp_path):
    lines = ["PacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z,dv_acc_1"]
    lines += [f"{k},{k * 16667},1,0,0,0,9.8" for k in range(5)]
    path = tmp_path / "dot.csv"
    path.write_text("\n".join(lines) + "\n")
    (note,) = read_imu(path, format="xsens-dot").notes
    assert "no accelerations were read: dv_acc_1" in note
    header, *rows = plain_rows()
    path.write_text("\n".join(",".join([*row[:5], "x", "x", "x"]) for row in [header, *rows]))
    path.write_text(path.read_text().replace("qz,x,x,x", "qz,ax,ay,az"))
    (note,) = read_imu(path, format="csv").notes
    assert "none of their cells is a number" in note


def apdm_format7(sensors):
    lines = [["Format=7"], ["Time"], [""]]
    for number, name in enumerate(sensors):
        lines[0] += [str(5700 + number), "", "", name, "", "", "", ""]
        lines[1] += ["Accelerometer", "", "", "Barometer", "Orientation", "", "", ""]
        lines[2] += ["X", "Y", "Z", "", "S", "X", "Y", "Z"]
    for k, t in enumerate(TIMES_S):
        cells = [*UP[k], 4.6e18, *wxyz(TURNED)[k]]
        other = [0.0, 0.0, 9.8, 4.6e18, 1.0, 0.0, 0.0, 0.0]
        row = [str(1550879504438281 + round(t * 1e6))]
        for name in sensors:
            row += [f"{v:.7f}" for v in (cells if name == "Right Ankle" else other)]
        lines.append(row)
    return "\n".join(",".join(line) for line in lines) + "\n"


def test_apdm_format_7_is_read_by_the_names_of_its_first_line(tmp_path):
    path = tmp_path / "opal.csv"
    path.write_text(apdm_format7(["Lumbar", "Right Ankle"]))
    assert imu_format_of(path) == "apdm-csv"
    assert sensor_names(path, "apdm-csv") == ("Lumbar", "Right Ankle")
    assert same_samples(read_imu(path, format="apdm-csv", sensor="Right Ankle"))


@pytest.mark.parametrize(
    ("head", "format"),
    [
        ("PacketCounter\tSampleTimeFine\tAcc_X\tQuat_q0\tQuat_q1", "xsens-mt"),
        ("PacketCounter\tSampleTimeFine\tYear\tMat[1][1]\tMat[2][1]", "xsens-mt"),
        ("PacketCounter,SampleTimeFine,Roll,Pitch,Yaw", "xsens-mt"),
        ("PacketCounter,SampleTimeFine,Euler_X,Euler_Y", "xsens-dot"),
        ("PacketCounter,SampleTimeFine,Quat_W,Quat_X", "xsens-dot"),
    ],
)
def test_mt_manager_and_dot_are_told_apart_by_their_columns(tmp_path, head, format):
    path = tmp_path / "sensor.txt"
    path.write_text(head + "\n")
    assert imu_format_of(path) == format


def test_sensors_that_do_not_share_a_clock_start_together(tmp_path):
    text = '[session]\nname = "a"\nrate_hz = 50\n[[subject]]\nname = "A"\n'
    for bone, first in (("hips", 1_000_000), ("head", 900_000_000)):
        lines = ["PacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z"]
        lines += [f"{k},{first + k * 20000},1,0,0,0" for k in range(200)]
        (tmp_path / f"{bone}.csv").write_text("\n".join(lines) + "\n")
        text += f'[[subject.imu]]\nbone = "{bone}"\nfile = "{bone}.csv"\nformat = "xsens-dot"\n'
        text += "bone_from_imu_wxyz = [1, 0, 0, 0]\n"
    (tmp_path / "session.toml").write_text(text)
    data = open_session(load_session(tmp_path))
    assert np.ptp(data.times_s) == pytest.approx(3.98, abs=0.05)
    assert any("do not share a clock (hips, head)" in str(f) for f in data.findings)


@pytest.mark.parametrize(
    ("name", "bone"),
    [
        ("Participant8_left_shank", "left_shank"),
        ("subject8_RThigh", "right_thigh"),
        ("left_foot_8", "left_foot"),
        ("redhead_right_hand", "right_hand"),
        ("chestnut_left_thigh", "left_thigh"),
        ("P1_L5", "hips"),
        ("Lumbar", "hips"),
        ("Right Ankle", "right_shank"),
        ("LEFT_KNEE", "left_thigh"),
        ("WAIST", "hips"),
        ("right_shin", "right_shank"),
        ("Trunk", "spine3"),
        ("left_hip", None),
        ("S1_walk", None),
        ("handheld", None),
    ],
)
def test_names_are_read_by_whole_words(name, bone):
    assert bone_of(name) == bone


@pytest.mark.parametrize("name", sorted(LANDMARK_SETS))
def test_keypoints_of_every_known_set_are_told_by_their_number(tmp_path, name):
    landmarks = landmark_set_named(name)
    path = write_session(tmp_path, frames=3)
    keypoints = np.zeros((landmarks.keypoint_count, 3))
    columns = landmarks.columns or range(len(landmarks.landmark_names))
    keypoints[list(columns)] = [[100.0 + k, 50.0, 0.9] for k in range(len(columns))]
    for file in (tmp_path / "keypoints").glob("*/*.json"):
        person = {"pose_keypoints_2d": keypoints.ravel().tolist()}
        file.write_text(json.dumps({"people": [person]}))
    if name == "body25b":
        edit(path, "[[camera]]", '[[camera]]\nformat = "openpose-body25b"')
        path.write_text(path.read_text().replace('cam1"\n', 'cam1"\nformat = "openpose-body25b"\n'))
        return
    data = open_session(load_session(tmp_path))
    assert data.landmarks.landmark_names == landmarks.landmark_names
    assert data.keypoints[0].people[0][0, :, 0].tolist() == [100.0 + k for k in range(len(columns))]


def test_old_key_of_openpose_is_read(tmp_path):
    write_session(tmp_path, frames=3)
    for file in (tmp_path / "keypoints").glob("*/*.json"):
        file.write_text(file.read_text().replace("pose_keypoints_2d", "pose_keypoints"))
    assert len(open_session(load_session(tmp_path)).keypoints[0].people[0]) == 1


def test_unknown_number_of_keypoints_is_told_the_known_ones(tmp_path):
    write_session(tmp_path, frames=1)
    for file in (tmp_path / "keypoints").glob("*/*.json"):
        file.write_text(json.dumps({"people": [{"pose_keypoints_2d": [1.0] * 63}]}))
    with pytest.raises(InputError, match=r"21 keypoints.*openpose-halpe26"):
        open_session(load_session(tmp_path))


def test_calibration_that_places_cameras_and_floor_is_chosen(tmp_path):
    path = write_session(tmp_path, frames=3)
    path.unlink()
    rig = ring()
    lenses = re.sub(r"(rotation|translation) = .*", r"\1 = [0, 0, 0]", calibration_toml(rig))
    (tmp_path / "a_lenses.toml").write_text(lenses)
    (tmp_path / "world.toml").write_text(calibration_toml(rig))
    found = survey(tmp_path)
    assert str(found.calibration) == "world.toml"
    assert {str(other) for other in found.other_calibrations} == {
        "a_lenses.toml",
        "calibration.toml",
    }
    assert "not chosen: calibration.toml, a_lenses.toml" in draft(found)


def test_videos_stay_beside_their_keypoints_and_give_the_rate(tmp_path):
    path = write_session(tmp_path, frames=3)
    path.unlink()
    for camera in ring().cameras:
        write_video(tmp_path / f"{camera.name}.mp4", frames=6, rate_hz=25)
    write_video(tmp_path / "cam1_overlay.mp4", frames=2, rate_hz=25)
    found = survey(tmp_path)
    assert [str(made) for made in found.made] == ["cam1_overlay.mp4"]
    (tmp_path / "session.toml").write_text(draft(found))
    session = parse_session(tmp_path)
    assert session.settings.rate_hz == 25
    assert all(camera.video and camera.keypoints for camera in session.cameras)
    assert len(session.cameras) == 4
    text = (tmp_path / "session.toml").read_text()
    unstated = [line for line in text.splitlines() if not line.startswith("rate_hz")]
    (tmp_path / "session.toml").write_text("\n".join(unstated))
    assert with_detections(parse_session(tmp_path)).settings.rate_hz == 25
