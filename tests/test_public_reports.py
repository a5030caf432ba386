"""What people reported of programs of this kind, as inputs: what fusecap says of them.

Each test names its thread; docs/faults.md lists them.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.cli import main
from fusecap.doctor import diagnose
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.folder_survey import survey
from fusecap.sources.session_draft import draft
from fusecap.sources.session_file import load_session
from session_files import calibration_toml, edit, imu_csv, ring, write_session

RIG = ring(4)


def said(folder) -> list[str]:
    return [f"{f.where}: {f.found}; {f.remedy}" for f in diagnose(folder)]


def each_person(folder, change) -> None:
    """`change(points (K, 3))` of everybody whom a camera sees, in place."""
    for path in folder.glob("*.json"):
        document = json.loads(path.read_text())
        for person in document["people"]:
            points = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)
            person["pose_keypoints_2d"] = change(points).ravel().tolist()
        path.write_text(json.dumps(document))


def clockwise(degrees: int, size_px=(1280, 720)):
    width, height = size_px

    def turn(points):
        u, v, confidence = points.T
        new = {
            90: (height - 1 - v, u),
            180: (width - 1 - u, height - 1 - v),
            270: (v, width - 1 - u),
        }
        return np.stack([*new[degrees], confidence], axis=1)

    return turn


def world(capsys, monkeypatch, *arguments):
    monkeypatch.setattr("sys.argv", ["fusecap", "calibrate", "world", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    return end.value.code, capsys.readouterr().err


@pytest.mark.parametrize("degrees", [90, 180])
def test_a_camera_whose_pictures_were_turned_is_told_and_turned(
    tmp_path, capsys, monkeypatch, degrees
):
    """caliscope's rotation_count (perfanalytics/pose2sim #136), PhotonVision/photonvision #1084."""
    write_session(tmp_path, frames=40)
    each_person(tmp_path / "keypoints" / "cam1", clockwise(degrees))
    (told,) = [text for text in said(tmp_path) if "clockwise" in text]
    assert f"turned clockwise by {degrees} deg" in told and f"--turned cam1={degrees}" in told
    old, new = tmp_path / "calibration.toml", tmp_path / "turned.toml"
    code, _ = world(capsys, monkeypatch, old, "--turned", f"cam1={degrees}", "--out", new)
    assert code == 0
    edit(tmp_path / "session.toml", '"calibration.toml"', '"turned.toml"')
    assert said(tmp_path) == []


def test_phones_that_were_all_held_upright_are_told(tmp_path):
    """perfanalytics/pose2sim #31: portrait pictures, a calibration of the sensor."""
    write_session(tmp_path, frames=40)
    for camera in RIG.names:
        each_person(tmp_path / "keypoints" / camera, clockwise(90))
    (told,) = [text for text in said(tmp_path) if text.startswith("calibration: cameras disagree")]
    assert "turned clockwise by 90 deg" in told


def test_a_turned_lens_bends_as_before():
    bent = replace(RIG.cameras[0], distortion=np.array([-0.2, 0.05, 0.01, -0.02, 0.003]))
    points = np.random.default_rng(0).uniform([-1, 0, -1], [1, 2, 1], (40, 3))
    pixels = np.column_stack([bent.project(points), np.ones(40)])
    for degrees in (90, 180, 270):
        turned = clockwise(degrees)(pixels)[:, :2]
        assert np.allclose(bent.turned(degrees).project(points), turned, atol=1e-9)


@pytest.mark.parametrize(("per_metre", "unit"), [(100, "cm"), (1000, "mm")])
def test_a_calibration_in_the_units_of_its_board_is_told_and_drafted(tmp_path, per_metre, unit):
    """zju3dv/EasyMocap #5, lambdaloop/anipose #122: lengths are in whatever the board was."""
    write_session(tmp_path, frames=40)
    (tmp_path / "calibration.toml").write_text(calibration_toml(RIG, unit_per_metre=per_metre))
    (told,) = said(tmp_path)
    assert f'"{unit}"' in told and "5.66 m" in told
    (tmp_path / "session.toml").unlink()
    text = draft(survey(tmp_path))
    if unit == "cm":  # two phones 566 mm apart write the same
        assert "apart by 5.66 m in cm, 0.57 m in mm" in text
        (tmp_path / "session.toml").write_text(text)
        assert load_session(tmp_path).settings.calibration_unit == "m"
        text = text.replace('# calibration_unit = "cm"', 'calibration_unit = "cm"')
    (tmp_path / "session.toml").write_text(text)
    assert load_session(tmp_path).settings.calibration_unit == unit
    assert not [text for text in said(tmp_path) if "rate_hz" not in text]


@pytest.mark.parametrize("apart_m", [0.0005, 0.004])
def test_a_small_error_does_not_make_a_calibration_whose_cameras_stand_together(tmp_path, apart_m):
    """lambdaloop/anipose #41: error below a pixel, cameras millimetres apart, giants or dwarfs."""
    write_session(tmp_path, frames=40)
    first = RIG.cameras[0]
    together = [
        replace(first, name=name, translation=first.translation + [apart_m * i, 0, 0])
        for i, name in enumerate(RIG.names)
    ]
    (tmp_path / "calibration.toml").write_text(calibration_toml(Rig(cameras=tuple(together))))
    assert any("stand at the same place" in t or "of each other" in t for t in said(tmp_path))


def test_a_world_whose_up_is_down_is_told(tmp_path):
    """perfanalytics/pose2sim #118, #99: a board whose axes point into the floor."""
    write_session(tmp_path, frames=40)
    down = RIG.in_world(np.diag([1.0, -1.0, -1.0]))
    (tmp_path / "calibration.toml").write_text(calibration_toml(down))
    told = " ".join(said(tmp_path))
    assert "hang upside down" in told and 'set up = "-y"' in told


def test_cameras_that_were_moved_after_their_calibration_are_told(tmp_path):
    """perfanalytics/pose2sim #150: the calibration of an earlier day was still there."""
    write_session(tmp_path, frames=40)
    moved = RIG.cameras[1]
    shifted = moved.translation + [0.3, 0.1, 0.0]
    rig = Rig(cameras=(RIG.cameras[0], replace(moved, translation=shifted), *RIG.cameras[2:]))
    (tmp_path / "calibration.toml").write_text(calibration_toml(rig))
    (told,) = [text for text in said(tmp_path) if text.startswith("camera 'cam1'")]
    assert "if it was moved" in told


def test_one_camera_of_a_calibration_of_four_is_told(tmp_path):
    """perfanalytics/pose2sim #15: three cameras calibrated, keypoints of one."""
    write_session(tmp_path, frames=40)
    text = (tmp_path / "session.toml").read_text()
    (tmp_path / "session.toml").write_text("[[camera]]".join(text.split("[[camera]]")[:2]))
    assert "depth is not observed" in " ".join(said(tmp_path))


def sensors(folder, *, world_from_ours: Rotation, sign: float = 1.0, flips=None, extra=""):
    """Three sensors of somebody who bends; gravity's reaction is `sign` times what it is."""
    times_s = np.arange(240) / 60
    text = '[session]\nname = "s"\n\n[[subject]]\nname = "anna"\n'
    for bone, speed in (("hips", 0.3), ("left_thigh", 0.8), ("left_shank", 1.1)):
        turned = Rotation.from_rotvec(np.outer(np.sin(speed * times_s), [0.8, 0.3, 0.2]))
        wxyz = np.roll((world_from_ours * turned).as_quat(), 1, axis=1)
        if flips is not None:
            wxyz[flips.random(len(wxyz)) < 0.5] *= -1
        force = sign * turned.inv().apply([0, 9.80665, 0])
        (folder / f"{bone}.csv").write_text(imu_csv(times_s, wxyz, force))
        text += f'\n[[subject.imu]]\nbone = "{bone}"\nfile = "{bone}.csv"\n'
        text += f"bone_from_imu_wxyz = [1, 0, 0, 0]\n{extra}"
    (folder / "session.toml").write_text(text)
    return folder


NED = Rotation.from_euler("x", -90, degrees=True)


def test_sensors_in_a_world_of_north_east_down_are_told_and_read(tmp_path):
    """ManuelPalermo/HumanInertialPose #2, Xinyu-Yi/TransPose #46: ENU, NWU or NED?"""
    (told,) = [t for t in said(sensors(tmp_path, world_from_ours=NED)) if "imu_up" in t]
    assert "gravity points along -z" in told and 'imu_up = "-z"' in told
    sensors(tmp_path, world_from_ours=NED, extra='imu_up = "-z"\n')
    assert not [text for text in said(tmp_path) if "gravity" in text]


def test_accelerometers_with_the_other_sign_are_told(tmp_path):
    z_up = Rotation.from_euler("x", 90, degrees=True)
    told = " ".join(said(sensors(tmp_path, world_from_ours=z_up, sign=-1.0)))
    assert "multiply accelerations by -1" in told


def test_a_wrong_facing_in_the_t_pose_is_told_with_the_key_that_mends_it(tmp_path):
    """jerela/OpenSimLive #27, opensim-org/opensim-core #2781: 90 or 180 degrees off."""
    write_session(tmp_path, frames=60)
    times_s = np.arange(120) / 60
    turned = Rotation.from_euler("y", 0.4 * times_s[:, None])  # as who is filmed turns
    text = '\n[[subject]]\nname = "anna"\ntpose_s = [0, 0.3]\ntpose_facing_deg = FACING\n'
    for bone in ("hips", "left_upper_arm", "left_forearm", "right_upper_arm", "right_forearm"):
        wxyz = np.roll((NED.inv() * turned * Rotation.from_rotvec([0.3, 1, 0])).as_quat(), 1, 1)
        (tmp_path / f"{bone}.csv").write_text(imu_csv(times_s, wxyz))
        text += f'\n[[subject.imu]]\nbone = "{bone}"\nfile = "{bone}.csv"\n'
    session = (tmp_path / "session.toml").read_text()
    (tmp_path / "session.toml").write_text(session + text.replace("FACING", "93"))
    (told,) = [text for text in said(tmp_path) if "limbs that cameras see" in text]
    assert "add about -90 to their heading_deg, or to tpose_facing_deg" in told
    (tmp_path / "session.toml").write_text(session + text.replace("FACING", "3"))
    assert not [text for text in said(tmp_path) if "limbs that cameras see" in text]


def test_quaternions_may_change_their_sign_from_sample_to_sample(tmp_path):
    """andres-fr/emokine #1: q0 becomes -1 now and then; the turn is the same."""
    from fusecap.sources.session_data import open_session

    once, again = tmp_path / "a", tmp_path / "b"
    for folder, flips in ((once, None), (again, np.random.default_rng(1))):
        folder.mkdir()
        sensors(folder, world_from_ours=NED.inv(), flips=flips)
    turned = [
        [open.imus[0].reading(i).bone_rotation_in_world for i in range(0, 200, 17)]
        for open in (open_session(load_session(once)), open_session(load_session(again)))
    ]
    assert np.allclose(turned[0], turned[1], atol=1e-6)


def test_a_turned_camera_keeps_its_place(tmp_path, capsys, monkeypatch):
    write_session(tmp_path, frames=40)
    old, new = tmp_path / "calibration.toml", tmp_path / "new.toml"
    code, errors = world(capsys, monkeypatch, old, "--turned", "cam1=45", "--out", new)
    assert code == 2 and "45" in errors
    world(capsys, monkeypatch, old, "--turned", "cam1=270", "--out", new)
    turned = load_rig(new)["cam1"]
    assert turned.size_px == (720, 1280)
    assert np.allclose(turned.position_in_world, RIG["cam1"].position_in_world)
