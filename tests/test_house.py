"""Rules of the house that a reader could break without noticing."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

import fusecap.export.formats as exports
import fusecap.streams.protocols as protocols


@pytest.mark.parametrize(
    ("folder", "table"), [(exports, exports.FORMATS), (protocols, protocols.NAMES)]
)
def test_every_module_of_a_format_folder_stands_in_its_table(folder, table):
    modules = [path.stem for path in Path(folder.__file__).parent.glob("*.py")]
    assert sorted({*modules} - {"__init__"}) == sorted(table)


@pytest.mark.parametrize("name", exports.FORMATS)
def test_an_export_says_how_its_files_end(name):
    module = import_module(f"{exports.__name__}.{name}")
    assert module.FORMAT.suffix.startswith(".")
