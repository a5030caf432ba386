"""Writing files whole or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from fusecap.errors import TakeError


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[BinaryIO]:
    """A binary file that takes its name only once complete; parents are made.

    Whatever was at `path` stays until then, and stays for good when writing fails. Raises
    `TakeError` with the operating system's reason.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with part.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise TakeError(f"cannot write {path}: {error.strerror or error}") from error


def safe_name(name: str) -> str:
    """`name` as part of a file name on any system: odd characters become underscores."""
    kept = "".join(c if c.isalnum() or c in "-_" else "_" for c in name.strip())
    return kept[:64] or "unnamed"
