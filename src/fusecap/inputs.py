"""The one entrance of files from outside: regular ones, of bounded size, before any of it is read.

A pipe is waited for and a device never ends, and both say that they hold 0 bytes. So what is
opened here is opened without waiting, is a regular file (links are followed), is no larger than
its kind may be, and no more than that is read from it. What a text unpacks to is bounded as well:
a dotted TOML key of n parts costs its parser n²/2 references, an array of an .npz says how large it
wants to become.
"""

from __future__ import annotations

import codecs
import io
import itertools
import json
import math
import os
import re
import stat
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import CalibrationError, InputError, SessionError, TakeError

MOST_NESTED = 64
"""Tables and lists inside each other, in TOML and JSON."""
MOST_KEY_PARTS = 10_000_000
"""Dots in keys of a TOML file times those of its longest: 80 MB of its parser's memory."""
MOST_ENTRIES = 1000
"""In a zip file."""
_MOST_NAMED = 4
"""Files beside one that is missing; more are no help."""
_LOCAL_HEADER = struct.Struct("<26x2H")
"""Before an entry of a zip file; how long its name and its remarks are, which follow."""

_PART = r"""(?:[\w-]+|"(?:\\[^\n]|[^"\\\n])*"?|'[^'\n]*'?)"""
_KEY_PART = re.compile(_PART)
_TOML_TOKEN = re.compile(
    r'"""(?:\\.|[^\\])*?(?:"{3,5}|\Z)'
    r"|'''.*?(?:'{3,5}|\Z)"
    r"|#[^\n]*"
    rf"|(?P<key>{_PART}(?:[ \t]*\.[ \t]*{_PART})*)(?P<named>[ \t]*[=\]])?",
    re.DOTALL,
)
"""Long strings, comments, and keys or values; a string that never ends is one to its line's end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InputKind:
    """What a file is to be, and how large it may be."""

    what: str
    """After "expected"."""
    most_bytes: int | None
    """Also of what the arrays of an .npz unpack to; None for what is read piece by piece."""
    error: type[InputError] = InputError


_MB = 1 << 20

SESSION = InputKind(what="a session file", most_bytes=4 * _MB, error=SessionError)
SETTINGS = InputKind(what="a TOML file that fusecap wrote", most_bytes=4 * _MB)
CALIBRATION = InputKind(
    what="a calibration of cameras", most_bytes=16 * _MB, error=CalibrationError
)
KEYPOINTS = InputKind(what="keypoints of one frame as JSON", most_bytes=4_000_000)
KEYPOINT_TABLE = InputKind(what="keypoints as an array (.npy)", most_bytes=4096 * _MB)
DETECTION = InputKind(what="the record of a detection", most_bytes=64 * _MB)
SENSORS = InputKind(what="samples of sensors", most_bytes=1024 * _MB)
POINTS = InputKind(what="a table of points as CSV", most_bytes=16 * _MB)
FRAME_TIMES = InputKind(what="times of frames as CSV", most_bytes=512 * _MB)
PICTURE = InputKind(what="a picture", most_bytes=256 * _MB)
VIDEO = InputKind(what="a video", most_bytes=None)
RECORDING = InputKind(what="a recording (.mcap)", most_bytes=None)
TAKE = InputKind(what="a take (.npz)", most_bytes=4096 * _MB, error=TakeError)
PRIOR = InputKind(what="a pose prior (.npz)", most_bytes=64 * _MB)
BOARD = InputKind(what="a board (board.toml)", most_bytes=4 * _MB, error=CalibrationError)
MOTION = InputKind(what="a motion file", most_bytes=256 * _MB)
MADE_FILES = InputKind(what="a list of files made from a take", most_bytes=4 * _MB)
CHARACTER = InputKind(what="a character (.glb, .vrm)", most_bytes=1024 * _MB)
NETWORK = InputKind(what="a network (.onnx, .xml, .tflite)", most_bytes=2048 * _MB)
DATASET = InputKind(what="a file of a data set", most_bytes=2048 * _MB)
ARCHIVE = InputKind(what="an archive", most_bytes=None)
CELL = InputKind(what="a cell of an experiment", most_bytes=64 * _MB)

KINDS = (
    *(SESSION, SETTINGS, CALIBRATION, BOARD, KEYPOINTS, DETECTION, SENSORS, POINTS),
    KEYPOINT_TABLE,
    *(
        FRAME_TIMES,
        PICTURE,
        VIDEO,
        RECORDING,
        TAKE,
        PRIOR,
        MOTION,
        MADE_FILES,
        CHARACTER,
        NETWORK,
        DATASET,
        ARCHIVE,
        CELL,
    ),
)


def open_input(path: Path | str, kind: InputKind) -> io.BufferedReader:
    """The file, open for reading; raises `kind.error` for anything that is not such a file."""
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    try:
        handle = os.open(path, flags)
    except FileNotFoundError:
        beside = _beside(Path(path))
        raise kind.error(f"{path}: no such file; expected {kind.what}{beside}") from None
    except IsADirectoryError:
        raise kind.error(f"{path}: is a folder; expected {kind.what}") from None
    except (OSError, ValueError) as error:
        raise kind.error(f"{path}: cannot be read: {_reason(error)}") from None
    try:
        _check(path, kind, os.fstat(handle))
        return os.fdopen(handle, "rb")
    except BaseException:
        os.close(handle)
        raise


def _beside(path: Path) -> str:
    """What is there of the same ending, for who guessed the name of a file."""
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry in itertools.islice(entries, MOST_ENTRIES)]
    except (OSError, ValueError):
        return ""
    alike = sorted(name for name in names if path.suffix and name.endswith(path.suffix))
    return f"; there is {', '.join(alike)}" if 0 < len(alike) <= _MOST_NAMED else ""


def check_input(path: Path | str, kind: InputKind) -> None:
    """For a library that opens the file itself: raises as `open_input`."""
    open_input(path, kind).close()


def read_bytes(path: Path | str, kind: InputKind) -> bytes:
    """All of the file; raises `kind.error`."""
    with open_input(path, kind) as file:
        try:
            content = file.read() if kind.most_bytes is None else file.read(kind.most_bytes + 1)
        except OSError as error:
            raise kind.error(f"{path}: cannot be read: {_reason(error)}") from None
    if kind.most_bytes is not None and len(content) > kind.most_bytes:
        raise _too_large(path, kind, len(content))
    return content


def read_text(path: Path | str, kind: InputKind, *, strict: bool = True) -> str:
    """UTF-8, with or without a byte order mark; raises `kind.error`.

    Unless `strict`, bytes that are no text become question marks.
    """
    try:
        return read_bytes(path, kind).decode("utf-8-sig", "strict" if strict else "replace")
    except UnicodeDecodeError as error:
        raise kind.error(f"{path}: cannot be read as UTF-8 text: {error}") from None


def read_lines(path: Path | str, kind: InputKind) -> Iterator[str]:
    """Those of a text in UTF-8 or UTF-16, one at a time; raises `kind.error`.

    Bytes that are no text become question marks.
    """
    with open_input(path, kind) as file:
        try:
            wide = file.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
            encoding = "utf-16" if wide else "utf-8-sig"
            with io.TextIOWrapper(file, encoding=encoding, errors="replace") as text:
                for line in text:
                    yield line.removesuffix("\n")
        except OSError as error:
            raise kind.error(f"{path}: cannot be read: {_reason(error)}") from None


def read_toml(path: Path | str, kind: InputKind) -> dict[str, Any]:
    """The tables of a TOML file; raises `kind.error`, also for whole numbers beyond 64 bits."""
    text = read_text(path, kind)
    dots = _dots_of_keys(text)
    most = max(dots, default=0)
    if most > MOST_NESTED or most * sum(dots) > MOST_KEY_PARTS:
        raise kind.error(f"{path}: a key with {most} dots; keys of so many parts are not read")
    try:
        return _bounded(path, kind, tomllib.loads(text))
    except (ValueError, RecursionError) as error:
        raise kind.error(f"{path}: not valid TOML: {_reason(error)}") from None


def _dots_of_keys(text: str) -> list[int]:
    """Of each key of a TOML text, in time that grows with its length alone."""
    return [
        len(_KEY_PART.findall(token["key"])) - 1
        for token in _TOML_TOKEN.finditer(text)
        if token["named"] is not None
    ]


def read_json(path: Path | str, kind: InputKind) -> Any:
    """The value of a JSON file; raises `kind.error`, also for whole numbers beyond 64 bits."""
    text = read_text(path, kind)
    try:
        return _bounded(path, kind, json.loads(text))
    except (ValueError, RecursionError) as error:
        raise kind.error(f"{path}: not valid JSON: {_reason(error)}") from None


def read_npz(path: Path | str, kind: InputKind, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Those of the named arrays that an .npz holds; raises `kind.error`.

    Other entries are not touched. What an array's header asks for must be in the file.
    """
    with NpzFile(path, kind, names) as file:
        return {name: file.array(name) for name in file.names}


class NpzFile:
    """Those of the named arrays that an .npz holds, open to be read whole or by rows.

    Raises `kind.error`, here and in reading. Not to be shared by threads.
    """

    def __init__(self, path: Path | str, kind: InputKind, names: Iterable[str]) -> None:
        self._path, self._kind = path, kind
        self._file = open_input(path, kind)
        try:
            with self._told():
                self._archive = zipfile.ZipFile(self._file)
                self._entries = _wanted(self._archive, kind, names)
        except BaseException:
            self._file.close()
            raise

    @property
    def names(self) -> tuple[str, ...]:
        """That were asked for and are there."""
        return tuple(self._entries)

    def array(self, name: str) -> np.ndarray:
        """All of an array."""
        with self._told():
            return _array(self._archive, self._entries[name])

    def rows(self, name: str) -> NpzRows:
        """An array of two dimensions or more to be read by rows; its checksum is checked now."""
        entry = self._entries[name]
        with self._told():
            shape, dtype, start, in_order = _layout(self._archive, entry)
            if len(shape) < 2:
                raise ValueError(f"{name} is {shape}, expected rows")
            if entry.compress_type != zipfile.ZIP_STORED or not in_order:
                return NpzRows(self, shape, dtype, held=_array(self._archive, entry))
            with self._archive.open(entry) as member:
                while member.read(_MB):
                    pass
            self._file.seek(entry.header_offset)
            fields = _LOCAL_HEADER.unpack(self._file.read(_LOCAL_HEADER.size))
            start += entry.header_offset + _LOCAL_HEADER.size + sum(fields)
        return NpzRows(self, shape, dtype, start=start)

    def bytes_at(self, offset: int, count: int) -> bytes:
        """So many bytes of the file; raises where it has been cut since it was opened."""
        with self._told():
            self._file.seek(offset)
            content = self._file.read(count)
            if len(content) != count:
                raise EOFError("it became shorter while it was read")
        return content

    def close(self) -> None:
        """Nothing more is read."""
        self._archive.close()
        self._file.close()

    def __enter__(self) -> NpzFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Whatever reading raises becomes the kind's error."""
        try:
            yield
        except (zipfile.BadZipFile, zlib.error, EOFError) as error:
            raise self._kind.error(
                f"{self._path}: is damaged or cut short, or not {self._kind.what} "
                f"({_reason(error)})"
            ) from None
        except Exception as error:  # the readers raise whatever garbage makes them stumble over
            raise self._kind.error(
                f"{self._path}: cannot be read ({_reason(error)}); expected {self._kind.what}"
            ) from None


class NpzRows:
    """An array of an open .npz; from the disk, or held where it is packed."""

    def __init__(
        self,
        file: NpzFile,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        *,
        start: int = 0,
        held: np.ndarray | None = None,
    ) -> None:
        self.shape, self.dtype = shape, dtype
        self._file, self._start, self._held = file, start, held

    def read(self, row: int, first: int, end: int) -> np.ndarray:
        """`array[row, first:end]`, of numbers within its shape."""
        if self._held is not None:
            return self._held[row, first:end]
        item = math.prod(self.shape[2:])
        offset = (row * self.shape[1] + first) * item * self.dtype.itemsize
        count = (end - first) * item * self.dtype.itemsize
        content = self._file.bytes_at(self._start + offset, count)
        return np.frombuffer(content, self.dtype).reshape(end - first, *self.shape[2:])


def _wanted(
    archive: zipfile.ZipFile, kind: InputKind, names: Iterable[str]
) -> dict[str, zipfile.ZipInfo]:
    entries = archive.infolist()
    if len(entries) > MOST_ENTRIES:
        raise ValueError(f"{len(entries)} entries, at most {MOST_ENTRIES} are read")
    stated = {entry.filename: entry for entry in entries}
    wanted = {name: stated[f"{name}.npy"] for name in names if f"{name}.npy" in stated}
    unpacked = sum(entry.file_size for entry in wanted.values())
    if kind.most_bytes is not None and unpacked > kind.most_bytes:
        raise ValueError(f"unpacks to {unpacked} bytes, at most {kind.most_bytes} are read")
    return wanted


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    _layout(archive, entry)
    with archive.open(entry) as member:
        return np.lib.format.read_array(member, allow_pickle=False)


def _layout(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo
) -> tuple[tuple[int, ...], np.dtype[Any], int, bool]:
    """Shape, type, bytes before the first number, and whether the last index runs fastest."""
    name = entry.filename
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is packed in an unknown way")
    with archive.open(entry) as member:
        major, minor = np.lib.format.read_magic(member)
        header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }.get((major, minor))
        if header is None:
            raise ValueError(f"{name} is an array of version {major}.{minor}")
        shape, fortran, dtype = header(member)
        if dtype.kind not in "biufSU":
            raise ValueError(f"{name} holds {dtype}, expected numbers or text")
        if dtype.itemsize == 0 or math.prod(shape) * dtype.itemsize > entry.file_size:
            raise ValueError(f"{name} states {shape} of {dtype}, more than the file holds")
        return shape, dtype, member.tell(), not fortran


def _bounded(path: Path | str, kind: InputKind, value: Any) -> Any:
    """`value`; raises where it is nested too deeply or holds a whole number beyond 64 bits."""
    level = [value]
    for _ in range(MOST_NESTED):
        below: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                below += item.values()
            elif isinstance(item, list):
                below += item
            elif isinstance(item, int) and abs(item) >= 1 << 63:
                raise kind.error(
                    f"{path}: holds a whole number of {item.bit_length()} bits; expected a number "
                    "that fits into 64"
                )
        if not below:
            return value
        level = below
    raise kind.error(f"{path}: tables or lists stand in each other more than {MOST_NESTED} deep")


def _check(path: Path | str, kind: InputKind, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        found = next((name for test, name in _OTHERS if test(status.st_mode)), "no regular file")
        raise kind.error(f"{path}: is {found}; expected {kind.what} as an ordinary file")
    if kind.most_bytes is not None and status.st_size > kind.most_bytes:
        raise _too_large(path, kind, status.st_size)


_OTHERS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def _too_large(path: Path | str, kind: InputKind, found: int) -> InputError:
    return kind.error(f"{path}: has {found} bytes or more; {kind.what} may have {kind.most_bytes}")


def _reason(error: Exception) -> str:
    if isinstance(error, RecursionError):
        return "tables or lists stand in each other too deeply"
    return getattr(error, "strerror", None) or str(error) or type(error).__name__
