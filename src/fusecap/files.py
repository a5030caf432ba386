"""Writing files whole or not at all, what JSON can hold, and numbers too many for memory."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from fusecap.errors import FusecapError, TakeError

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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


def write_whole(path: Path, content: str | bytes) -> None:
    """All at once, text as UTF-8; fails as `written_whole`."""
    with written_whole(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_picture(figure: Figure, path: Path) -> None:
    """A PNG; fails as `written_whole`."""
    with written_whole(path) as file:
        figure.savefig(file, dpi=80, format="png")


def check_writable(path: Path) -> None:
    """Before the work that fills it: raises `TakeError` where no file could be written here."""
    folder = next(above for above in path.absolute().parents if above.exists())
    if path.is_dir():
        reason = "it is a folder"
    elif not folder.is_dir():
        reason = f"{folder} is not a folder"
    elif not os.access(folder, os.W_OK):
        reason = f"no permission to write in {folder}"
    else:
        return
    raise TakeError(f"cannot write {path}: {reason}")


def safe_name(name: str) -> str:
    """`name` as part of a file name on any system: odd characters become underscores."""
    kept = "".join(c if c.isalnum() or c in "-_" else "_" for c in name.strip())
    return kept[:64] or "unnamed"


def distinct_names(names: Iterable[str]) -> list[str]:
    """`safe_name` of each, numbered so that no two are one file, whatever the system's case."""
    distinct: dict[str, str] = {}
    for name in names:
        bare = safe_name(name)
        tries = itertools.chain([bare], (f"{bare}_{number}" for number in itertools.count(2)))
        free = next(each for each in tries if each.casefold() not in distinct)
        distinct[free.casefold()] = free
    return list(distinct.values())


def plain(value: Any) -> Any:
    """For JSON: arrays as lists, enums by value, numbers that are not finite as null."""
    match value:
        case Mapping():
            return {str(key): plain(item) for key, item in value.items()}
        case list() | tuple():
            return [plain(item) for item in value]
        case np.ndarray() | np.generic():
            return plain(value.tolist())
        case Enum():
            return value.value
        case float() if not math.isfinite(value):
            return None
    return value


@contextlib.contextmanager
def _room() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FusecapError(
            f"no room in {tempfile.gettempdir()} for what a take needs while it is made "
            f"({error.strerror or error}): set TMPDIR to a folder with more"
        ) from error


def _closed(file: Any) -> None:
    with contextlib.suppress(OSError):  # of a full disk, which was told of
        file.close()


class Spool:
    """Bytes in an unnamed temporary file once they are many; gone when nobody holds it."""

    IN_MEMORY = 1 << 22

    def __init__(self) -> None:
        # It ends with this object, not with a block.
        self._file = tempfile.SpooledTemporaryFile(self.IN_MEMORY, prefix="fusecap-")  # noqa: SIM115
        self._length, self._at_end = 0, True
        weakref.finalize(self, _closed, self._file)

    def __len__(self) -> int:
        return self._length

    def append(self, data: bytes, at: int | None = None) -> None:
        """At the end, or `at` a byte which then ends what was there.

        Raises `FusecapError` where the disk is full.
        """
        at = self._length if at is None else at
        with _room():
            if not self._at_end or at != self._length:
                self._file.seek(at)
            self._at_end = False
            self._file.write(data)
        self._length, self._at_end = at + len(data), True

    def read(self, first: int, count: int) -> bytearray:
        """So many bytes from the `first`; fewer at the end. Fails as `append`, which may wait."""
        with _room():
            self._at_end = False
            self._file.seek(first)
            return bytearray(self._file.read(count))

    def parts(self) -> Iterator[bytearray]:
        """All of it, piece by piece."""
        for first in range(0, self._length, self.IN_MEMORY):
            yield self.read(first, self.IN_MEMORY)
