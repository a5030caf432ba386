"""A folder of one JSON per camera, as the Shelf and Campus recordings are passed around.

    {"K": 9 numbers, "RT": 12 numbers (3 x 4), "imgSize": [width, height], "distCoeff": optional}

The file's stem is the camera's name; `point_in_cam = RT @ [point_in_world, 1]`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.rig_format import RigFormat, StatedCamera

_FILE_NAME = re.compile(r"(?!calibration_)[^/\\:*?\"<>|\x00-\x1f]+")


def read(path: Path) -> list[StatedCamera] | None:
    """The cameras, translations in the file's unit; raises `CalibrationError`."""
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        if any(not file.name.startswith("calibration_") for file in files):
            return [(file.stem, partial(_camera, file)) for file in files]
    elif path.suffix == ".json" and {"K", "RT"} <= fields.json_object(path).keys():
        raise CalibrationError(
            f"{path}: is one camera of a folder; name the folder as the calibration"
        )
    return None


def _camera(path: Path) -> Camera:
    data = fields.json_object(path)
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


def _texts(path: Path, rig: Rig, _notes: Sequence[str]) -> dict[Path, str]:
    for camera in rig.cameras:
        if not _FILE_NAME.fullmatch(camera.name):
            raise CalibrationError(
                f"{path}: camera '{camera.name}' cannot name a file of the folder; write a .toml"
            )
    others = {file.stem for file in path.glob("*.json")} - set(rig.names)
    if others:
        raise CalibrationError(
            f"{path}: holds other cameras already ({', '.join(sorted(others)[:5])}), which would "
            "be read with these; name another folder"
        )
    return {path / f"{camera.name}.json": dumps(camera) for camera in rig.cameras}


FORMAT = RigFormat(
    what="a folder with one .json per camera (K, RT, imgSize)",
    suffixes=(),
    unit_is_open=True,
    read=read,
    texts=_texts,
)
