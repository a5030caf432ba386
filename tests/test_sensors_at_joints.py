"""Sensors of one person held against each other, without a camera."""

import re
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.doctor import diagnose
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    path = write_session(demo_scene(seconds=3.0), folder)
    tables = re.split(r"\n(?=\[\[)", path.read_text())
    text = "\n".join(table for table in tables if not table.startswith("[[camera]]"))
    path.write_text(text.replace('calibration = "calibration.toml"\n', ""))
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "spoilt")
    return tmp_path / "spoilt"


def said(folder):
    texts = [str(finding) for finding in diagnose(folder) if finding.severity == "warning"]
    return [text for text in texts if "samples lost" not in text]


def each_table(folder, change, who="anna_left_shank"):
    files = sorted((folder / "imus").glob(f"{who}.csv"))
    assert files
    for number, path in enumerate(files):
        table = np.loadtxt(path, delimiter=",", skiprows=1)
        header = path.read_text().split("\n", 1)[0]
        table = change(number, table)
        np.savetxt(path, table, fmt="%.9f", delimiter=",", header=header, comments="")


def turned(of_sensor):
    """Mounted otherwise by a rotation, in the sensor's frame."""

    def change(_, table):
        orientation = Rotation.from_quat(table[:, [2, 3, 4, 1]]) * of_sensor
        table[:, 1:5] = orientation.as_quat()[:, [3, 0, 1, 2]]
        table[:, 5:8] = of_sensor.inv().apply(table[:, 5:8])
        return table

    return change


def test_nothing_is_said_of_sensors_that_belong_together(sound):
    assert said(sound) == []


def test_bones_that_only_a_larger_skeleton_has_are_left_to_others(folder):
    path = folder / "session.toml"
    text = path.read_text().replace("[session]\n", '[session]\nskeleton = "extended23"\n', 1)
    text = text.replace('bone = "left_upper_arm"', 'bone = "left_clavicle"', 1)
    path.write_text(text)
    assert "left_clavicle" in text
    assert not [text for text in said(folder) if "clavicle" in text]


@pytest.mark.parametrize(
    ("who", "late_s"), [("anna_left_shank", 0.1), ("anna_hips", 1.0), ("ben_right_forearm", -0.4)]
)
def test_a_late_sensor_is_told_by_how_much(folder, who, late_s):
    each_table(folder, lambda _, table: table + np.eye(1, table.shape[1]) * late_s, who)
    (only,) = said(folder)
    name, bone = who.split("_", 1)
    assert only.startswith(f"imu '{bone}' of '{name}'")
    assert "does not move as its neighbours do" in only
    found = float(re.search(r"add about ([+-][\d.]+) s to its offset_s", only)[1])
    assert found == pytest.approx(-late_s, abs=0.05)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("anna_left_shank", "ben_head"),
        ("anna_left_shank", "anna_right_forearm"),
        ("ben_left_forearm", "ben_right_forearm"),
    ],
)
def test_exchanged_sensors_are_told(folder, one, other):
    first, second = (folder / "imus" / f"{name}.csv" for name in (one, other))
    a, b = first.read_text(), second.read_text()
    first.write_text(b)
    second.write_text(a)
    text = "\n".join(said(folder))
    names = [f"imu '{bone}' of '{name}'" for name, bone in (w.split("_", 1) for w in (one, other))]
    assert any(f"exchange its file with that of {name}" in text for name in names)


def test_a_heading_of_one_sensor_is_told(folder):
    path = folder / "session.toml"
    file = 'file = "imus/ben_left_forearm.csv"\n'
    path.write_text(path.read_text().replace(file, f"{file}heading_deg = 70\n"))
    (only,) = said(folder)
    found = float(re.search(r"add about ([+-]\d+) to its heading_deg", only)[1])
    assert only.startswith("imu 'left_forearm' of 'ben'") and found == pytest.approx(-70, abs=10)


def slipped(folder, axis, angle_deg):
    """The left shank's sensor, turned about an axis of the bone."""
    session = (folder / "session.toml").read_text()
    mounting = session[session.index("anna_left_shank.csv") :]
    w, x, y, z = map(float, re.search(r"bone_from_imu_wxyz = \[(.*)\]", mounting)[1].split(", "))
    bone_from_imu = Rotation.from_quat([x, y, z, w])
    slip = Rotation.from_euler(axis, angle_deg, degrees=True)
    each_table(folder, turned(bone_from_imu.inv() * slip * bone_from_imu))


@pytest.mark.parametrize(("axis", "angle_deg"), [("z", 60), ("x", 40)])
def test_a_sensor_across_its_limb_is_told(folder, axis, angle_deg):
    slipped(folder, axis, angle_deg)
    (only,) = said(folder)
    found = re.search(r"imu 'left_shank' of 'anna': sits otherwise .* points (\d+) deg", only)
    assert float(found[1]) == pytest.approx(angle_deg, abs=12)


def test_a_sensor_turned_about_its_limb_bends_joints_as_nobody_does(folder):
    slipped(folder, "y", 120)
    (only,) = said(folder)
    assert "joints are bent as hardly anybody's are at the typical instant" in only
    assert "left_thigh to left_shank" in only


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_times_of_another_rate_move_joints_apart(folder, factor):
    def scaled(_, table):
        table[:, 0] *= factor
        return table

    each_table(folder, scaled, "anna_*")
    (only,) = [text for text in said(folder) if "joints lie" in text]
    found = float(re.search(r"with times ([\d.]+) times as long", only)[1])
    assert found == pytest.approx(1 / factor, rel=0.25)


def test_rows_that_are_missing_part_joints(folder):
    def renumbered(number, table):
        kept = table[np.random.default_rng(number).random(len(table)) > 0.4]
        kept[:, 0] = table[: len(kept), 0]
        return kept

    each_table(folder, renumbered, "anna_*")
    text = "\n".join(said(folder))
    assert "do not move as if their bones hung together at joints" in text or "joints lie" in text


def test_an_accelerometer_of_twice_the_range_is_told(folder):
    def doubled(_, table):
        table[:, 5:8] *= 2
        return table

    each_table(folder, doubled)
    (only,) = said(folder)
    assert only.startswith("imu 'left_shank' of 'anna': the accelerometer reads 20.8 m/s2")


def test_bones_that_no_body_has_are_left_to_whoever_makes_bodies(folder):
    path = folder / "session.toml"
    text = path.read_text().replace("height_m = 1.68", "height_m = 1.68\nbone_lengths_m.head = 3.0")
    path.write_text(text)
    assert said(folder) == []
