"""Commands on many sessions or takes: patterns, failures, resuming, the table and the exit code."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

import fusecap.evaluate.runner as runner
from fusecap.cli import app, solve
from fusecap.cli.common import Exports, print_json, write_take
from fusecap.cli.many import OneOfMany, are_newer, is_session, matching, run_one
from fusecap.errors import InputError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.sources.session_file import input_files, load_session
from fusecap.stored_take import StoredTake
from fusecap.take import save_take
from motions import person, solved, take_of, walk

OPTIONS = {"export": "bvh", "unit": None, "rig": "native", "picture": False}
OPTIONS |= {"as_live": False, "anyway": False}


def run(*arguments: object):
    return CliRunner().invoke(app, [*map(str, arguments)])


def two_frames():
    return take_of(walk(person(), 2)[None], [person()], names=("anna",))


def older(path: Path) -> None:
    os.utime(path, ns=(1, 1))


@pytest.fixture
def in_one_process(monkeypatch):
    """Jobs run here, one after the other."""

    def compute(waiting, work, **_):
        for key, job in waiting.items():
            yield key, work(job), "", 0.0

    monkeypatch.setattr(runner, "compute", compute)


def test_a_thousand_takes_of_which_ten_are_broken(tmp_path, in_one_process, monkeypatch):
    def quick(take: Path, *_: object, **__: object) -> None:
        """Angles cost 20 ms a take."""
        with StoredTake(take) as stored:
            (target := take.with_name("take_angles.csv")).touch()
            print_json({"files": [str(target)], "people": list(stored.subject_names)})

    monkeypatch.setattr("fusecap.cli.angles._angles_of", quick)
    for number in range(1000):
        folder = tmp_path / f"trial{number:03}"
        folder.mkdir()
        if number % 100 == 7:
            (folder / "take.npz").write_bytes(b"PK\x03\x04 no take")
        elif number == 0:
            save_take(two_frames(), folder / "take.npz")
        else:
            os.link(tmp_path / "trial000" / "take.npz", folder / "take.npz")
    pattern = tmp_path / "*" / "take.npz"
    first = run("angles", pattern)
    assert first.exit_code == 1
    assert "990 of 1000 done (0 already), 10 failed" in first.output
    assert first.output.count("failed ") == 2 * 10 and "trial007" in first.output  # and at the end
    assert len(list(tmp_path.glob("*/take_angles.csv"))) == 990
    (tmp_path / "trial500" / "take_angles.csv").unlink()
    again = json.loads(run("angles", pattern, "--json").stdout)
    assert (again["already"], again["failed"], again["interrupted"]) == (989, 10, False)
    assert (tmp_path / "trial500" / "take_angles.csv").is_file()
    fresh = json.loads(run("angles", tmp_path / "trial00?" / "*.npz", "--again", "--json").stdout)
    assert (fresh["already"], fresh["failed"], fresh["ended"]) == (0, 1, 10)


def test_several_run_in_processes_of_their_own(tmp_path):
    for name in ("a", "b"):
        save_take(two_frames(), tmp_path / f"{name}.npz")
    paths = [tmp_path / "a.npz", tmp_path / "b.npz", tmp_path / "gone.npz"]
    result = run("export", *paths, "--format", "trc", "--workers", 2, "--json")
    assert result.exit_code == 1, result.output
    found = json.loads(result.stdout)["of"]
    assert [next(iter(entry)) for entry in found.values()] == ["files", "files", "error"]
    assert len([*tmp_path.glob("a*.trc"), *tmp_path.glob("b*.trc")]) == 2


def test_what_is_interrupted_says_what_is_done(tmp_path, monkeypatch):
    for name in ("a", "b"):
        save_take(two_frames(), tmp_path / f"{name}.npz")

    def compute(waiting, work, **_):
        key, job = next(iter(waiting.items()))
        yield key, work(job), "", 0.0
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "compute", compute)
    result = run("report", tmp_path / "*.npz")
    assert result.exit_code == 130
    assert "1 of 2 done" in result.output and "goes on" in result.output


def test_patterns_find_sessions_once(tmp_path):
    for name in ("a", "b [1]"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "session.toml").touch()
    (tmp_path / "notes").mkdir()
    (tmp_path / "run.mcap").touch()
    (tmp_path / "readme.txt").touch()
    found = matching([tmp_path / "*"], wanted=is_session, what="session")
    assert [path.name for path in found] == ["a", "b [1]", "run.mcap"]
    twice = [tmp_path / "a", tmp_path / "a" / "session.toml", tmp_path / "b [1]"]
    assert len(matching(twice, wanted=is_session, what="session")) == 2
    with pytest.raises(InputError, match="no session matches"):
        matching([tmp_path / "x*"], wanted=is_session, what="session")


def test_many_have_no_one_name(tmp_path):
    for command in ("solve", "angles", "report"):
        refused = run(command, "a", "b", "--out", tmp_path / "x")
        assert refused.exit_code != 0 and "of one alone" in str(refused.exception)
    refused = run("export", "a/t.npz", "b/t.npz", "--out", tmp_path)
    assert refused.exit_code != 0 and "same name" in str(refused.exception)


def test_a_session_is_solved_again_when_anything_it_is_made_of_is_newer(tmp_path):
    simulation = demo_scene(0, seconds=0.1)
    write_session(simulation, tmp_path)
    inputs = input_files(load_session(tmp_path))
    assert {"session.toml", "calibration.toml", "cam1"} <= {path.name for path in inputs}
    for path in inputs:
        older(path)
    take = tmp_path / "demo.npz"
    assert solve.already(tmp_path, **OPTIONS) is None
    write_take(solved(simulation.truth), take, Exports(formats=["bvh"]), picture=False)
    known = solve.already(tmp_path, **OPTIONS)
    assert known is not None and known["solves"] == 120
    assert solve.already(tmp_path, **OPTIONS | {"export": "bvh,trc"}) is None
    assert solve.already(tmp_path, **OPTIONS | {"picture": True}) is None
    for path in inputs:
        path.touch()
        assert solve.already(tmp_path, **OPTIONS) is None, path
        older(path)
    (tmp_path / "demo_anna.bvh").unlink()
    assert solve.already(tmp_path, **OPTIONS) is None
    other = {**simulation.truth.provenance, "made_by": "fusecap 0.0", "report": {}}
    save_take(replace(simulation.truth, provenance=other), take)
    assert solve.already(tmp_path, **OPTIONS | {"export": None}) is None
    take.write_bytes(b"cut short")
    assert solve.already(tmp_path, **OPTIONS) is None


def test_an_error_of_one_is_what_it_says_and_a_finding_is_no_error(tmp_path):
    (tmp_path / "session.toml").write_text("[session]\nname = 3\n")
    job = OneOfMany(command="solve", path=tmp_path, options=OPTIONS, again=True)
    assert "found 3, expected text" in run_one(job)["error"]
    job = OneOfMany(command="doctor", path=tmp_path, options={}, again=True)
    assert run_one(job)["errors"] == 1


def test_doctor_of_many_fails_for_errors_it_finds(tmp_path, in_one_process):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "session.toml").write_text("[session]\nname = 3\n")
    result = run("doctor", tmp_path / "a", tmp_path / "b", "--json")
    assert result.exit_code == 1
    assert json.loads(result.stdout)["failed"] == 2
    lines = run("doctor", tmp_path / "a", tmp_path / "b").stdout.splitlines()
    for name in ("a", "b"):
        (told,) = (line for line in lines if line.startswith(f"{tmp_path / name}: error"))
        assert "found 3, expected text" in told


def test_a_file_that_is_missing_is_not_newer(tmp_path):
    (tmp_path / "a").touch()
    assert not are_newer([tmp_path / "b"], [tmp_path / "a"])
    assert are_newer([tmp_path / "a"], [tmp_path / "b"])
