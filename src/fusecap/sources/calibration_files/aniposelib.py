"""Calibration TOML in the aniposelib layout, which caliscope, Pose2Sim and FreeMoCap also write.

    [cam_0]
    name = "left"                      # optional: the table's name is the camera's otherwise
    size = [1280, 720]
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortions = [k1, k2, p1, p2, k3]
    rotation = [rx, ry, rz]            # Rodrigues, or 3 x 3
    translation = [x, y, z]            # point_in_cam = rotation @ point_in_world + translation

Newer caliscope files nest the tables under `[cameras]`. A table without `matrix` is no camera.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera
from fusecap.sources.calibration_files import fields


def read(path: Path) -> list[Camera]:
    """The cameras, translations in the file's unit; raises `CalibrationError`."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: not valid TOML: {error}") from None
    nested = data.get("cameras")
    if isinstance(nested, dict):
        data = {f"cam_{key}" if key.isdigit() else key: value for key, value in nested.items()}
    tables = {
        key: value
        for key, value in data.items()
        if isinstance(value, dict) and "matrix" in value and value.get("ignore") is not True
    }
    return [_camera(path, key, table) for key, table in tables.items()]


def _camera(path: Path, key: str, table: dict[str, Any]) -> Camera:
    where = f"{path}: [{key}]"
    missing = [k for k in ("size", "rotation", "translation") if table.get(k) is None]
    if missing:
        raise CalibrationError(
            f"{where} has no {' and no '.join(missing)}; expected size, matrix, distortions, "
            "rotation and translation: finish the calibration of this camera"
        )
    if table.get("fisheye") is True:
        raise CalibrationError(
            f"{where} fisheye = true: fisheye lenses are not supported; calibrate with the "
            "standard model, or undistort the images first"
        )
    return fields.camera(
        path,
        name=str(table.get("name", key)),
        size_px=fields.numbers(table["size"], (2,), f"{where} size"),
        matrix=fields.numbers(table["matrix"], (3, 3), f"{where} matrix"),
        distortion=fields.distortion(
            table.get("distortions", table.get("distortion")), f"{where} distortions"
        ),
        rotation=fields.rotation_matrix(table["rotation"], f"{where} rotation"),
        translation=fields.numbers(table["translation"], (3,), f"{where} translation"),
    )
