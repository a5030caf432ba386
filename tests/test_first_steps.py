"""What a new user stumbles over: takes without people, short takes, many sensors, Ctrl-C."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer

import fusecap.cli as cli
from fusecap.doctor import diagnose
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session


@pytest.fixture
def scene(tmp_path) -> Path:
    """Half a second of the simulated demo, as a session."""
    write_session(demo_scene(0, seconds=0.5), tmp_path / "scene")
    return tmp_path / "scene"


def run(monkeypatch, *arguments: object) -> int:
    monkeypatch.setattr("sys.argv", ["fusecap", *map(str, arguments)])
    with pytest.raises(SystemExit) as left:
        cli.main()
    return int(left.value.code or 0)


def test_a_take_in_which_nobody_is_followed_is_an_error_and_not_written(scene, monkeypatch, capsys):
    for file in (scene / "keypoints").rglob("*.json"):
        file.write_text('{"people": []}')
    text = (scene / "session.toml").read_text()
    (scene / "session.toml").write_text(text.split("[[subject]]")[0])
    assert run(monkeypatch, "solve", scene) == 1
    assert "no camera sees anyone" in capsys.readouterr().err
    assert not list(scene.glob("demo.npz"))


def test_doctor_points_out_a_recording_too_short_to_find_people(scene):
    for camera in (scene / "keypoints").iterdir():
        for file in sorted(camera.glob("*.json"))[10:]:
            file.unlink()
    text = (scene / "session.toml").read_text()
    (scene / "session.toml").write_text(text.split("[[subject]]")[0])
    assert any(f.where == "session" and "0.15 s" in f.found for f in diagnose(scene))


def test_samples_lost_by_many_sensors_are_one_finding_per_subject(scene):
    files = sorted((scene / "imus").glob("anna_*.csv"))[:2]
    for file in files:
        lines = file.read_text().splitlines()
        file.write_text("\n".join(lines[:10] + lines[12:]))
    found = [f for f in diagnose(scene) if "samples lost" in f.found and "anna" in f.where]
    assert len(found) == 1 and found[0].where == "sensors of 'anna'"


def test_ctrl_c_is_answered(monkeypatch, capsys):
    def stopped() -> None:
        raise KeyboardInterrupt

    app = typer.Typer()
    app.command()(stopped)
    monkeypatch.setattr(cli, "app", app)
    assert run(monkeypatch) == 130
    assert "interrupted" in capsys.readouterr().err
