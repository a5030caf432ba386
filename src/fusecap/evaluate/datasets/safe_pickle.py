"""Pickles that may hold nothing but plain values and numpy arrays.

A pickle is a program: unpickled the ordinary way, a downloaded file can run any command. What lets
it is the opcode that looks up a callable by name, so this unpickler answers that opcode for the
few names that an array needs, with functions of its own, and refuses every other. Arrays are
rebuilt empty and filled from the bytes in the file, so a file cannot ask for more memory than it
has bytes.

What is left is C that believes the file: NumPy ends the process over a dtype's state with too few
entries, and the unpickler in C allots room for as many remembered values as the highest number
among them says. So dtypes and the states of arrays are checked here before NumPy sees them, and
the unpickler is the one in Python.

    allowed     None, bool, int, float, str, bytes, list, tuple, dict, set, numpy arrays and scalars
    refused     everything else, by name, before anything is called
"""

from __future__ import annotations

import io
import math
import pickle
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import InputError
from fusecap.inputs import DATASET, open_input


def load_pickle(path: Path | str) -> Any:
    """The value in a pickle file, Python 2's included; raises `InputError`."""
    path = Path(path)
    with open_input(path, DATASET) as file:
        return _load(file, str(path))


def load_npz_object(path: Path | str, name: str) -> Any:
    """The single object that an `.npz` holds under `name`; raises `InputError`."""
    path = Path(path)
    try:
        with (
            open_input(path, DATASET) as file,
            zipfile.ZipFile(file) as archive,
            archive.open(f"{name}.npy") as member,
        ):
            data = io.BytesIO(member.read(DATASET.most_bytes or -1))
        version = np.lib.format.read_magic(data)
        read_header = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, _, dtype = read_header(data)
    except KeyError:
        raise InputError(f"{path}: holds no '{name}'; expected an .npz that does") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: not an .npz, or cut short: {error}") from None
    if not dtype.hasobject or shape not in ((), (1,)):
        raise InputError(f"{path}: '{name}' is an array of {dtype}, expected a single object")
    value = _load(data, str(path))
    return value.reshape(-1)[0] if isinstance(value, np.ndarray) else value


_PLAIN = re.compile(r"[<>|=]?([biufcSU][0-9]{1,6}|O8?|[?bBhHiIlLqQefdgSU])")


class _Refused(Exception):
    pass


def _load(file: io.BufferedIOBase, where: str) -> Any:
    try:
        return _ArraysOnly(file, encoding="latin1").load()
    except _Refused as error:
        raise InputError(
            f"{where}: the pickle asks for {error}, which is neither plain data nor a numpy array; "
            "it is refused, for it could run any code"
        ) from None
    except Exception as error:  # an unpickler fed with garbage raises whatever it stumbles over
        raise InputError(
            f"{where}: not a pickle of arrays, or cut short ({type(error).__name__}: {error})"
        ) from None


class _Dtype:
    """One of plain numbers, text or objects, as a pickle makes it: a name, then its byte order."""

    def __init__(self, name: str, align: object = False, copy: object = False) -> None:
        if not _PLAIN.fullmatch(name):
            raise ValueError(f"an array of {name[:40]!r}")
        self.value = np.dtype(name)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _version, order, subarray, names, fields, *_ = state
        if order not in ("<", ">", "|", "=") or (subarray, names, fields) != (None, None, None):
            raise ValueError("an array of records")
        self.value = self.value.newbyteorder(order)


class _Array(np.ndarray):
    """Empty, until its state has been read."""

    def __setstate__(self, state: tuple[Any, ...], /) -> None:
        version, shape, dtype, is_fortran, data = state
        if any(type(length) is not int or length < 0 for length in shape):
            raise ValueError(f"an array of shape {shape!r}")
        if dtype.value.hasobject:
            count, there = math.prod(shape), len(list(data))
        else:
            data = _bytes(data)
            count, there = math.prod(shape) * dtype.value.itemsize, len(data)
        if count != there:
            raise ValueError(f"an array of shape {shape!r} and {there} bytes")
        checked: Any = (version, tuple(shape), dtype.value, bool(is_fortran), data)
        super().__setstate__(checked)


def _bytes(data: bytes | str) -> bytes:
    return data.encode("latin1") if isinstance(data, str) else bytes(data)


def _empty_array(subtype: Any, shape: Any, typecode: Any) -> np.ndarray:
    return _Array((0,), dtype="b")


def _array_of_buffer(buffer: Any, dtype: _Dtype, shape: Any, order: str) -> np.ndarray:
    values = np.frombuffer(buffer, dtype=dtype.value)
    return values.reshape(shape, order="F" if order == "F" else "C")


def _scalar(dtype: _Dtype, data: bytes | str = b"") -> Any:
    return np.frombuffer(_bytes(data), dtype=dtype.value, count=1)[0]


def _latin1(text: str, encoding: str = "latin1") -> bytes:
    return text.encode("latin1")


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): "an array",
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _latin1,
}
for _core in ("numpy.core", "numpy._core"):
    _ADMITTED[(f"{_core}.multiarray", "_reconstruct")] = _empty_array
    _ADMITTED[(f"{_core}.multiarray", "scalar")] = _scalar
    _ADMITTED[(f"{_core}.numeric", "_frombuffer")] = _array_of_buffer


class _ArraysOnly(pickle._Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ADMITTED[(module, name)]
        except KeyError:
            raise _Refused(f"{module}.{name}") from None

    def persistent_load(self, pid: Any) -> Any:
        raise _Refused("an object outside the file")
