"""Recognises a calibration's format, and brings it into our world: y up, metres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Y_UP_FROM_Z_UP, Camera, Rig
from fusecap.sources.calibration_files import aniposelib, panoptic, qualisys, shelf
from fusecap.sources.calibration_files.json_file import load
from fusecap.sources.calibration_files.plausibility import MILLIMETRES_ABOVE, camera_spread

Y_UP_FROM = {
    "y": np.eye(3),
    "z": Y_UP_FROM_Z_UP,
    "-y": np.diag([1.0, -1.0, -1.0]),
}
"""Per up axis of a calibration's world, the rotation that brings it into ours."""

_KNOWN = (
    "expected an aniposelib-layout .toml (caliscope, Pose2Sim, FreeMoCap), a Qualisys .qca.txt, "
    "a Panoptic calibration .json, or a folder with one .json per camera (K, RT, imgSize)"
)


def load_rig(path: Path | str, *, up: str = "y", unit: str = "m") -> Rig:
    """All cameras of a calibration file or folder, in our y-up world in metres.

    `up` is the up axis of the file's world ("y", "z" or "-y"). `unit` ("m" or "mm") is that of
    formats which leave it open; centimetres of Panoptic and millimetres of Qualisys are known.
    Raises `CalibrationError`, also for a calibration that is evidently not in the stated unit.
    """
    path = Path(path)
    cameras, unit_is_open = _read(path)
    if not cameras:
        raise CalibrationError(f"{path}: holds no camera; {_KNOWN}")
    if unit_is_open and unit == "mm":
        cameras = [replace(camera, translation=camera.translation / 1000) for camera in cameras]
    try:
        rig = Rig(cameras=tuple(cameras)).in_world(Y_UP_FROM[up])
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    spread = camera_spread(rig)
    if spread > MILLIMETRES_ABOVE:
        raise CalibrationError(
            f"{path}: the cameras stand {spread:.0f} m apart, expected a room in metres; if the "
            'file is in millimetres, write calibration_unit = "mm" under [session]'
        )
    if unit_is_open and unit == "mm" and len(rig) > 1 and spread < MILLIMETRES_ABOVE / 1000:
        raise CalibrationError(
            f"{path}: read in millimetres the cameras stand {spread * 1000:.1f} mm apart; the "
            "file is in metres already: remove calibration_unit from [session]"
        )
    return rig


def _read(path: Path) -> tuple[list[Camera], bool]:
    """The cameras, and whether the format leaves their unit open."""
    if not path.exists():
        raise CalibrationError(f"{path}: no such file or folder; {_KNOWN}")
    if path.is_dir():
        return _read_folder(path)
    if path.suffix == ".toml":
        return aniposelib.read(path), True
    if path.name.endswith((".qca.txt", ".qca")):
        return qualisys.read(path), False
    if path.suffix == ".json":
        data = load(path)
        if isinstance(data.get("cameras"), list):
            return panoptic.read(path, data), False
        if {"K", "RT"} <= data.keys():
            raise CalibrationError(
                f"{path}: is one camera of a folder; name the folder as the calibration"
            )
    raise CalibrationError(f"{path}: not a calibration that is known; {_KNOWN}")


def _read_folder(folder: Path) -> tuple[list[Camera], bool]:
    files = [
        file
        for file in sorted(folder.iterdir())
        if file.is_file() and (file.suffix in (".toml", ".json") or file.name.endswith(".qca.txt"))
    ]
    per_camera = [f for f in files if f.suffix == ".json" and not f.name.startswith("calibration_")]
    if per_camera:
        return shelf.read(folder), True
    if len(files) != 1:
        found = f"{len(files)} calibration files" if files else "no calibration file"
        raise CalibrationError(f"{folder}: holds {found}; name the one to read, {_KNOWN}")
    return _read(files[0])
