"""`calibration_<sequence>.json` of the CMU Panoptic studio.

    point_in_cam = R point_in_world + t, in centimetres; distCoef in OpenCV's order

Its world's up axis is -y: say `up = "-y"` in the session.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera
from fusecap.sources.calibration_files import fields

METRES_PER_CENTIMETRE = 0.01


def read(path: Path, data: dict[str, Any]) -> list[Camera]:
    """The cameras, translations in metres; raises `CalibrationError`."""
    cameras = []
    for index, entry in enumerate(data["cameras"]):
        where = f"{path}: cameras[{index}]"
        keys = ("name", "resolution", "K", "R", "t")
        missing = [key for key in keys if not isinstance(entry, dict) or key not in entry]
        if missing:
            raise CalibrationError(f"{where} has no {', '.join(missing)}")
        translation = fields.numbers(entry["t"], (3,), f"{where} t")
        cameras.append(
            fields.camera(
                path,
                name=str(entry["name"]),
                size_px=fields.numbers(entry["resolution"], (2,), f"{where} resolution"),
                matrix=fields.numbers(entry["K"], (3, 3), f"{where} K"),
                distortion=fields.distortion(entry.get("distCoef"), f"{where} distCoef"),
                rotation=fields.numbers(entry["R"], (3, 3), f"{where} R"),
                translation=translation * METRES_PER_CENTIMETRE,
            )
        )
    return cameras
