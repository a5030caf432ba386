"""Writes a rig in the format that a file's name asks for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from fusecap.errors import CalibrationError
from fusecap.files import check_writable, write_whole
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files import aniposelib, panoptic, qualisys, shelf

CALISCOPE_NAME = "camera_array.toml"
"""The one name under which caliscope looks for cameras, nested under `[cameras]`."""
_FILE_NAME = re.compile(r"(?!calibration_)[^/\\\\:*?\"<>|\x00-\x1f]+")


def write_rig(path: Path | str, rig: Rig, *, notes: Sequence[str] = ()) -> list[Path]:
    """Writes all cameras and returns the files, each whole or not at all.

    `.toml` is the aniposelib layout in metres (`camera_array.toml` caliscope's), `.qca.txt`
    Qualisys in millimetres, `.json` Panoptic in centimetres; a name without any of these is a
    folder with one JSON per camera in metres. `load_rig` reads all of them back. `notes` become
    comments in a TOML. Rotations that are not quite orthonormal become the nearest rotation in
    a TOML and stay as they are in the others. Raises `CalibrationError` or `TakeError`.
    """
    path = Path(path)
    if not len(rig):
        raise CalibrationError(f"{path}: a calibration without cameras is not written")
    check_rig_path(path)
    texts = _texts(path, rig, notes)
    for file, text in texts.items():
        write_whole(file, text)
    return list(texts)


def check_rig_path(path: Path) -> None:
    """Before the work that finds the cameras: raises where `write_rig` could not write them."""
    if path.name.endswith((".toml", ".json", ".qca.txt", ".qca")):
        check_writable(path)
    elif path.suffix or path.is_file():
        raise CalibrationError(
            f"{path}: no calibration format has this name; expected .toml (aniposelib, Pose2Sim, "
            "FreeMoCap, caliscope), .qca.txt (Qualisys), .json (Panoptic), or a folder's name for "
            "one JSON per camera"
        )
    else:
        check_writable(path / "camera.json")


def _texts(path: Path, rig: Rig, notes: Sequence[str]) -> dict[Path, str]:
    cameras = rig.cameras
    if path.suffix == ".toml":
        nested = path.name == CALISCOPE_NAME
        return {path: aniposelib.dumps(cameras, notes=notes, nested=nested)}
    if path.name.endswith((".qca.txt", ".qca")):
        return {path: qualisys.dumps(cameras)}
    if path.suffix == ".json":
        return {path: panoptic.dumps(cameras)}
    for camera in cameras:
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
    return {path / f"{camera.name}.json": shelf.dumps(camera) for camera in cameras}
