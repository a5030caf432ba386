"""Recognises a calibration's format, and brings it into our world: y up, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fusecap.errors import CalibrationError
from fusecap.geometry.camera import MOST_CAMERAS, Y_UP_FROM_Z_UP, Rig
from fusecap.inputs import CALIBRATION, read_text
from fusecap.sources.calibration_files import fields
from fusecap.sources.calibration_files.formats import rig_formats
from fusecap.sources.calibration_files.plausibility import MILLIMETRES_ABOVE, camera_spread
from fusecap.sources.calibration_files.rig_format import StatedCamera

Y_UP_FROM = {
    "y": np.eye(3),
    "z": Y_UP_FROM_Z_UP,
    "-y": np.diag([1.0, -1.0, -1.0]),
}
"""Per up axis of a calibration's world, the rotation that brings it into ours."""
PER_METRE = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_PICKLES, _OPENCV = (".pickle", ".pkl"), (".yml", ".yaml", ".xml")


def load_rig(
    path: Path | str, *, up: str = "y", unit: str = "m", names: Sequence[str] | None = None
) -> Rig:
    """The cameras of a calibration file or folder, in our y-up world in metres.

    With `names` only those; the others may be of any kind and unfinished.

    `up` is the up axis of the file's world ("y", "z" or "-y"). `unit` (of `PER_METRE`) is that of
    formats which leave it open; centimetres of Panoptic and millimetres of Qualisys are known.
    Raises `CalibrationError`, also for a calibration that is evidently not in the stated unit.
    """
    path = Path(path)
    stated, unit_is_open = _some(path)
    cameras = [camera() for name, camera in stated if names is None or name in names]
    if names is not None and {camera.name for camera in cameras} != set(names):
        missing = [name for name in names if name not in {camera.name for camera in cameras}]
        raise CalibrationError(
            f"{path}: no camera {', '.join(map(repr, missing))}; "
            f"it has {', '.join(name for name, _ in stated)}"
        )
    if unit_is_open and unit != "m":
        cameras = [
            replace(camera, translation=camera.translation / PER_METRE[unit]) for camera in cameras
        ]
    try:
        rig = Rig(cameras=tuple(cameras)).in_world(Y_UP_FROM[up])
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None
    spread = camera_spread(rig)
    if spread > MILLIMETRES_ABOVE:
        raise CalibrationError(
            f"{path}: the cameras stand {spread:.0f} m apart, expected a room in metres; "
            f'write calibration_unit = "mm" under [session] if {spread / 1000:.2f} m is right, '
            f'"cm" if {spread / 100:.2f} m is'
        )
    if unit_is_open and unit != "m" and len(rig) > 1 and spread < MILLIMETRES_ABOVE / 1000:
        raise CalibrationError(
            f"{path}: read in {unit} the cameras stand {spread * 1000:.1f} mm apart; the file is "
            "in metres already: remove calibration_unit from [session]"
        )
    return rig


def load_lenses(path: Path | str) -> Rig:
    """`load_rig` where no one asks where the cameras stand, whatever the unit of that is."""
    path = Path(path)
    cameras = tuple(camera() for _, camera in _some(path)[0])
    try:
        return Rig(cameras=cameras)
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from None


def may_be_calibration(path: Path) -> bool:
    """Whether the name of a file among others is that of a calibration."""
    if path.suffix == ".json":
        return "calib" in path.name.lower()
    return path.name != "session.toml" and path.name.endswith(_suffixes())


def _suffixes() -> tuple[str, ...]:
    return tuple(suffix for format in rig_formats() for suffix in format.suffixes)


def _known() -> str:
    return "expected " + " or ".join(format.what for format in rig_formats())


def _unknown(path: Path) -> CalibrationError:
    if path.suffix.lower() in _PICKLES:
        return CalibrationError(
            f"{path}: a pickle may run any program when it is opened, so none is; OpenCap's "
            "cameraIntrinsicsExtrinsics.pickle holds intrinsicMat, distortion, imageSize, rotation "
            f"and translation [mm] of one camera, write those of all into one file: {_known()}"
        )
    if path.suffix.lower() in _OPENCV and fields.states_fisheye(read_text(path, CALIBRATION)):
        return CalibrationError(
            f"{path} states fisheye lenses: not supported; calibrate with the standard model, or "
            "undistort the images first"
        )
    return CalibrationError(f"{path}: not a calibration that is known; {_known()}")


def _some(path: Path) -> tuple[list[StatedCamera], bool]:
    """`_read`, where it is a number of cameras that can be dealt with."""
    stated, unit_is_open = _read(path)
    if not stated:
        raise CalibrationError(f"{path}: holds no camera; {_known()}")
    if len(stated) > MOST_CAMERAS:
        raise CalibrationError(
            f"{path}: {len(stated)} cameras; at most {MOST_CAMERAS} are read: keep those in use"
        )
    return stated, unit_is_open


def _read(path: Path) -> tuple[list[StatedCamera], bool]:
    """The cameras, and whether the format leaves their unit open."""
    if not path.exists():
        raise CalibrationError(f"{path}: no such file or folder; {_known()}")
    for format in rig_formats():
        cameras = format.read(path)
        if cameras is not None:
            return cameras, format.unit_is_open
    if not path.is_dir():
        raise _unknown(path)
    files = [f for f in sorted(path.iterdir()) if f.is_file() and f.name.endswith(_suffixes())]
    if len(files) != 1:
        found = f"{len(files)} calibration files" if files else "no calibration file"
        raise CalibrationError(f"{path}: holds {found}; name the one to read, {_known()}")
    return _read(files[0])
