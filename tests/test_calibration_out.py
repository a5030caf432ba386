"""A calibration that could not be written is refused before the work, not after it."""

import sys

import pytest

from fusecap.cli import main

BOARD = 'kind = "checkerboard"\ncolumns = 6\nrows = 5\nsquare_m = 0.04\n'


@pytest.mark.parametrize(
    "command",
    [
        ("intrinsics", "left=left.mp4", "--board", "board.toml"),
        ("extrinsics", "left=left.mp4", "right=right.mp4", "--board", "board.toml"),
        ("extrinsics", "--from-people", "session.toml"),
        ("shape", "session.toml"),
        ("offsets", "session.toml"),
        ("imu", "session.toml"),
        ("prior", "motion"),
    ],
    ids=" ".join,
)
@pytest.mark.parametrize(
    ("out", "reason"),
    [("file/out.toml", "file is not a folder"), ("folder.toml", "it is a folder")],
)
def test_unwritable_out_is_refused_before_anything_is_read(
    tmp_path, monkeypatch, capsys, command, out, reason
):
    (tmp_path / "board.toml").write_text(BOARD)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.toml").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["fusecap", "calibrate", *command, "--out", out])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 1
    said = " ".join(capsys.readouterr().err.split())
    assert f"cannot write {out}" in said and reason in said, said


def test_calibration_format_nobody_knows_is_refused_before_the_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["calibrate", "extrinsics", "--from-people", "session.toml", "--out", "rig.xml"]
    monkeypatch.setattr(sys, "argv", ["fusecap", *arguments])
    with pytest.raises(SystemExit):
        main()
    assert "no calibration format" in capsys.readouterr().err
