"""The command line as its user meets it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.stored_take import load_take


def fusecap(*arguments: object, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fusecap", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Path:
    """Two seconds of the demo scene as a session folder."""
    folder = tmp_path_factory.mktemp("session")
    write_session(demo_scene(0, seconds=2.0), folder)
    return folder


@pytest.mark.parametrize(
    "command",
    [
        (),
        ("demo",),
        ("solve",),
        ("export",),
        ("angles",),
        ("report",),
        ("overlay",),
        ("doctor",),
        ("live",),
        ("view",),
        ("calibrate",),
        ("calibrate", "prior"),
    ],
)
def test_help_shows_usage_and_an_example(command):
    result = fusecap(*command, "--help")
    assert result.returncode == 0
    assert "Usage" in result.stdout
    if len(command) != 0 and command != ("calibrate",):
        assert "Example: fusecap" in result.stdout


@pytest.mark.parametrize(
    ("words", "offered"), [(["cal"], "calibrate"), (["solve", "--ex"], "--export")]
)
def test_a_shell_completes_commands_and_options(words, offered):
    typed = {"COMP_WORDS": " ".join(["fusecap", *words]), "COMP_CWORD": str(len(words))}
    shell = subprocess.run(
        [Path(sys.executable).with_name("fusecap")],
        env={"_FUSECAP_COMPLETE": "complete_bash", **typed},
        capture_output=True,
        text=True,
        check=True,
    )
    assert offered in shell.stdout.split()


def test_demo_reports_errors_and_speed_and_writes_files(tmp_path):
    result = fusecap("demo", "--seconds", 3, "--out", tmp_path, "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["simulated"] is True
    assert 0 < report["position_error_mm"] < 60
    assert 0 < report["orientation_error_deg"] < 25
    assert report["true_jitter_km_s3"] < report["jitter_km_s3"] < 1.0
    assert 0 < report["foot_skate_m_s"] < 0.3
    assert report["lag"]["lag_s"] == 0.1
    assert report["lag"]["jitter_km_s3"] < report["newest"]["jitter_km_s3"]
    assert report["subjects"] == 2
    assert report["identity_switches"] == 0
    assert 0 < report["solve_ms_median"] <= report["solve_ms_p99"]
    take = load_take(tmp_path / "demo.npz")
    assert take.tracked.all()
    assert {path.suffix for path in tmp_path.iterdir()} == {".npz", ".bvh", ".png", ".json"}


def test_solve_writes_the_take_and_reports_in_json(session, tmp_path):
    out = tmp_path / "nested" / "take.npz"
    result = fusecap("solve", session, "--out", out, "--export", "bvh", "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["instants"] == 120
    assert set(report["subjects"]) == {"anna", "ben"}
    assert all(subject["tracked_share"] > 0.95 for subject in report["subjects"].values())
    assert all(camera["median"] < 20 for camera in report["reprojection_px"].values())
    assert report["solves"] > 200
    with np.load(out, allow_pickle=False) as arrays:
        assert arrays["theta"].shape == (2, 120, 66)
    assert sorted(path.name for path in out.parent.glob("*.bvh")) == [
        "take_anna.bvh",
        "take_ben.bvh",
    ]


def test_a_session_solves_to_the_same_bits_each_time(session, tmp_path):
    for name in ("a", "b"):
        assert fusecap("solve", session, "--out", tmp_path / f"{name}.npz").returncode == 0
    first, second = load_take(tmp_path / "a.npz"), load_take(tmp_path / "b.npz")
    np.testing.assert_array_equal(first.theta, second.theta)


def test_export_writes_one_bvh_per_person(session, tmp_path):
    take = tmp_path / "take.npz"
    assert fusecap("solve", session, "--out", take).returncode == 0
    result = fusecap("export", take, "--format", "bvh", "--unit", "cm", "--out", tmp_path / "x")
    assert result.returncode == 0, result.stderr
    assert len(list((tmp_path / "x").glob("*.bvh"))) == 2


def test_doctor_finds_nothing_wrong_with_a_good_session(session):
    result = fusecap("doctor", session, "--json")
    assert result.returncode == 0, result.stdout
    assert json.loads(result.stdout)["errors"] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("solve", "nowhere"), 1, "nowhere"),
        (("solve",), 2, "Missing argument"),
        (("solve", ".", "--export", "obj"), 2, "obj"),
        (("solve", "nowhere", "--export", "bvh", "--unit", "furlong"), 2, "furlong"),
        (("solve", "nowhere", "--export", "bvh", "--unit", "mm"), 1, "in m or cm, not in mm"),
        (("solve", "nowhere", "--export", "csv", "--rig", "mixamo"), 1, "csv has no rig"),
        (("demo", "--associate", "papr"), 2, "did you mean 'paper'"),
        (("demo", "--seconds", "1000"), 1, "1000 s asked for"),
        (("export", "nowhere.npz"), 1, "nowhere.npz"),
        (("export", "nowhere.npz", "--format", "bhv"), 2, "bvh"),
        (("frobnicate",), 2, "frobnicate"),
        (("calibrate", "prior", "nowhere"), 1, "nowhere"),
        (("calibrate", "prior", ".", "--skeleton", "paper2"), 1, "paper21"),
    ],
)
def test_misuse_is_explained_without_a_traceback(arguments, code, message, tmp_path):
    result = fusecap(*arguments, cwd=tmp_path)
    assert result.returncode == code
    assert message in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr


def test_with_json_a_failure_is_json_too(tmp_path):
    result = fusecap("solve", tmp_path / "nowhere", "--json")
    assert result.returncode == 1
    assert "nowhere" in json.loads(result.stdout)["error"]


@pytest.mark.parametrize(("stage", "by"), [("sorting", "SIGTERM"), ("solving", "SIGINT")])
def test_ctrl_c_leaves_a_valid_take_of_what_was_solved_beside_the_whole_one(
    session, tmp_path, stage, by
):
    script = tmp_path / "interrupted.py"
    script.write_text(_INTERRUPTED_SOLVE)
    out = tmp_path / "take.npz"
    out.write_bytes(b"a whole take")
    (tmp_path / "take_anna.bvh").write_bytes(b"a whole export")
    command = [sys.executable, script, stage, by, "solve", session, "--out", out, "--json"]
    command += ["--export", "bvh"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 130, result.stderr
    assert json.loads(result.stdout)["interrupted"] is True
    assert "interrupted" in result.stderr
    assert out.read_bytes() == b"a whole take"
    assert (tmp_path / "take_anna.bvh").read_bytes() == b"a whole export"
    files = [Path(file).name for file in json.loads(result.stdout)["files"]]
    assert files[0] == "take-interrupted.npz"
    assert all(name.startswith("take-interrupted") for name in files)
    take = load_take(tmp_path / "take-interrupted.npz")
    assert 50 <= len(take.timestamps_ns) < 120
    assert take.tracked.any()


_INTERRUPTED_SOLVE = """
import signal, sys
from contextlib import contextmanager
import fusecap.cli.solve as command
from fusecap.cli import main

stage, number = sys.argv.pop(1), getattr(signal, sys.argv.pop(1))

@contextmanager
def interrupting(*, quiet):
    def show(what, done, total):
        if what == stage and done == 60:
            signal.raise_signal(number)
    yield show

command.progress = interrupting
main()
"""


def test_import_and_help_load_no_heavy_package():
    for code in ("import fusecap", "import fusecap.cli"):
        check = f"{code}; import sys; print({{'numba', 'scipy', 'matplotlib'}} & {{*sys.modules}})"
        result = subprocess.run(
            [sys.executable, "-c", check], capture_output=True, text=True, check=True
        )
        assert result.stdout.strip() == "set()"
