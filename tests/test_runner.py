"""The grid runner: all cores or Ray, restart, and failures that stay in their cell."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import fusecap
from fusecap.errors import InputError
from fusecap.evaluate.code_version import code_hash, versions_of
from fusecap.evaluate.runner import _same_code, cell_key, run_cells
from grid_cells import Square, cube, not_a_number, square

TESTS = Path(__file__).parent


def starts(log: Path) -> list[int]:
    return sorted(int(path.name.partition("_")[0]) for path in log.iterdir())


def test_cells_are_computed_once_and_returned_in_order(tmp_path):
    log, folder = tmp_path / "log", tmp_path / "cells"
    log.mkdir()
    cells = [Square(number=n, log=str(log)) for n in (3, 1, 2, 3)]
    seen, environment = [], dict(os.environ)
    outcomes = run_cells(
        cells,
        square,
        folder=folder,
        workers=2,
        progress=lambda outcome, done, total: seen.append((done, total)),
    )
    assert [o.result["square"] for o in outcomes if o.result] == [9, 1, 4, 9]
    assert all(o.result and o.result["threads"] == 1 for o in outcomes)
    assert starts(log) == [1, 2, 3]
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert dict(os.environ) == environment

    again = run_cells(cells, square, folder=folder, workers=2)
    assert [o.result for o in again] == [o.result for o in outcomes]
    assert all(o.resumed for o in again) and starts(log) == [1, 2, 3]


def test_a_key_changes_with_the_cell_the_work_and_the_versions():
    cell, versions = Square(number=1), {"code": "1"}
    keys = {
        cell_key(cell, square, versions),
        cell_key(Square(number=2), square, versions),
        cell_key(cell, cube, versions),
        cell_key(cell, square, {"code": "2"}),
        cell_key(cell, square, {"code": "1", "twin": "2"}),
    }
    assert len(keys) == 5
    assert cell_key(Square(number=1), square, dict(versions)) in keys


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    copy = tmp_path_factory.mktemp("tree") / "fusecap"
    ignored = shutil.ignore_patterns("__pycache__")
    return shutil.copytree(Path(fusecap.__file__).parent, copy, ignore=ignored)


@pytest.mark.parametrize(
    ("edited", "changes"),
    [
        ("evaluate/cells.py", True),
        ("sources/synchronizer.py", True),
        ("sources/__init__.py", True),
        ("kernels/terms/position.py", True),
        ("batch/solve.py", True),
        ("__init__.py", True),
        # Imported inside a function, by its name in a table, beside a name for type checkers.
        ("sources/calibration_files/loader.py", True),
        ("sources/imu_files/formats/mvnx.py", True),
        ("data/twin_motion.npz", True),
        ("viewer/take.py", False),
        ("cli/evaluate_twin.py", False),
        ("evaluate/runner.py", False),
        ("evaluate/experiments/table1.py", False),
        ("live/run.py", False),
    ],
)
def test_the_version_of_a_cells_code_changes_with_what_it_imports_alone(package, edited, changes):
    start, path = package / "evaluate/cells.py", package / edited
    before, content = code_hash(start, package), path.read_bytes()
    path.write_bytes(content + b"\n")
    assert (code_hash(start, package) != before) == changes
    path.write_bytes(content)
    assert code_hash(start, package) == before


def test_imports_in_functions_and_of_names_are_followed_and_those_for_types_are_not(tmp_path):
    package, start = tmp_path / "fusecap", tmp_path / "work.py"
    (package / "inner").mkdir(parents=True)
    files = {
        "__init__.py": "",
        "inner/__init__.py": "from fusecap.named import VALUE",
        "inner/module.py": "import fusecap.plain",
        "named.py": "VALUE = 1",
        "plain.py": "",
        "types.py": "",
        "unused.py": "",
    }
    for name, text in files.items():
        (package / name).write_text(text)
    start.write_text(
        "if TYPE_CHECKING:\n    from fusecap.types import A\n"
        "def work(cell):\n    from fusecap.inner import module\n"
    )
    matters = set()
    for name, text in files.items():
        before = code_hash(start, package)
        (package / name).write_text(text + "#")
        if code_hash(start, package) != before:
            matters.add(name)
    assert matters == set(files) - {"types.py", "unused.py"}


def test_python_and_the_libraries_are_part_of_the_version():
    assert {"code", "python", "numpy", "scipy", "numba"} == set(versions_of(square))
    assert versions_of(square)["code"] == versions_of(cube)["code"]


def test_a_node_with_other_code_or_libraries_computes_nothing():
    versions = versions_of(cube)
    assert _same_code(cube, Square(number=2), versions)[:2] == ({"cube": 8}, "")
    numpy = versions["numpy"]
    result, error, _ = _same_code(cube, Square(number=2), versions | {"numpy": "1.0"})
    assert result is None and error == f"this node has numpy {numpy}, not 1.0"


def test_a_failing_cell_is_reported_and_the_rest_is_kept(tmp_path):
    cells = [Square(number=n, does="raise" if n == 2 else "") for n in range(4)]
    outcomes = run_cells(cells, square, folder=tmp_path, workers=2)
    assert [o.error for o in outcomes] == ["", "", "ValueError: 2 is not to be squared", ""]
    assert [bool(o.result) for o in outcomes] == [True, True, False, True]
    assert len(list(tmp_path.glob("*.json"))) == 3


def test_a_result_that_json_cannot_hold_is_a_failure(tmp_path):
    (outcome,) = run_cells([Square(number=1)], not_a_number, folder=tmp_path, workers=1)
    assert "ValueError" in outcome.error


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("how", ["die", "end"])
def test_a_cell_that_kills_its_process_fails_alone(tmp_path, how):
    cells = [Square(number=n, does=how if n == 1 else "wait") for n in range(5)]
    outcomes = run_cells(cells, square, folder=tmp_path, workers=2)
    assert [o.error for o in outcomes] == ["", "its process was killed", "", "", ""]


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_closed_terminal_is_for_the_parent_alone(tmp_path):
    (outcome,) = run_cells([Square(number=2, does="hang up")], square, folder=tmp_path, workers=1)
    assert outcome.error == "" and outcome.result == {"square": 4, "threads": 1.0}


def test_a_cell_file_cut_short_is_computed_again(tmp_path):
    run_cells([Square(number=5)], square, folder=tmp_path, workers=1)
    (path,) = tmp_path.glob("*.json")
    path.write_text(path.read_text()[:40])
    (outcome,) = run_cells([Square(number=5)], square, folder=tmp_path, workers=1)
    assert outcome.result == {"square": 25, "threads": 1.0} and not outcome.resumed
    assert json.loads(path.read_text())["cell"]["number"] == 5


GRID = """
import sys
from pathlib import Path
from fusecap.evaluate.runner import run_cells
from grid_cells import Square, square

def main(folder, log, engine):
    cells = [Square(number=n, does="wait", log=log) for n in range(8)]
    cells.append(Square(number=8, does="raise"))
    cells.append(Square(number=9, does="die"))
    ray = None if engine == "cores" else engine
    done = run_cells(cells if ray else cells[:8], square, folder=Path(folder), workers=2, ray=ray)
    print([o.result["square"] if o.result else o.error for o in done])

if __name__ == "__main__":
    main(*sys.argv[1:])
"""


def grid(tmp_path: Path, engine: str) -> subprocess.Popen[str]:
    script = tmp_path / "grid.py"
    script.write_text(GRID)
    (tmp_path / "log").mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, script, tmp_path / "cells", tmp_path / "log", engine],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(TESTS)},
    )


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_killed_run_goes_on_without_redoing_finished_cells(tmp_path):
    killed = grid(tmp_path, "cores")
    while len(list((tmp_path / "cells").glob("*.json"))) < 3:
        assert killed.poll() is None
        time.sleep(0.02)
    killed.send_signal(signal.SIGKILL)
    killed.communicate(timeout=30)
    time.sleep(1.0)
    finished = {
        json.loads(path.read_text())["cell"]["number"]
        for path in (tmp_path / "cells").glob("*.json")
    }
    assert 3 <= len(finished) < 8
    # Workers end with the run that started them.
    before = starts(tmp_path / "log")
    time.sleep(0.6)
    assert starts(tmp_path / "log") == before

    out, err = grid(tmp_path, "cores").communicate(timeout=60)
    assert out.strip() == str([n**2 for n in range(8)]), err
    assert all(starts(tmp_path / "log").count(number) == 1 for number in finished)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_a_local_ray_cluster_computes_the_same_grid(tmp_path):
    out, err = grid(tmp_path, "local").communicate(timeout=180)
    if "Ray did not start" in err:
        pytest.skip("Ray's own processes did not start within its time limit on this busy machine")
    assert str([n**2 for n in range(8)])[:-1] in out, err
    assert "ValueError: 8 is not to be squared" in out
    assert "WorkerCrashedError" in out or "died" in out
    assert len(list((tmp_path / "cells").glob("*.json"))) == 8
    again, err = grid(tmp_path, "cores").communicate(timeout=60)
    assert again.strip() == str([n**2 for n in range(8)]), err
    assert all(starts(tmp_path / "log").count(number) == 1 for number in range(8))


@pytest.mark.skipif(importlib.util.find_spec("ray") is not None, reason="Ray is installed")
def test_ray_is_asked_for_by_name_where_it_is_absent(tmp_path):
    with pytest.raises(InputError, match="cluster"):
        run_cells([Square(number=1)], square, folder=tmp_path, ray="local")
