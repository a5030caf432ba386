"""Libraries that some formats need and a plain install does not bring."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType

from fusecap.errors import InputError
from fusecap.files import written_whole


def needed(module: str, *, extra: str) -> ModuleType:
    """An optional library; raises `InputError` with the command that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"this format needs {module.partition('.')[0]}, which cannot be imported ({error}); "
            f"install it with: pip install 'fusecap[{extra}]'"
        ) from error


def written_by_name(path: Path, write: Callable[[Path], object]) -> None:
    """`path` whole or not at all, from a library that opens files itself by their names."""
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / f"export{path.suffix}"
        write(part)
        with part.open("rb") as source, written_whole(path) as target:
            shutil.copyfileobj(source, target, 1 << 20)
