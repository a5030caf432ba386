"""Pickles that may hold nothing but plain values and numpy arrays.

A pickle is a program: unpickled the ordinary way, a downloaded file can run any command. What lets
it is the opcode that looks up a callable by name, so this unpickler answers that opcode for the
few names that an array needs, with functions of its own, and refuses every other. Arrays are
rebuilt empty and filled from the bytes in the file, so a file cannot ask for more memory than it
has bytes.

    allowed     None, bool, int, float, str, bytes, list, tuple, dict, set, numpy arrays and scalars
    refused     everything else, by name, before anything is called
"""

from __future__ import annotations

import io
import pickle
import zipfile
import zlib
from collections.abc import Callable
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


def _empty_array(subtype: Any, shape: Any, typecode: Any) -> np.ndarray:
    return np.ndarray.__new__(np.ndarray, (0,), dtype="b")


def _array_of_buffer(buffer: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    return np.frombuffer(buffer, dtype=dtype).reshape(shape, order="F" if order == "F" else "C")


def _scalar(dtype: Any, data: bytes | str = b"") -> Any:
    raw = data.encode("latin1") if isinstance(data, str) else data
    return np.frombuffer(raw, dtype=dtype, count=1)[0]


def _latin1(text: str, encoding: str = "latin1") -> bytes:
    return text.encode("latin1")


_ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _latin1,
}
for _core in ("numpy.core", "numpy._core"):
    _ADMITTED[(f"{_core}.multiarray", "_reconstruct")] = _empty_array
    _ADMITTED[(f"{_core}.multiarray", "scalar")] = _scalar
    _ADMITTED[(f"{_core}.numeric", "_frombuffer")] = _array_of_buffer


class _ArraysOnly(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Callable[..., Any]:
        try:
            return _ADMITTED[(module_name, global_name)]
        except KeyError:
            raise _Refused(f"{module_name}.{global_name}") from None

    def persistent_load(self, pid: Any, /) -> Any:
        raise _Refused("an object outside the file")
