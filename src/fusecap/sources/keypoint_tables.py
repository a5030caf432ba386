"""Keypoints of all cameras in one NumPy array, as FreeMoCap writes them for MediaPipe.

    mediapipe2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy
    (cameras, frames, points, 2 or 3): x, y [px], perhaps depth; NaN where nobody was found

One person; hands and face follow the 33 points of BlazePose's body. There are no confidences: what
is there counts as sure. The file does not name its cameras: they stand in the order of their
videos' names.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float

from fusecap.errors import InputError
from fusecap.inputs import KEYPOINT_TABLE, open_input

SUFFIX = ".npy"
BODY_POINTS = 33
LANDMARK_SET = "blazepose33"


def read_table(path: Path, row: int, rows: int) -> Float[np.ndarray, "f 33 3"]:
    """The body's points of one of `rows` cameras: x [px], y [px], 1; NaN, NaN, 0 where missing.

    Raises `InputError`.
    """
    expected = (
        f"expected FreeMoCap's 2D data, an array of (cameras, frames, {BODY_POINTS} points or "
        "more, x and y)"
    )
    try:
        with open_input(path, KEYPOINT_TABLE) as file:
            shape, dtype = _header(file)
            if len(shape) != 4 or shape[2] < BODY_POINTS or shape[3] not in (2, 3) or not shape[1]:
                raise InputError(f"{path}: an array of {shape}; {expected}")
            if shape[0] != rows:
                raise InputError(
                    f"{path}: holds {shape[0]} cameras, {rows} of the session name it; name it for "
                    "all, in the order of their videos' names"
                )
            if not np.issubdtype(dtype, np.floating) or dtype.itemsize > 8:
                raise InputError(f"{path}: an array of {dtype}; {expected}")
            if math.prod(shape) * dtype.itemsize > path.stat().st_size:
                raise InputError(f"{path}: is cut off; copy it again")
            file.seek(0)
            table = np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"{path}: cannot be read as an array ({error}); {expected}") from None
    points = np.asarray(table[row, :, :BODY_POINTS, :2], dtype=np.float64)
    seen = np.isfinite(points).all(axis=2, keepdims=True)
    return np.concatenate([np.where(seen, points, np.nan), seen.astype(np.float64)], axis=2)


def _header(file: BinaryIO) -> tuple[tuple[int, ...], np.dtype]:
    """Shape and type that the file states; raises `ValueError`."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    else:
        shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    return shape, dtype
