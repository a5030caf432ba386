"""A folder of one JSON per camera, as the Shelf and Campus recordings are passed around.

    {"K": 9 numbers, "RT": 12 numbers (3 x 4), "imgSize": [width, height], "distCoeff": optional}

The file's stem is the camera's name; `point_in_cam = RT @ [point_in_world, 1]`.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.json_file import load


def read(folder: Path) -> list[Camera]:
    """The cameras, translations in the file's unit; raises `CalibrationError`."""
    return [_camera(path) for path in sorted(folder.glob("*.json"))]


def _camera(path: Path) -> Camera:
    data = load(path)
    missing = [key for key in ("K", "RT", "imgSize") if key not in data]
    if missing:
        raise CalibrationError(f"{path}: no {', '.join(missing)}; expected K, RT and imgSize")
    pose = fields.numbers(data["RT"], (3, 4), f"{path}: RT")
    return fields.camera(
        path,
        name=path.stem,
        size_px=fields.numbers(data["imgSize"], (2,), f"{path}: imgSize"),
        matrix=fields.numbers(data["K"], (3, 3), f"{path}: K"),
        distortion=fields.distortion(data.get("distCoeff"), f"{path}: distCoeff"),
        rotation=pose[:, :3],
        translation=pose[:, 3],
    )


def dumps(camera: Camera) -> str:
    """The text of one camera's file, its translation in metres."""
    pose = np.column_stack([camera.rotation, camera.translation])
    return (
        json.dumps(
            {
                "units": "RT in metres, K in pixels",
                "K": camera.matrix.ravel().tolist(),
                "RT": pose.ravel().tolist(),
                "imgSize": list(camera.size_px),
                "distCoeff": camera.distortion.tolist(),
            },
            indent=1,
        )
        + "\n"
    )
