"""The version of the code that a function's results depend on: what its module really imports.

Imports are followed in the text, those inside functions too, so nothing is listed by hand. Not
followed: imports for type checkers alone, and with them the names that `fusecap` itself offers.
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import platform
from collections.abc import Callable, Iterator
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import fusecap

_LIBRARIES = ("numpy", "scipy", "numba")
_TABLE = ("import_module(f'{__name__}.", 'import_module(f"{__name__}.')
"""How a table of modules imports one of those beside it."""


def versions_of(work: Callable[..., Any]) -> dict[str, str]:
    """Versions of all that computes the results of `work`: our code, Python, the libraries."""
    libraries = {name: metadata.version(name) for name in _LIBRARIES}
    return {"code": code_version(work), "python": platform.python_version(), **libraries}


@cache
def code_version(work: Callable[..., Any]) -> str:
    """Version of the package, and a hash of the code that `work` runs and of the package's data."""
    digest = code_hash(Path(inspect.getfile(work)), Path(fusecap.__file__).parent)
    return f"{metadata.version('fusecap')}+{digest}"


def code_hash(start: Path, package: Path) -> str:
    """Of the module `start`, of all in `package` that it imports, and of the package's data."""
    files, new = {start}, [start]
    while new:
        found = {*_imported(new.pop(), package)} - files
        files |= found
        new += found
    digest = hashlib.sha256(start.read_bytes())
    for path in sorted({*files, *package.glob("data/*.npz")} - {start}):
        name = path.relative_to(package).as_posix()
        digest.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:12]


def _imported(path: Path, package: Path) -> Iterator[Path]:
    """Files of `package` that the module at `path` imports, with the packages they are in."""
    names, folder = _imports(path.read_bytes())
    if folder:
        yield from path.parent.glob("*.py")
    for name in names:
        first, *parts = name.split(".")
        if first != package.name:
            continue
        for count in range(len(parts) + 1):
            # A name may be a module or stand in one: what is no file is no module.
            place = package.joinpath(*parts[:count])
            files = (place / "__init__.py", place.with_suffix(".py"))
            yield from (file for file in files if file.is_file())


@cache
def _imports(source: bytes) -> tuple[set[str], bool]:
    """Names that a module imports, and whether it imports what is beside it by name."""
    names, folder = set[str](), False
    for node in _run(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and ast.unparse(node).startswith(_TABLE):
            folder = True
    return names, folder


def _run(tree: ast.AST) -> Iterator[ast.AST]:
    """Every node below `tree` but those for type checkers alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for other in node.orelse:
                yield other
                yield from _run(other)
        else:
            yield node
            yield from _run(node)
