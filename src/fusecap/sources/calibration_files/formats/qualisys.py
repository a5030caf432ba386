"""Qualisys Track Manager's `.qca.txt`.

R, p = transform r11..r33, x y z [mm]        p: the camera's centre
rotation = diag(1, -1, -1) R                  its cameras look along -z with y up
translation = -rotation p / 1000
fx, fy, cx, cy = value / 64                   its pixels are cut into 64ths

Videos of another `video_resolution` than the sensor's scale all of these.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.inputs import CALIBRATION
from fusecap.sources import safe_xml
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.rig_format import RigFormat, StatedCamera

SUFFIXES = (".qca.txt", ".qca")
SUBPIXELS = 64.0
_FLIP = np.diag([1.0, -1.0, -1.0])


def read(path: Path) -> list[StatedCamera] | None:
    """The active cameras, translations in metres; raises `CalibrationError`."""
    if not path.name.endswith(SUFFIXES) or path.is_dir():
        return None
    try:
        root = safe_xml.parse(path, CALIBRATION)
    except safe_xml.XmlError as error:
        raise CalibrationError(f"{path}: {error}") from None
    return [
        (element.get("serial", ""), partial(_camera, path, element))
        for element in root.iterfind("./cameras/camera")
        if element.get("active", "1") == "1"
    ]


def dumps(cameras: Sequence[Camera]) -> str:
    """The text of a file with these cameras, positions in millimetres."""
    root = ElementTree.Element("calibration", {"type": "regular", "source": "fusecap"})
    root.append(ElementTree.Comment(" positions in mm; focal lengths and centres in 1/64 px "))
    group = ElementTree.SubElement(root, "cameras")
    for camera in cameras:
        width, height = camera.size_px
        element = ElementTree.SubElement(
            group,
            "camera",
            {"active": "1", "model": "none", "serial": camera.name, "viewrotation": "0"},
        )
        view = {"left": "0", "top": "0", "right": str(width - 1), "bottom": str(height - 1)}
        for tag in ("fov_marker", "fov_marker_max", "fov_video", "fov_video_max"):
            ElementTree.SubElement(element, tag, view)
        in_file, centre_mm = _FLIP @ camera.rotation, camera.position_in_world * 1000.0
        transform = {f"r{r + 1}{c + 1}": in_file[r, c] for r in range(3) for c in range(3)}
        transform |= dict(zip("xyz", centre_mm, strict=True))
        ElementTree.SubElement(element, "transform", _texts(transform))
        k1, k2, p1, p2, k3 = camera.distortion
        intrinsic = {
            "focalLengthU": camera.matrix[0, 0] * SUBPIXELS,
            "focalLengthV": camera.matrix[1, 1] * SUBPIXELS,
            "centerPointU": camera.matrix[0, 2] * SUBPIXELS,
            "centerPointV": camera.matrix[1, 2] * SUBPIXELS,
            "skew": 0.0,
            "sensorMinU": 0.0,
            "sensorMaxU": width * SUBPIXELS,
            "sensorMinV": 0.0,
            "sensorMaxV": height * SUBPIXELS,
            "radialDistortion1": k1,
            "radialDistortion2": k2,
            "radialDistortion3": k3,
            "tangentalDistortion1": p1,
            "tangentalDistortion2": p2,
        }
        ElementTree.SubElement(element, "intrinsic", _texts(intrinsic))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=False) + "\n"


def _texts(numbers: dict[str, float]) -> dict[str, str]:
    return {name: repr(float(value)) for name, value in numbers.items()}


def _camera(path: Path, element: ElementTree.Element) -> Camera:
    name = element.get("serial", "")
    where = f"{path}: camera '{name}'"
    if element.get("viewrotation", "0") != "0":
        raise CalibrationError(
            f"{where} has viewrotation {element.get('viewrotation')}, expected 0; export the "
            "calibration and the videos unrotated"
        )
    transform = _attributes(element, "transform", where)
    intrinsic = _attributes(element, "intrinsic", where)
    view = _attributes(element, "fov_video", where)

    def value(attributes: dict[str, str], key: str) -> float:
        return float(fields.numbers(attributes.get(key), (1,), f"{where} {key}")[0])

    if "fisheye" in element.get("model", "").lower():
        raise CalibrationError(
            f"{where} is a fisheye lens: not supported; calibrate with the standard model, or "
            "undistort the images first"
        )
    left, top = value(view, "left"), value(view, "top")
    size_px = np.array([value(view, "right") - left + 1, value(view, "bottom") - top + 1])
    filmed = _filmed_lines(element) / size_px[1]
    in_file = np.array(
        [[value(transform, f"r{row}{column}") for column in (1, 2, 3)] for row in (1, 2, 3)]
    )
    rotation = _FLIP @ in_file
    centre_m = np.array([value(transform, axis) for axis in "xyz"]) / 1000.0
    matrix = np.eye(3)
    matrix[0, 0] = value(intrinsic, "focalLengthU") / SUBPIXELS
    matrix[1, 1] = value(intrinsic, "focalLengthV") / SUBPIXELS
    matrix[0, 2] = value(intrinsic, "centerPointU") / SUBPIXELS - left
    matrix[1, 2] = value(intrinsic, "centerPointV") / SUBPIXELS - top
    if np.isfinite(filmed):
        # The centre of the first pixel is at (0, 0) in either picture.
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) * filmed - 0.5
        matrix[[0, 1], [0, 1]] *= filmed
        size_px = np.round(size_px * filmed)
    return fields.camera(
        path,
        name=name,
        size_px=size_px,
        matrix=matrix,
        distortion=np.array(
            [
                value(intrinsic, "radialDistortion1"),
                value(intrinsic, "radialDistortion2"),
                value(intrinsic, "tangentalDistortion1"),
                value(intrinsic, "tangentalDistortion2"),
                value(intrinsic, "radialDistortion3"),
            ]
        ),
        rotation=rotation,
        translation=-rotation @ centre_m,
    )


def _filmed_lines(element: ElementTree.Element) -> float:
    """Of the camera's videos, by `video_resolution="1080p"`; NaN where it states none."""
    match = re.fullmatch(r"(\d+)p", element.get("video_resolution", ""))
    return float(match.group(1)) if match else float("nan")


def _attributes(element: ElementTree.Element, tag: str, where: str) -> dict[str, str]:
    found = element.find(tag)
    if found is None:
        raise CalibrationError(f"{where} has no <{tag}>")
    return dict(found.attrib)


def _file(path: Path, rig: Rig, _notes: Sequence[str]) -> dict[Path, str]:
    return {path: dumps(rig.cameras)}


FORMAT = RigFormat(
    what="a .qca.txt of Qualisys", suffixes=SUFFIXES, unit_is_open=False, read=read, texts=_file
)
