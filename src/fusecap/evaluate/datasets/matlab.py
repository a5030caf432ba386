"""Cells of MATLAB 5 files, read by SciPy in a process of its own.

A spoilt file can make SciPy's reader crash, or ask for more memory than there is; so it ends the
process that reads it, and here that is a message. What that process says is taken as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.errors import InputError
from fusecap.inputs import DATASET, check_input, open_input

MOST_S = 120.0
MOST_MEMORY = 4 << 30
"""Of the process that reads, where the system can bound it."""
_REFUSED = 3

Cells = list[Any] | np.ndarray
"""Of cells, in lists, and matrices of numbers."""


def read_cells(path: Path, name: str) -> Cells:
    """The variable of that name: cells as lists, matrices of numbers as they are.

    Anything else is a matrix without elements. Raises `InputError`.
    """
    check_input(path, DATASET)
    command = [sys.executable, "-m", __spec__.name, str(path), name]
    try:
        run = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=MOST_S, errors="replace"
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{path}: not read within {MOST_S:.0f} s; it may be damaged") from None
    if run.returncode == _REFUSED:
        raise InputError(run.stdout)
    if run.returncode:
        raise InputError(
            f"{path}: not a MATLAB 5 file, or damaged: SciPy's reader of them broke down on it"
        )
    return _arrays(json.loads(run.stdout))


def _arrays(value: Any) -> Cells:
    if isinstance(value, list):
        return [_arrays(cell) for cell in value]
    return np.array(value["numbers"], dtype=np.float64).reshape(value["shape"])


def _plain(value: Any) -> Any:
    array = np.asarray(value)
    if array.dtype == object:
        return [_plain(cell) for cell in array.reshape(-1)]
    if array.dtype.kind == "c":
        raise ValueError("complex numbers, expected real ones")
    if array.dtype.kind not in "biuf":
        return {"numbers": [], "shape": [0]}
    return {"numbers": array.reshape(-1).tolist(), "shape": array.shape}


def _main(path: str, name: str) -> None:
    """In the process that may die."""
    from scipy.io import loadmat

    try:
        import resource
    except ImportError:
        pass
    else:
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
    try:
        with open_input(path, DATASET) as file:
            data = loadmat(file, variable_names=[name])
        if name not in data:
            raise InputError(f"{path}: holds no {name}")
        text = json.dumps(_plain(data[name]))
    except InputError as error:
        sys.stdout.write(str(error))
        sys.exit(_REFUSED)
    except Exception as error:  # SciPy's reader raises whatever garbage makes it stumble over
        sys.stdout.write(f"{path}: not a MATLAB 5 file, or cut short: {error}")
        sys.exit(_REFUSED)
    sys.stdout.write(text)


if __name__ == "__main__":
    _main(*sys.argv[1:])
