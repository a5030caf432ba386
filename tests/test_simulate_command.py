"""`fusecap simulate` as its user meets it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fusecap.evaluate.twin import twin_sequences
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take
from fusecap.take import save_take, take_from_theta
from motion_texts import amc_text, asf_text


def fusecap(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fusecap", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=cwd)


@pytest.fixture(scope="module")
def takes(tmp_path_factory) -> list[Path]:
    """A second of each of two people, as takes."""
    folder = tmp_path_factory.mktemp("motion")
    paths = []
    for sequence in twin_sequences()[1:3]:
        take = take_from_theta(
            sequence.theta[None, :61],
            [sequence.shape],
            timestamps_ns=np.round(np.arange(61) * (1e9 / 60)).astype(np.int64),
            rate_hz=60.0,
            subject_names=(sequence.name,),
            skeleton=sequence.shape.skeleton,
            provenance={},
        )
        paths.append(folder / f"{sequence.name}.npz")
        save_take(take, paths[-1])
    return paths


def simulate(*arguments: object, **options) -> dict:
    result = fusecap("simulate", *arguments, "--json", **options)
    assert result.returncode == 0, result.stderr + result.stdout
    return json.loads(result.stdout)


def test_help_has_an_example():
    result = fusecap("simulate", "--help")
    assert result.returncode == 0 and "Example: fusecap simulate" in result.stdout


def test_session_has_what_was_asked_for(takes, tmp_path):
    out = tmp_path / "duo"
    report = simulate(
        *takes, "--bystander", takes[0], "--out", out, "--cameras", 3, "--layout", "arc",
        "--imus", "hips,left_foot", "--camera-rate", 30, "--camera-offsets", "0,0.004,0.01",
    )  # fmt: skip
    assert report["simulated"] is True and report["frames"] == 61
    assert report["subjects"] == ["FS1", "ROM3"] and report["bystanders"] == ["FS1_2"]
    data = open_session(load_session(out))
    assert data.rig.names == ("cam1", "cam2", "cam3")
    assert [track.rate_hz for track in data.keypoints] == [30.0] * 3
    assert [track.times_s[0] for track in data.keypoints] == pytest.approx([0, 0.004, 0.01])
    assert {imus.bones for imus in data.imus} == {("hips", "left_foot")}
    truth = load_take(out / "truth.npz")
    assert truth.subject_names == ("FS1", "ROM3") and truth.provenance["simulated"] is True
    subject = data.session.subjects[0]
    told = truth.shape(0)
    assert subject.height_m == told.height_m
    for name, length in subject.bone_lengths_m.items():
        offset = told.offsets_m[told.skeleton.bone(name)]
        assert length == pytest.approx(np.linalg.norm(offset))


def test_same_seed_writes_the_same_bytes(takes, tmp_path):
    for folder, seed in (("a/x", 3), ("b/x", 3), ("c/x", 4)):
        simulate(takes[0], "--out", tmp_path / folder, "--cameras", 1, "--seed", seed)

    def contents(folder: str) -> dict[str, bytes]:
        root = tmp_path / folder
        files = [path for path in root.rglob("*") if path.is_file() and path.suffix != ".npz"]
        return {str(path.relative_to(root)): path.read_bytes() for path in files}

    assert len(contents("a")) > 60
    assert contents("a") == contents("b") != contents("c")
    first, second = (load_take(tmp_path / f / "x/truth.npz") for f in "ab")
    assert np.array_equal(first.theta, second.theta)


def test_motion_of_the_database_is_retargeted(tmp_path):
    (tmp_path / "01.asf").write_text(asf_text())
    frame = {"root": [0.0, 17.0, 0.0, 0.0, 0.0, 0.0]}
    (tmp_path / "01_01.amc").write_text(amc_text([frame] * 120))
    report = simulate(
        "01_01.amc", "--out", "out", "--height", 1.6, "--rate", 50, "--cameras", 1, "--imus", 6,
        cwd=tmp_path,
    )  # fmt: skip
    assert report["rate_hz"] == 50.0 and report["frames"] == 50
    truth = load_take(tmp_path / "out/truth.npz")
    assert truth.heights_m.tolist() == [1.6]
    assert len(report["imus"]["01_01"]) == 6


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("nowhere.bvh", "--out", "x"), 1, "nowhere.bvh: no such file"),
        (("motion.fbx", "--out", "x"), 1, "expected a .bvh, an .amc"),
        (("{take}",), 2, "Missing option"),
        (("{take}", "--out", "."), 1, "name another folder"),
        (("{take}", "--out", "x", "--layout", "rign"), 2, "did you mean 'ring'"),
        (("{take}", "--out", "x", "--imus", "hip"), 2, "did you mean 'hips'"),
        (("{take}", "--out", "x", "--camera-offsets", "0,1"), 2, "expected one, or 4"),
        (("{take}", "--out", "x", "--camera-offsets", "-1"), 1, "expected zero or more"),
        (("{take}", "--out", "x", "--camera-rate", "fast"), 2, "expected numbers"),
        (("{take}", "--out", "x", "--seconds", "60"), 1, "the shortest motion has 1.00 s"),
        (("{take}", "--out", "x", "--height", "175"), 1, "heights are in metres"),
        (("{take}", "--out", "x", "--rig", "no.toml"), 1, "no.toml"),
    ],
)
def test_misuse_is_explained(takes, arguments, code, message, tmp_path):
    (tmp_path / "something").write_text("")
    given = [str(takes[0]) if argument == "{take}" else argument for argument in arguments]
    result = fusecap("simulate", *given, cwd=tmp_path)
    assert result.returncode == code, result.stderr
    assert message in " ".join(result.stderr.replace("│", " ").split())
    assert "Traceback" not in result.stderr


def test_a_take_with_gaps_is_refused(takes, tmp_path):
    take = load_take(takes[0])
    take.tracked[0, 5] = False
    save_take(take, tmp_path / "gap.npz")
    result = fusecap("simulate", tmp_path / "gap.npz", "--out", tmp_path / "out")
    assert result.returncode == 1 and "not tracked in frame 5" in result.stderr
