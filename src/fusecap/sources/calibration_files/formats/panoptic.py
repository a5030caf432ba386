"""`calibration_<sequence>.json` of the CMU Panoptic studio.

    point_in_cam = R point_in_world + t, in centimetres; distCoef in OpenCV's order

Its world's up axis is -y: say `up = "-y"` in the session. What is written keeps the world of the
cameras, which is y up here.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.rig_format import RigFormat, StatedCamera

METRES_PER_CENTIMETRE = 0.01


def read(path: Path) -> list[StatedCamera] | None:
    """The cameras, translations in metres; raises `CalibrationError`."""
    if path.suffix != ".json" or path.is_dir():
        return None
    data = fields.json_object(path)
    if not isinstance(data.get("cameras"), list):
        return None
    return [
        (_name(entry), partial(_camera, path, f"{path}: cameras[{index}]", entry))
        for index, entry in enumerate(data["cameras"])
    ]


def _name(entry: Any) -> str:
    return str(entry.get("name", "")) if isinstance(entry, dict) else ""


def _camera(path: Path, where: str, entry: Any) -> Camera:
    keys = ("name", "resolution", "K", "R", "t")
    missing = [key for key in keys if not isinstance(entry, dict) or key not in entry]
    if missing:
        raise CalibrationError(f"{where} has no {', '.join(missing)}")
    translation = fields.numbers(entry["t"], (3,), f"{where} t")
    return fields.camera(
        path,
        name=str(entry["name"]),
        size_px=fields.numbers(entry["resolution"], (2,), f"{where} resolution"),
        matrix=fields.numbers(entry["K"], (3, 3), f"{where} K"),
        distortion=fields.distortion(entry.get("distCoef"), f"{where} distCoef"),
        rotation=fields.numbers(entry["R"], (3, 3), f"{where} R"),
        translation=translation * METRES_PER_CENTIMETRE,
    )


def dumps(cameras: Sequence[Camera]) -> str:
    """The text of a file with these cameras, translations in centimetres."""
    entries = [
        {
            "name": camera.name,
            "type": "hd",
            "resolution": list(camera.size_px),
            "panel": 0,
            "node": index,
            "K": camera.matrix.tolist(),
            "distCoef": camera.distortion.tolist(),
            "R": camera.rotation.tolist(),
            "t": (camera.translation / METRES_PER_CENTIMETRE)[:, None].tolist(),
        }
        for index, camera in enumerate(cameras)
    ]
    document = {"units": "t in centimetres, K in pixels", "cameras": entries}
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def _texts(path: Path, rig: Rig, _notes: Sequence[str]) -> dict[Path, str]:
    return {path: dumps(rig.cameras)}


FORMAT = RigFormat(
    what="a calibration .json of Panoptic",
    suffixes=(".json",),
    unit_is_open=False,
    read=read,
    texts=_texts,
)
