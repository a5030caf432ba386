"""Who is how tall, and whose camera is late, where no sensor says so."""

import re
import shutil

import pytest

from fusecap.doctor import diagnose
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    path = write_session(demo_scene(seconds=3.0), folder)
    tables = re.split(r"\n(?=\[\[)", path.read_text())
    path.write_text("\n".join(t for t in tables if not t.startswith("[[subject.imu]]")))
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "spoilt")
    return tmp_path / "spoilt"


def said(folder):
    return [str(finding) for finding in diagnose(folder) if finding.severity != "info"]


def test_nothing_is_said_of_people_as_tall_as_stated(sound):
    assert said(sound) == []


@pytest.mark.parametrize("key", ["height_m", "start_m"])
def test_two_who_are_exchanged_measure_as_the_other_should(folder, key):
    path = folder / "session.toml"
    text = path.read_text()
    first, second = re.findall(rf"^{key} = .*$", text, re.MULTILINE)
    text = text.replace(first, "swap").replace(second, first).replace("swap", second)
    path.write_text(text)
    (only,) = said(folder)
    assert only.startswith("subject 'anna'") and "those of 'ben'" in only
    assert "height_m, start_m or sensors are exchanged" in only


@pytest.mark.parametrize("factor", [0.88, 1.12])
def test_one_stature_of_two_that_is_a_tenth_wrong_is_told(folder, factor):
    path = folder / "session.toml"
    path.write_text(path.read_text().replace("height_m = 1.82", f"height_m = {1.82 * factor:.3f}"))
    (only,) = said(folder)
    assert only.startswith("subject 'ben': limbs measure as of somebody")
    measured = float(re.search(r"somebody ([\d.]+) m tall", only)[1])
    assert measured == pytest.approx(1.82, rel=0.04)


def test_a_camera_whose_people_hardly_move_across_it_is_told_to_be_late(folder):
    path = folder / "session.toml"
    path.write_text(path.read_text().replace("offset_s = 0.0", "offset_s = -0.3", 1))
    (only,) = said(folder)
    assert only.startswith("camera 'cam1'")
    assert float(re.search(r"add about ([+-][\d.]+) s", only)[1]) == pytest.approx(0.3, abs=0.06)
