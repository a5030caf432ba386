"""Sensors that turn otherwise than the limbs that cameras see, and sensors that lie alone."""

import re
import shutil

import pytest

from fusecap.doctor import diagnose
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    write_session(demo_scene(seconds=3.0), folder)
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "spoilt")
    return tmp_path / "spoilt"


def said(folder):
    texts = [str(finding) for finding in diagnose(folder) if finding.severity == "warning"]
    return [text for text in texts if "samples lost" not in text]


def each_imu(folder, addition, subject=r"\w+", bone=r"\w+"):
    path = folder / "session.toml"
    file = f'file = "imus/{subject}_{bone}.csv"\n'
    text, count = re.subn(f"({file})", rf"\g<1>{addition}\n", path.read_text())
    assert count
    path.write_text(text)


def test_nothing_is_said_of_sensors_that_sit_right(sound):
    assert said(sound) == []


@pytest.mark.parametrize(
    ("one", "other"), [("anna_left_forearm", "anna_right_forearm"), ("anna_head", "ben_left_thigh")]
)
def test_exchanged_sensors_are_told(folder, one, other):
    first, second = (folder / "imus" / f"{name}.csv" for name in (one, other))
    a, b = first.read_text(), second.read_text()
    first.write_text(b)
    second.write_text(a)
    (only,) = said(folder)
    bone, name = other.split("_", 1)[1], other.split("_", 1)[0]
    assert f"exchanged with imu '{bone}' of '{name}'" in only


@pytest.mark.parametrize("heading_deg", [90, -40])
def test_a_heading_that_all_sensors_of_a_person_share_is_told(folder, heading_deg):
    each_imu(folder, f"heading_deg = {heading_deg}", subject="ben")
    (only,) = said(folder)
    found = float(re.search(r"add about ([+-]\d+) to their heading", only)[1])
    assert only.startswith("sensors of 'ben'") and found == pytest.approx(-heading_deg, abs=10)


def test_a_late_sensor_is_told_its_offset(folder):
    each_imu(folder, "offset_s = 0.5", subject="ben", bone="right_forearm")
    (only,) = said(folder)
    assert only.startswith("imu 'right_forearm' of 'ben'")
    assert float(re.search(r"add about ([+-][\d.]+) s", only)[1]) == pytest.approx(-0.5, abs=0.1)


def test_a_sensor_that_stopped_is_told_when(folder):
    path = folder / "imus" / "ben_right_thigh.csv"
    lines = path.read_text().splitlines()
    cells = lines[91].split(",", 1)[1]
    stopped = [f"{line.split(',', 1)[0]},{cells}" for line in lines[91:]]
    path.write_text("\n".join(lines[:91] + stopped) + "\n")
    assert any(
        "imu 'right_thigh' of 'ben': says the same for 1.5 s" in text for text in said(folder)
    )


def test_a_sensor_that_slipped_is_told(folder):
    path = folder / "session.toml"
    text = path.read_text()
    at = text.index("anna_right_forearm.csv")
    start = text.index("bone_from_imu_wxyz = [", at)
    end = text.index("\n", start)
    path.write_text(text[:start] + "bone_from_imu_wxyz = [1.0, 0.0, 0.0, 0.0]" + text[end:])
    assert any(
        t.startswith("imu 'right_forearm' of 'anna'") and "slipped" in t for t in said(folder)
    )
