"""The paper's experiments on the simulated twin: their cells, reports and commands."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.evaluate.cells import (
    LIMBS_12,
    TwinCell,
    below_floor,
    mean_offsets,
    simulation_of,
)
from fusecap.evaluate.experiments import table3
from fusecap.evaluate.experiments.experiment import Results, settings
from fusecap.evaluate.experiments.run import (
    EXPERIMENTS,
    Evaluation,
    as_json,
    described,
    markdown,
    write,
)
from fusecap.evaluate.runner import Outcome
from fusecap.evaluate.tables import Table
from fusecap.evaluate.twin import TWIN_VERSION, twin_sequences, twin_simulation
from fusecap.files import plain
from motions import person, take_of, walk


def result_of(cell: TwinCell, error_mm: float = 20.0) -> dict:
    """What a solve would return; a tenth of a millimetre more for every camera left out."""
    mean = error_mm + 0.1 * (8 - cell.cameras)
    summary = {"mean": mean, "std": 5.0, "median": mean - 2, "mad": 3.0, "count": 100}
    kinds = ("position", "root_relative", "aligned", "orientation", "aligned_orientation", "axial")
    score = {}
    for kind in kinds:
        turn = kind.endswith(("orientation", "axial"))
        score[f"{kind}_error_{'deg' if turn else 'mm'}"] = summary
    for kind in ("position_error_mm", "orientation_error_deg", "axial_error_deg"):
        score[f"bone_{kind}"] = dict.fromkeys(PAPER21.bone_names, mean)
    score |= {"acceleration_error_m_s2": 2.0, "jitter_km_s3": 1.0, "true_jitter_km_s3": 0.1}
    score |= {"foot_skate_m_s": 0.1, "true_foot_skate_m_s": 0.05, "contact_share": 0.5}
    score |= {"found_share": 1.0, "extra_share": 0.0, "identity_switches": 1, "idf1": 0.9}
    score |= {"missed_tracks": 0, "false_tracks": 0, "subjects": 1}
    result = {
        "score": score,
        "floor": {"share": 0.01, "mean_mm": 0.5, "worst_mm": 4.0},
        "joints17": {"position_mm": mean, "aligned_mm": mean},
    }
    if cell.trace:
        result["root_m"] = [[0.0, 1.0, 0.01 * t] for t in range(30)]
        result["true_root_m"] = [[0.0, 1.0, 0.01 * t + 0.002] for t in range(30)]
    return result


def evaluated(name: str, *, failing: int | None = None) -> Evaluation:
    chosen = settings(sequences="S1 FS3,S2 FS1", seed=3, quick=True)
    experiment = EXPERIMENTS[name]
    outcomes = tuple(
        Outcome(cell=cell, key=str(n), result=result_of(cell))
        if n != failing
        else Outcome(cell=cell, key=str(n), error="ValueError: broken")
        for n, cell in enumerate(experiment.cells(chosen))
    )
    return Evaluation(
        experiment=experiment,
        settings=chosen,
        report=experiment.report(chosen, Results(outcomes)),
        outcomes=outcomes,
        command=f"fusecap evaluate {name}",
    )


@pytest.fixture(autouse=True)
def _offsets(monkeypatch):
    """Table 3's offsets without the simulations they are measured in."""
    monkeypatch.setattr(table3, "offsets", lambda: {"nose": (0.0, 0.02, 0.06)})


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_reports_and_calls_itself_simulated(name, tmp_path):
    evaluation = evaluated(name)
    files = write(evaluation, tmp_path)
    assert {"md", "json", "csv", "png"} <= {path.suffix[1:] for path in files}
    text = (tmp_path / f"{name}.md").read_text()
    assert f"simulated twin v{TWIN_VERSION}" in text.splitlines()[0]
    assert f"`fusecap evaluate {name}`" in text and "seed 3" in text
    stored = json.loads((tmp_path / f"{name}.json").read_text())
    assert stored["simulated"] is True and stored["twin_version"] == TWIN_VERSION
    assert stored["tables"] and stored["findings"] and stored["failed"] == []


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_a_failed_cell_is_named_and_the_rest_reported(name):
    evaluation = evaluated(name, failing=0)
    assert len(evaluation.failures) == 1
    text = markdown(evaluation)
    assert "**Failed**" in text and "ValueError: broken" in text
    assert "nan (nan)" not in text
    json.dumps(as_json(evaluation), allow_nan=False)


def test_a_cell_is_described_by_what_is_unusual():
    weights = TwinCell(scene="S1 FS3").weights | {"floor": 0.0}
    cell = TwinCell(scene="S1 FS3", imus=6, weights=weights, offsets={"nose": (0.0, 0.0, 0.1)})
    assert described(cell) == "S1 FS3, imus=6, weights=floor=0, offsets=given"


def test_findings_that_do_not_hold_come_first():
    order = [finding.holds for finding in evaluated("table3").findings]
    assert order == sorted(order, key=(False, None, True).index)
    assert False in order and True in order


def test_figure_7_covers_every_number_of_cameras_and_sensors():
    cells = EXPERIMENTS["figure7"].cells(settings(sequences=None, seed=0, quick=False))
    grid = {(cell.cameras, cell.imus) for cell in cells}
    assert grid == {(c, i) for c in range(9) for i in (0, 6, 13)} - {(0, 0)}
    assert len(cells) == 26 * 8


def test_table_3_switches_one_term_at_a_time():
    cells = EXPERIMENTS["table3"].cells(settings(sequences="S1 FS3", seed=0, quick=False))
    full = cells[0].weights
    off = {
        tuple(name for name in full if cell.weights[name] == 0 and full[name] > 0) for cell in cells
    }
    assert {("position",), ("orientation",), ("projection",), ("deviation",), ("floor",)} <= off


def test_an_unknown_sequence_is_named():
    with pytest.raises(InputError, match="S9 FS1"):
        settings(sequences="S1 FS3,S9 FS1", seed=0, quick=False)


def test_pooling_over_sequences_is_exact():
    cells = [TwinCell(scene="S1 FS3"), TwinCell(scene="S2 FS1")]
    first, second = np.arange(5.0), np.array([4.0, 8.0, 9.0, 1.0, 3.0])
    outcomes = [
        Outcome(
            cell=cell,
            key="",
            result={"e": {"mean": x.mean(), "std": x.std(), "median": np.median(x), "mad": 1.0}},
        )
        for cell, x in zip(cells, (first, second), strict=True)
    ]
    spread = Results(outcomes).spread(cells, "e")
    together = np.concatenate([first, second])
    assert spread.mean == pytest.approx(together.mean())
    assert spread.std == pytest.approx(together.std())
    assert spread.across == pytest.approx((5.0 - 2.0) / 2)
    assert math.isnan(Results([]).spread(cells, "e").mean)


def test_twelve_keypoints_are_the_limbs_and_the_rest_is_missing():
    simulation = simulation_of(TwinCell(scene="S1 FS3", cameras=2, imus=0, keypoints="limbs12"))
    found = np.zeros(25, dtype=bool)
    for view in simulation.views:
        for people in view.people[:60]:
            found |= (people[:, :, 2] > 0).any(axis=0)
    names = np.array(simulation.landmark_set.landmark_names)
    assert set(names[found]) == set(LIMBS_12)


def test_a_solver_told_the_stature_gets_reference_bones_and_the_truth_stays():
    measured = simulation_of(TwinCell(scene="S1 FS3", cameras=1, imus=0))
    told = simulation_of(TwinCell(scene="S1 FS3", cameras=1, imus=0, body="height"))
    assert told.people[0].shape.height_m == measured.people[0].shape.height_m
    assert not np.allclose(told.people[0].shape.offsets_m, measured.people[0].shape.offsets_m)
    assert np.array_equal(told.truth.theta, measured.truth.theta)
    assert np.array_equal(told.truth.offsets_m, measured.truth.offsets_m)


def test_every_other_camera_of_the_ring():
    simulation = simulation_of(TwinCell(scene="S1 FS3", imus=0, every_other_camera=True))
    assert simulation.rig.names == ("cam1", "cam3", "cam5", "cam7")


def test_mean_offsets_are_symmetric_and_reach_the_solver():
    sequence = twin_sequences()[0]
    offsets = mean_offsets([twin_simulation(sequence, cameras=0, imus=0)])
    assert np.allclose(np.array(offsets["left_hip"]) * [-1, 1, 1], offsets["right_hip"])
    cell = TwinCell(scene=sequence.key, cameras=1, imus=0, offsets=offsets)
    simulation = simulation_of(cell)
    used = simulation.landmark_set.offsets_m(person(1.0))
    assert np.allclose(used[simulation.landmark_set.index("nose")], offsets["nose"])


def test_depth_below_the_floor_of_a_worked_example():
    theta = walk(person(), 10)[None]
    take = take_of(theta, [person()], names=("anna",))
    assert below_floor(take) == {"share": 0.0, "mean_mm": 0.0, "worst_mm": 0.0}
    theta[0, 5:, 1] -= 1.0
    sunk = below_floor(take_of(theta, [person()], names=("anna",)))
    assert sunk["share"] == 0.5 and 800 < sunk["worst_mm"] < 1000
    nobody = replace(take, tracked=np.zeros_like(take.tracked))
    assert math.isnan(below_floor(nobody)["share"])


def test_what_is_not_a_number_is_none_in_json():
    value = {"a": [np.float64(1.5), math.nan, (np.int64(2), "x")], "b": None}
    assert plain(value) == {"a": [1.5, None, [2, "x"]], "b": None}


def test_a_table_in_three_formats():
    table = Table(
        title="T", columns=("name", "x mm"), rows=(("a|b", 1.25), ("c", math.nan)), note="N."
    )
    assert table.markdown().splitlines() == [
        "### T",
        "",
        "| name | x mm |",
        "| --- | ---: |",
        "| a/b | 1.2 |",
        "| c | – |",
        "",
        "N.",
    ]
    assert list(csv.reader(io.StringIO(table.csv()))) == [
        ["name", "x mm"],
        ["a|b", "1.25"],
        ["c", ""],
    ]
    assert table.as_json()["rows"] == [["a|b", 1.25], ["c", None]]
    with pytest.raises(ValueError, match="under"):
        Table(title="T", columns=("a",), rows=(("x", "y"),))


def fusecap(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fusecap", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | environment,
    )


@pytest.mark.slow
def test_a_command_solves_reports_and_resumes(tmp_path):
    command = ("evaluate", "table4", "--quick", "--sequences", "S2 FS1", "--out", tmp_path)
    first = fusecap(*command, "--json")
    assert first.returncode == 0, first.stderr
    report = json.loads(first.stdout)
    assert report["simulated"] is True and report["cells"] == 3
    cells = sorted((tmp_path / "cells").iterdir())
    assert len(cells) == 3
    written = [path.stat().st_mtime_ns for path in cells]
    again = fusecap(*command)
    assert again.returncode == 0 and "simulated twin" in again.stdout
    assert [path.stat().st_mtime_ns for path in cells] == written
    assert json.loads((tmp_path / "table4.json").read_text())["tables"] == report["tables"]


def test_misuse_of_an_experiment_is_explained(tmp_path):
    for arguments, code, message in (
        (("--sequences", "S9"), 1, "no sequence 'S9'"),
        (("--weights", "papr"), 2, "did you mean 'paper'"),
        (("--workers", "0"), 2, "--workers"),
    ):
        result = fusecap("evaluate", "table1", "--out", tmp_path, *arguments)
        assert result.returncode == code
        assert message in " ".join(result.stderr.split())
        assert "Traceback" not in result.stderr
