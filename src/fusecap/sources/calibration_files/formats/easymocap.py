"""EasyMocap's `intri.yml` and `extri.yml`, beside each other: YAML as OpenCV writes it.

    names: ["01", "02"]
    K_01, dist_01, W_01, H_01     in intri.yml: pixels; k1, k2, p1, p2, k3; size of the pictures
    R_01, T_01                    in extri.yml: Rodrigues vector, metres
    point_in_cam = R point_in_world + T

Its own scripts leave the sizes out of older files; here they are needed. Its worlds have z up as a
rule: say `up = "z"` in the session. What is written keeps the world of the cameras, which is y up.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.inputs import CALIBRATION, read_text
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.rig_format import RigFormat, StatedCamera

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"
_MATRIX = re.compile(
    r"^([^\s:]+):\s*!!opencv-matrix\b.*?data:\s*\[([^\]]*)\]", re.MULTILINE | re.DOTALL
)
_NUMBER = re.compile(r"^([^\s:]+):\s*([-+.\deE]+)\s*$", re.MULTILINE)
_NAMES = re.compile(r"^names:\s*\n((?:\s*-\s*.*\n?)*)", re.MULTILINE)


def read(path: Path) -> list[StatedCamera] | None:
    """The cameras, translations in metres; raises `CalibrationError`."""
    folder = path if path.is_dir() else path.parent
    files = [folder / INTRINSICS, folder / EXTRINSICS]
    if not path.is_dir() and path not in files:
        return None
    if not all(file.is_file() for file in files):
        if path.is_dir():
            return None
        raise CalibrationError(f"{path}: expected {INTRINSICS} and {EXTRINSICS} side by side")
    values: dict[str, list[str]] = {}
    names: list[str] = []
    for file in files:
        text = read_text(file, CALIBRATION).replace("\r\n", "\n")
        values |= {key: data.replace(",", " ").split() for key, data in _MATRIX.findall(text)}
        values |= {key: [number] for key, number in _NUMBER.findall(text)}
        if fields.states_fisheye(text):
            raise CalibrationError(
                f"{file} states fisheye lenses: not supported; calibrate with the standard model, "
                "or undistort the images first"
            )
        found = _NAMES.search(text)
        if found and not names:
            listed = (line.strip() for line in found.group(1).splitlines() if line.strip())
            names = [line.lstrip("- ").strip("\"' ") for line in listed]
    return [(name, partial(_camera, folder, name, values)) for name in names]


def _camera(folder: Path, name: str, values: dict[str, list[str]]) -> Camera:
    where = f"{folder}: camera '{name}'"
    missing = [f"{key}_{name}" for key in ("K", "R", "T") if f"{key}_{name}" not in values]
    if missing:
        raise CalibrationError(f"{where} has no {', '.join(missing)}")
    if f"W_{name}" not in values or f"H_{name}" not in values:
        raise CalibrationError(
            f"{where} states no size of its pictures; add W_{name} and H_{name} [px] to "
            f"{INTRINSICS}"
        )

    def value(key: str, shape: tuple[int, ...]) -> np.ndarray:
        return fields.numbers(values[f"{key}_{name}"], shape, f"{where} {key}_{name}")

    bent = values.get(f"dist_{name}", values.get(f"D_{name}"))
    return fields.camera(
        folder,
        name=name,
        size_px=np.concatenate([value("W", (1,)), value("H", (1,))]),
        matrix=value("K", (3, 3)),
        distortion=fields.distortion(bent, f"{where} dist_{name}"),
        rotation=Rotation.from_rotvec(value("R", (3,))).as_matrix(),
        translation=value("T", (3,)),
    )


def _texts(path: Path, rig: Rig, _notes: Sequence[str]) -> dict[Path, str]:
    odd = [name for name in rig.names if not re.fullmatch(r"[\w-]+", name)]
    if odd:
        raise CalibrationError(
            f"{path}: camera '{odd[0]}' cannot name a key of the file; write a .toml"
        )
    head = "%YAML:1.0\n---\nnames:\n" + "".join(f'   - "{name}"\n' for name in rig.names)
    intrinsics, extrinsics = [head], [head]
    for camera in rig.cameras:
        name, vector = camera.name, Rotation.from_matrix(camera.rotation).as_rotvec()
        intrinsics += [
            _matrix(f"K_{name}", camera.matrix),
            _matrix(f"dist_{name}", camera.distortion[None]),
            f"W_{name}: {camera.size_px[0]}\nH_{name}: {camera.size_px[1]}\n",
        ]
        extrinsics += [
            _matrix(f"R_{name}", vector[:, None]),
            _matrix(f"Rot_{name}", camera.rotation),
            _matrix(f"T_{name}", camera.translation[:, None]),
        ]
    return {
        path.with_name(INTRINSICS): "".join(intrinsics),
        path.with_name(EXTRINSICS): "".join(extrinsics),
    }


def _matrix(key: str, values: np.ndarray) -> str:
    rows, columns = values.shape
    data = ", ".join(repr(float(value)) for value in values.ravel())
    return (
        f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
        f"   data: [ {data} ]\n"
    )


FORMAT = RigFormat(
    what="intri.yml and extri.yml of EasyMocap",
    suffixes=(EXTRINSICS,),
    unit_is_open=False,
    read=read,
    texts=_texts,
)
