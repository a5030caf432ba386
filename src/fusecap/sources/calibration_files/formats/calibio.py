"""JSON of calib.io's Camera Calibrator (libCalib), read only.

    Calibration.cameras[i].model.ptr_wrapper.data:
        CameraModelCRT.CameraModelBase.imageSize   width, height [px]
        parameters                                 f, ar = fy / fx, cx, cy, k1..k6, p1, p2, ...
    Calibration.cameras[i].transform               rotation (Rodrigues rx, ry, rz), translation

point_in_cam = rotation point_in_world + translation, the world that of the first camera as a rule
(`fusecap calibrate world` follows), in the unit in which the board was stated. The file names no
camera: the first is called "0".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.rig_format import RigFormat, StatedCamera

_MODEL = "libCalib::CameraModelOpenCV"
_SIZE = ("model", "ptr_wrapper", "data", "CameraModelCRT", "CameraModelBase", "imageSize")
_PARAMETERS = ("model", "ptr_wrapper", "data", "parameters")
_BENT = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
"""In OpenCV's order."""


def read(path: Path) -> list[StatedCamera] | None:
    """The cameras, translations in the file's unit; raises `CalibrationError`."""
    if path.suffix != ".json" or path.is_dir():
        return None
    calibration = fields.json_object(path).get("Calibration")
    cameras = calibration.get("cameras") if isinstance(calibration, dict) else None
    if not isinstance(cameras, list):
        return None
    return [(str(i), partial(_camera, path, str(i), entry)) for i, entry in enumerate(cameras)]


def _camera(path: Path, name: str, entry: Any) -> Camera:
    where = f"{path}: Calibration.cameras[{name}]"
    model = _below(entry, ("model",), where).get("polymorphic_name", _MODEL)
    if model != _MODEL:
        raise CalibrationError(
            f"{where}: its lens model is {str(model)!r}, expected '{_MODEL}'; calibrate again with "
            "the OpenCV model"
        )
    size = _below(entry, _SIZE, where)
    parameters = _below(entry, _PARAMETERS, where)
    turn = _below(entry, ("transform", "rotation"), where)
    place = _below(entry, ("transform", "translation"), where)

    def value(key: str, default: float | None = None) -> float:
        stated = parameters.get(key, {"val": default})
        stated = stated.get("val") if isinstance(stated, dict) else None
        return float(fields.numbers([stated], (1,), f"{where} {key}")[0])

    focal = value("f")
    matrix = np.diag([focal, focal * value("ar", 1.0), 1.0])
    matrix[:2, 2] = value("cx"), value("cy")
    vector = fields.numbers(
        [turn.get(key) for key in ("rx", "ry", "rz")], (3,), f"{where} rotation"
    )
    return fields.camera(
        path,
        name=name,
        size_px=fields.numbers([size.get("width"), size.get("height")], (2,), f"{where} imageSize"),
        matrix=matrix,
        distortion=fields.distortion([value(key, 0.0) for key in _BENT], f"{where} parameters"),
        rotation=Rotation.from_rotvec(vector).as_matrix(),
        translation=fields.numbers(
            [place.get(key) for key in ("x", "y", "z")], (3,), f"{where} translation"
        ),
    )


def _below(entry: Any, keys: tuple[str, ...], where: str) -> dict[str, Any]:
    for key in keys:
        entry = entry.get(key) if isinstance(entry, dict) else None
    if not isinstance(entry, dict):
        raise CalibrationError(f"{where} has no {'.'.join(keys)}; export the calibration again")
    return entry


FORMAT = RigFormat(
    what="a .json of calib.io", suffixes=(".json",), unit_is_open=True, read=read, texts=None
)
