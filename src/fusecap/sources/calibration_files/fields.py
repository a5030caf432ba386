"""Values out of calibration files, with errors that say where they stand."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera
from fusecap.inputs import CALIBRATION, read_json


def states_fisheye(text: str) -> bool:
    """Whether a YAML or XML file of OpenCV says that its lenses are fisheye ones."""
    return re.search(r"fisheye\w*[\s:>=\"']*(1|true)\b", text, re.IGNORECASE) is not None


def json_object(path: Path) -> dict[str, Any]:
    """The object of a JSON file; raises `CalibrationError` for anything else."""
    data = read_json(path, CALIBRATION)
    if not isinstance(data, dict):
        raise CalibrationError(f"{path}: expected a JSON object, found a {type(data).__name__}")
    return data


def numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """`value` as an array of this shape (nested or flat); raises `CalibrationError`."""
    expected = " x ".join(str(n) for n in shape)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise CalibrationError(
            f"{where}: found {_short(value)}, expected {expected} numbers"
        ) from None
    if array.size != int(np.prod(shape)):
        raise CalibrationError(f"{where}: found {array.size} numbers, expected {expected}")
    if not np.all(np.isfinite(array)):
        raise CalibrationError(f"{where}: holds a value that is not a finite number")
    return array.reshape(shape)


def distortion(value: Any, where: str) -> np.ndarray:
    """k1, k2, p1, p2, k3 from 0, 4 or 5 numbers, or more whose rest is zero."""
    try:
        values = np.asarray(value if value is not None else [], dtype=np.float64).ravel()
    except (TypeError, ValueError):
        raise CalibrationError(f"{where}: found {_short(value)}, expected 4 or 5 numbers") from None
    if values.size not in (0, 4, 5, 8, 12, 14) or np.any(values[5:] != 0):
        raise CalibrationError(
            f"{where}: found {values.size} distortion coefficients, expected 4 or 5 "
            "(k1, k2, p1, p2, k3); calibrate again without the rational or thin-prism model"
        )
    result = np.zeros(5)
    result[: min(5, values.size)] = values[:5]
    return result


def rotation_matrix(value: Any, where: str) -> np.ndarray:
    """A rotation written as a Rodrigues vector or as 3 x 3 numbers."""
    try:
        size = np.asarray(value, dtype=np.float64).size
    except (TypeError, ValueError):
        size = 0
    if size == 3:
        return Rotation.from_rotvec(numbers(value, (3,), where)).as_matrix()
    return numbers(value, (3, 3), where)


def camera(
    path: Path,
    *,
    name: str,
    size_px: np.ndarray,
    matrix: np.ndarray,
    distortion: np.ndarray,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> Camera:
    """A `Camera`, whose own complaints name the file."""
    try:
        return Camera(
            name=name,
            size_px=(round(float(size_px[0])), round(float(size_px[1]))),
            matrix=matrix,
            distortion=distortion,
            rotation=rotation,
            translation=translation,
        )
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
