"""What is said about inputs that contradict themselves, by doctor and by solve alike."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from fusecap.batch.solve import solve_session
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.checks.keypoints import UNMEASURED
from fusecap.checks.people import _check_stature, _check_upright
from fusecap.cli import app
from fusecap.doctor import diagnose
from fusecap.errors import CalibrationError, SessionError
from fusecap.findings import Findings
from fusecap.geometry.camera import Rig
from fusecap.solve.body_measure import BodyMeasure
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.session import Session
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from session_files import calibration_toml, camera_at, edit, imu_csv, ring, write_session

BODY25 = landmark_set_named("body25")


def said(path):
    return [str(finding) for finding in diagnose(path) if finding.severity != "info"]


def each_person(folder, change, cameras="*"):
    """`change` of (25, 3) in place, in the keypoints of these cameras."""
    for file in folder.glob(f"keypoints/{cameras}/*.json"):
        document = json.loads(file.read_text())
        for person in document["people"]:
            points = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)
            person["pose_keypoints_2d"] = change(points).ravel().tolist()
        file.write_text(json.dumps(document))


def mirrored(points):
    return points[BODY25.mirror]


def test_one_camera_that_takes_left_for_right_is_named_as_such(tmp_path):
    path = write_session(tmp_path)
    each_person(tmp_path, mirrored, "cam2")
    (only,) = said(path)
    assert only.startswith("camera 'cam2'") and "left and right exchanged" in only


def test_left_for_right_in_all_views_is_told_by_where_people_look(tmp_path):
    path = write_session(tmp_path)
    each_person(tmp_path, mirrored)
    (only,) = said(path)
    assert "exchanged in all views: 100%" in only


@pytest.mark.parametrize("frames", [-6, 3, 10])
def test_a_camera_late_by_a_tenth_to_a_third_of_a_second_is_told_its_offset(tmp_path, frames):
    path = write_session(tmp_path, frames=120)
    edit(path, 'name = "cam1"', f'name = "cam1"\noffset_s = {frames / 30:.4f}')
    (only,) = [text for text in said(path) if "disagrees" in text]
    assert only.startswith("camera 'cam1'")
    found = float(only.split("add about ")[1].split(" s ")[0])
    assert found == pytest.approx(-frames / 30, abs=0.05)


@pytest.mark.parametrize("scale", [0.5, 1.5])
def test_keypoints_of_another_resolution_are_told_which(tmp_path, scale):
    path = write_session(tmp_path)
    each_person(tmp_path, lambda points: points * [scale, scale, 1.0])
    assert any(
        f"as of {1280 * scale:.0f} x {720 * scale:.0f} pictures" in text for text in said(path)
    )


def test_one_camera_of_another_resolution_is_told_which(tmp_path):
    path = write_session(tmp_path)
    each_person(tmp_path, lambda points: points * [0.5, 0.5, 1.0], "cam3")
    (only,) = [text for text in said(path) if "disagrees" in text]
    assert "camera 'cam3'" in only and "as of 640 x 360 pictures" in only


@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_stated_statures_tell_the_scale_of_a_calibration(tmp_path, factor):
    path = write_session(tmp_path)
    edit(path, "[[camera]]", '[[subject]]\nname = "A"\nheight_m = 1.75\n\n[[camera]]')
    assert said(path) == []
    (tmp_path / "calibration.toml").write_text(calibration_toml(ring(), unit_per_metre=factor))
    assert any(f"{factor:.2f} times too large" in text for text in said(path))


def test_stated_bone_lengths_tell_it_too(tmp_path):
    path = write_session(tmp_path)
    lengths = "bone_lengths_m = { left_shank = 0.29, left_foot = 0.29, right_hand = 0.17 }"
    edit(path, "[[camera]]", f'[[subject]]\nname = "A"\n{lengths}\n\n[[camera]]')
    assert any("the session states 1.1" in text for text in said(path))


def test_people_upside_down_before_upright_cameras_are_no_reason_to_turn_the_world(tmp_path):
    path = write_session(tmp_path)
    turned = ring()
    for camera in turned.cameras:
        folder = tmp_path / "keypoints" / camera.name
        for file in folder.iterdir():
            people = json.loads(file.read_text())["people"]
            for person in people:
                points = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)
                points[:, 1] = 2 * points[8, 1] - points[:, 1]
                person["pose_keypoints_2d"] = points.ravel().tolist()
            file.write_text(json.dumps({"people": people}))
    assert not any("away from up" in text for text in said(path))


@pytest.mark.parametrize(("facing_deg", "told"), [(90, False), (200, False), (0, True)])
def test_who_lies_below_cameras_at_the_ceiling_lies_and_the_world_stands(facing_deg, told):
    lying = Rotation.from_euler("xy", [-90, facing_deg], degrees=True)
    shape = BodyShape.from_height(PAPER21, 1.7)
    posed = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
    rest = landmarks_in_world(*posed, BODY25.bones(PAPER21), BODY25.offsets_m(shape))[0]
    people = np.repeat(lying.apply(rest)[None], 20, axis=0)
    cameras = [
        camera_at(f"c{i}", [x, 3.0, 0.01], target_m=[x, 0.0, 0.0]) for i, x in enumerate((-1, 1))
    ]
    session = Session.model_validate(
        {"session": {"name": "sleep"}, "camera": [{"name": "c", "keypoints": "k"}]},
        context={"file": Path("session.toml")},
    )
    findings = Findings()
    _check_upright(session, Rig(cameras=tuple(cameras)), people, BODY25, findings)
    assert any("away from up" in str(finding) for finding in findings) is told


@pytest.mark.parametrize(
    ("higher_m", "told"), [(0.0, False), (0.1, False), (-0.1, False), (0.2, True), (-0.2, True)]
)
def test_a_floor_that_is_off_by_a_fifth_of_a_metre_is_told(higher_m, told):
    """However often feet are lifted, and with some people where nobody is."""
    shape = BodyShape.from_height(PAPER21, 1.7)
    posed = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
    rest = landmarks_in_world(*posed, BODY25.bones(PAPER21), BODY25.offsets_m(shape))[0]
    ankles = [BODY25.index(f"{side}_ankle") for side in ("left", "right")]
    people = np.repeat(rest[None], 20, axis=0)
    people[:, :, 1] += 0.09 + higher_m - rest[ankles, 1].min()
    people[::2, ankles[0], 1] += 0.4
    people[:5, ankles, 1] += 0.3
    people[5:10, :, 1] -= 0.6
    session = Session.model_validate(
        {"session": {"name": "stand"}, "camera": [{"name": "c", "keypoints": "k"}]},
        context={"file": Path("session.toml")},
    )
    findings = Findings()
    _check_upright(session, ring(), people, BODY25, findings)
    assert any("from the floor" in str(finding) for finding in findings) is told


@pytest.mark.parametrize("worn", [(), ("thigh", "shank")])
def test_limbs_that_nothing_measures_are_told(tmp_path, worn):
    path = write_session(tmp_path)
    ends = [f"{side}_{end}" for end in ("knee", "ankle") for side in ("left", "right")]

    def without_legs(points):
        points[[BODY25.index(end) for end in ends]] = 0
        return points

    each_person(tmp_path, without_legs)
    if worn:
        tables = [
            f'[[subject.imu]]\nbone = "{side}_{bone}"\nfile = "x.csv"\n'
            for bone in worn
            for side in ("left", "right")
        ]
        path.write_text(f'{path.read_text()}\n[[subject]]\nname = "a"\n{"".join(tables)}')
    told = [text for text in said(path) if UNMEASURED in text]
    assert [", ".join(ends) in text for text in told] == ([] if worn else [True])


def test_a_subject_who_was_never_found_is_told(tmp_path):
    path = write_session(tmp_path)
    edit(path, "[[camera]]", '[[subject]]\nname = "far"\nstart_m = [40.0, 40.0]\n\n[[camera]]')
    notes = solve_session(open_session(load_session(path))).report.notes
    assert any(note.startswith("far: never found") for note in notes)


def test_an_unstated_rate_is_said_to_be_assumed(tmp_path):
    path = write_session(tmp_path)
    edit(path, "rate_hz = 30\n", "")
    assert any("60 Hz is assumed" in text for text in said(path))


def test_a_detector_that_skips_frames_makes_a_slower_camera(tmp_path):
    path = write_session(tmp_path)
    for file in (tmp_path / "keypoints").glob("*/*.json"):
        if int(file.stem.split("_")[1]) % 3:
            file.unlink()
    data = open_session(load_session(path))
    assert all(track.step == 3 and track.rate_hz == pytest.approx(10) for track in data.keypoints)
    assert all(len(people) == 1 for people in data.detections(20).people)
    assert any("every 3. frame" in text for text in said(path))


def sensors(folder, turning_deg=0.0, extra=""):
    times_s = np.arange(120) / 60
    angle = np.radians(np.linspace(0, turning_deg, 120))
    quaternion = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    text = '[session]\nname = "a"\n' + extra + '[[subject]]\nname = "A"\n'
    text += "" if extra else "tpose_s = [0.5, 1.5]\n"
    for bone in ("hips", "left_foot"):
        (folder / f"{bone}.csv").write_text(imu_csv(times_s, quaternion))
        text += f'[[subject.imu]]\nbone = "{bone}"\nfile = "{bone}.csv"\n'
    (folder / "session.toml").write_text(text)
    return folder


@pytest.mark.parametrize(("turning_deg", "refused"), [(20.0, False), (144.0, True)])
def test_a_tpose_in_which_sensors_turn_is_refused(tmp_path, turning_deg, refused):
    folder = sensors(tmp_path, turning_deg)
    if refused:
        with pytest.raises(SessionError, match="within tpose_s"):
            open_session(load_session(folder))
        assert any("within tpose_s" in text for text in said(folder))
    else:
        open_session(load_session(folder))


def test_a_sensor_that_calibration_could_not_place_is_left_out(tmp_path):
    folder = sensors(tmp_path, extra='imu_calibration = "imus.toml"\n')
    (folder / "imus.toml").write_text(
        'format = "fusecap imu calibration 1"\norigin = "motion"\n[[imu]]\nsubject = "A"\n'
        'bone = "hips"\nbone_from_imu_wxyz = [1.0, 0.0, 0.0, 0.0]\nheading_deg = 0.0\n'
    )
    data = open_session(load_session(folder))
    assert [imus.bones for imus in data.imus] == [("hips",)]
    assert any("left out: left_foot" in str(finding) for finding in data.findings)


def test_cameras_that_are_not_used_are_not_judged(tmp_path):
    path = tmp_path / "calibration.toml"
    text = calibration_toml(ring())
    path.write_text(text.replace("[cam3]", "[cam3]\nfisheye = true"))
    with pytest.raises(CalibrationError, match="fisheye"):
        load_rig(path)
    assert load_rig(path, names=["cam0", "cam1"]).names == ("cam0", "cam1")
    with pytest.raises(CalibrationError, match=r"no camera 'left'.*cam0, cam1"):
        load_rig(path, names=["left"])


def test_a_calibration_of_lenses_alone_is_refused_before_anything_is_detected(tmp_path):
    path = write_session(tmp_path, frames=3)
    lenses = re.sub(r"(rotation|translation) = .*", r"\1 = [0, 0, 0]", calibration_toml(ring()))
    (tmp_path / "calibration.toml").write_text(lenses)
    assert any("lenses only" in text for text in said(path))
    with pytest.raises(SessionError, match=r"lenses only.*\n.*--anyway"):
        CliRunner().invoke(app, ["solve", str(path)], catch_exceptions=False)


@pytest.mark.parametrize("height_m", [0.6, 0.8, 1.2, 1.75, 2.3])
def test_people_from_small_children_to_giants_are_measured(height_m):
    measure = BodyMeasure(PAPER21, BODY25)
    shape = BodyShape.from_height(PAPER21, height_m)
    position, rotation = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
    points = landmarks_in_world(position, rotation, BODY25.bones(PAPER21), BODY25.offsets_m(shape))[
        0
    ]
    for _ in range(10):
        measure.add(points)
    assert measure.shape().height_m == pytest.approx(height_m, rel=0.01)
    assert np.allclose(measure.shape().offsets_m, shape.offsets_m, atol=0.02 * height_m)


def test_a_child_beside_an_adult_is_no_scale():
    landmarks = landmark_set_named("body25")
    rng = np.random.default_rng(0)
    shape = BodyShape.from_height(PAPER21, 1.0)
    posed = forward_kinematics(shape, np.zeros((1, PAPER21.pose_size)))
    bones, offsets_m = landmarks.bones(PAPER21), landmarks.offsets_m(shape)
    rest = landmarks_in_world(*posed, bones, offsets_m)[0]
    heights_m = np.repeat([1.8, 1.2], [60, 60])
    people = heights_m[:, None, None] * rest + 0.015 * rng.standard_normal((120, 25, 3))
    session = Session.model_validate(
        {
            "session": {"name": "two"},
            "camera": [{"name": "c", "keypoints": "k"}],
            "subject": [{"name": "a", "height_m": 1.8}, {"name": "b", "height_m": 1.2}],
        },
        context={"file": Path("session.toml")},
    )
    findings = Findings()
    _check_stature(session, people, landmarks, findings)
    assert not findings.sorted()
