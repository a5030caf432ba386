"""Calibration TOML in the aniposelib layout, which caliscope, Pose2Sim and FreeMoCap also write.

    [cam_0]
    name = "left"                      # optional: the table's name is the camera's otherwise
    size = [1280, 720]
    matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    distortions = [k1, k2, p1, p2, k3]
    rotation = [rx, ry, rz]            # Rodrigues, or 3 x 3
    translation = [x, y, z]            # point_in_cam = rotation @ point_in_world + translation

Newer caliscope files nest the tables under `[cameras]`. A table without `matrix` is no camera.

What is written: metres, Rodrigues rotations, five coefficients, every number of an array a float.
`CameraGroup.load` of aniposelib (and of FreeMoCap, which carries it) needs exactly the keys above
and takes tables in alphabetical order, so their numbers have as many digits as the last one's;
`retrieve_calib_params` of Pose2Sim takes every table but `[metadata]` for a camera;
`load_camera_array` of caliscope reads only tables under `[cameras]`, by number.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.inputs import CALIBRATION, read_toml
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.rig_format import RigFormat, StatedCamera
from fusecap.sources.toml_text import quoted

CALISCOPE_NAME = "camera_array.toml"
"""The one name under which caliscope looks for cameras, nested under `[cameras]`."""


def read(path: Path) -> list[StatedCamera] | None:
    """The cameras, translations in the file's unit; raises `CalibrationError`."""
    if path.suffix != ".toml" or path.is_dir():
        return None
    data = read_toml(path, CALIBRATION)
    nested = data.get("cameras")
    if isinstance(nested, dict):
        data = {f"cam_{key}" if key.isdigit() else key: value for key, value in nested.items()}
    tables = {
        key: value
        for key, value in data.items()
        if isinstance(value, dict) and "matrix" in value and value.get("ignore") is not True
    }
    return [
        (str(table.get("name", key)), partial(_camera, path, key, table))
        for key, table in tables.items()
    ]


def dumps(cameras: Sequence[Camera], *, notes: Sequence[str] = (), nested: bool = False) -> str:
    """The text of a file with these cameras, translations in metres.

    `notes` become comments at its head. `nested` writes caliscope's `[cameras.N]`.
    """
    digits = len(str(max(len(cameras) - 1, 0)))
    head = [
        *(f"# {line}" for note in notes for line in note.splitlines()),
        "# point_in_cam = rotation @ point_in_world + translation; rotation: Rodrigues vector in",
        "# radians; translation in metres; matrix in pixels; distortions k1, k2, p1, p2, k3.",
    ]
    tables = ["\n".join(head) + "\n"]
    for index, camera in enumerate(cameras):
        key = f"cameras.{index}" if nested else f"cam_{index:0{digits}d}"
        tables.append(
            f"[{key}]\n"
            + (f"cam_id = {index}\n" if nested else "")
            + f"name = {quoted(camera.name)}\n"
            f"size = {list(camera.size_px)}\n"
            f"matrix = {camera.matrix.tolist()}\n"
            f"distortions = {camera.distortion.tolist()}\n"
            f"rotation = {Rotation.from_matrix(camera.rotation).as_rotvec().tolist()}\n"
            f"translation = {camera.translation.tolist()}\n"
        )
    if not nested:
        tables.append('[metadata]\nadjusted = false\nunits = "metres"\n')
    return "\n".join(tables)


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


def _texts(path: Path, rig: Rig, notes: Sequence[str]) -> dict[Path, str]:
    return {path: dumps(rig.cameras, notes=notes, nested=path.name == CALISCOPE_NAME)}


FORMAT = RigFormat(
    what="a .toml in the layout of aniposelib (caliscope, Pose2Sim, FreeMoCap)",
    suffixes=(".toml",),
    unit_is_open=True,
    read=read,
    texts=_texts,
)
