"""What the package imports is what it says that it needs."""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def name_of(requirement: str) -> str:
    match = re.match(r"[\w.-]+", requirement)
    assert match is not None
    return match[0].lower().replace("_", "-")


def imported(file: Path) -> Iterator[str]:
    """Of each import, also by name and inside functions, the first word."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        match node:
            case ast.Import():
                yield from (alias.name.partition(".")[0] for alias in node.names)
            case ast.ImportFrom(module=str(module), level=0):
                yield module.partition(".")[0]
            case ast.Call(
                func=ast.Attribute(attr="import_module"), args=[ast.Constant(value=str(module)), *_]
            ):
                yield module.partition(".")[0]


def distributions_imported() -> set[str]:
    """By the names of packages; of an extra that is not installed, the module's own."""
    packages = metadata.packages_distributions()
    modules = {module for file in (ROOT / "src").rglob("*.py") for module in imported(file)}
    part_of_pydantic = {"pydantic_core"}
    others = modules - set(sys.stdlib_module_names) - {"fusecap"} - part_of_pydantic
    return {name_of(packages.get(module, [module])[0]) for module in others}


def declared() -> set[str]:
    extras = PROJECT["optional-dependencies"].values()
    return {
        name_of(requirement)
        for group in (PROJECT["dependencies"], *extras)
        for requirement in group
    }


def test_every_import_is_declared_and_every_dependency_imported():
    assert distributions_imported() == declared()
