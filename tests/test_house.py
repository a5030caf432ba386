"""Rules of the house that a reader could break without noticing."""

from __future__ import annotations

import ast
import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import pytest

import fusecap
import fusecap.exports.formats as exports
import fusecap.motion.files as motions
import fusecap.sources.calibration_files.formats as calibrations
import fusecap.sources.imu_files.formats as imus
import fusecap.sources.imu_streams as sensors
import fusecap.streams.protocols as protocols


@pytest.mark.parametrize(
    ("folder", "table"),
    [
        (exports, exports.FORMATS),
        (protocols, protocols.NAMES),
        (sensors, sensors.NAMES),
        (imus, [name.replace("-", "_") for name in imus.NAMES]),
        (calibrations, calibrations.NAMES),
        (motions, motions.NAMES),
    ],
)
def test_every_module_of_a_format_folder_stands_in_its_table(folder, table):
    modules = [path.stem for path in Path(folder.__file__).parent.glob("*.py")]
    assert sorted({*modules} - {"__init__"}) == sorted(table)


PACKAGE = Path(fusecap.__file__).parent
KERNELS = {"fusecap.kernels", "numpy", "numba", *sys.stdlib_module_names}


def shared_names(files: Iterable[Path]) -> dict[str, list[str]]:
    """Public classes that more than one module defines."""
    homes = defaultdict[str, list[str]](list)
    for path in files:
        for node in ast.parse(path.read_bytes()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(path.stem)
    return {name: where for name, where in homes.items() if len(where) > 1}


def foreign_imports(source: str | bytes) -> list[str]:
    """What a kernel's module imports beyond kernels, arrays, the compiler and Python itself."""
    names = imported(source)
    return [n for n in names if not any(f"{n}.".startswith(f"{known}.") for known in KERNELS)]


def imported(source: str | bytes) -> list[str]:
    """Modules that a module names in its imports; a relative one begins with a dot."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names.append("." * node.level + (node.module or ""))
    return names


def test_public_class_names_are_unique(tmp_path):
    assert shared_names(PACKAGE.rglob("*.py")) == {}
    for name in ("one.py", "other.py"):
        (tmp_path / name).write_text("class Page: ...\nclass _Own: ...\n")
    found = shared_names(sorted(tmp_path.glob("*.py")))
    assert found == {"Page": ["one", "other"]}


def test_kernels_import_arrays_the_compiler_and_each_other_alone():
    for path in (PACKAGE / "kernels").rglob("*.py"):
        assert foreign_imports(path.read_bytes()) == [], path
    inside = "def f():\n    from fusecap.geometry import camera\n    import numpy.linalg"
    assert foreign_imports(inside) == ["fusecap.geometry"]
    assert foreign_imports("import math, scipy.linalg, fusecap") == ["scipy.linalg", "fusecap"]


def test_modules_are_imported_by_their_full_names():
    """What a cell of a grid imports is followed by name: neither dots nor lazy names hide it."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0 and node.module != "fusecap", path
