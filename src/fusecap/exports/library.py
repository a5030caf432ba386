"""Libraries that some formats need and a plain install does not bring."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from fusecap.errors import InputError, from_extra
from fusecap.files import written_whole


def missing(error: ImportError, *, extra: str) -> InputError:
    """What to say of an optional library that cannot be imported: the command that installs it."""
    return InputError(
        f"this format needs a library that cannot be imported ({error}); {from_extra(extra)}"
    )


def written_by_name(path: Path, write: Callable[[Path], object]) -> None:
    """`path` whole or not at all, from a library that opens files itself by their names."""
    with tempfile.TemporaryDirectory() as folder:
        part = Path(folder) / f"export{path.suffix}"
        write(part)
        with part.open("rb") as source, written_whole(path) as target:
            shutil.copyfileobj(source, target, 1 << 20)
