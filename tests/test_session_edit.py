"""Results of calibrations are put into session files that people wrote."""

import tomllib

import pytest

from fusecap.sources.session_edit import edit_session

TEXT = """# of monday
[session]  # all of it
name = "duo"  # two
up = "z"
calibration_unit = "mm"

# the left one
[[camera]]
name = "cam1"

[[subject]]
name = "anna"
height_m = 1.7 # by tape

# strapped
[[subject.imu]]
bone = "hips"

[[subject]]
name = "ben"
"""


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "session.toml"
    file.write_text(TEXT)
    return file


def test_keys_are_set_and_taken_away_and_nothing_else_moves(path):
    values = {"calibration": "refined.toml", "up": "y", "calibration_unit": None}
    assert edit_session(path, values)
    expected = TEXT.replace('calibration_unit = "mm"\n', 'calibration = "refined.toml"\n')
    assert path.read_text() == expected.replace('up = "z"', 'up = "y"')
    assert not edit_session(path, values)


def test_subjects_are_changed_by_name_and_added(path):
    lengths = {"left_shank": 0.43, "right_shank": 0.44}
    subjects = {n: {"height_m": 1.81, "bone_lengths_m": lengths} for n in ("anna", 'c "x"')}
    assert edit_session(path, subjects=subjects)
    text = path.read_text()
    assert "height_m = 1.81 # by tape\n" in text and "# strapped\n" in text
    anna, ben, cleo = tomllib.loads(text)["subject"]
    assert anna["bone_lengths_m"] == lengths and anna["imu"] == [{"bone": "hips"}]
    assert ben == {"name": "ben"} and cleo == {"name": 'c "x"'} | subjects["anna"]


def test_a_session_without_subjects_gets_them(path):
    path.write_text(TEXT.partition("[[subject]]")[0])
    edit_session(path, subjects={"person1": {"height_m": 1.7}})
    data = tomllib.loads(path.read_text())
    assert data["subject"] == [{"name": "person1", "height_m": 1.7}]
    assert data["camera"] == [{"name": "cam1"}]


@pytest.mark.parametrize("text", ['session = { name = "a" }\n', 'session.name = "a"\n'])
def test_other_spellings_of_tables_are_edited_too(path, text):
    path.write_text(text + 'subject = [{ name = "anna" }]\n')
    edit_session(path, {"sync": "sync.toml"}, {"anna": {"height_m": 1.8}})
    data = tomllib.loads(path.read_text())
    assert data["session"] == {"name": "a", "sync": "sync.toml"}
    assert data["subject"] == [{"name": "anna", "height_m": 1.8}]


def test_line_ends_of_the_file_stay(path):
    path.write_bytes(TEXT.replace("\n", "\r\n").encode())
    edit_session(path, {"up": "y"})
    assert path.read_bytes().decode().count("\r\n") == TEXT.count("\n")
