"""A `SessionSetup` as plain values that JSON holds exactly, and back.

Files are not needed again: cameras, offsets and the sensors' constants are in the values. Of paths
only the names remain, of addresses no password.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from fusecap.body.landmarks import LANDMARKS, LandmarkOffsets, LandmarkSet
from fusecap.errors import InputError
from fusecap.geometry.camera import Camera, Rig
from fusecap.setup import SessionSetup
from fusecap.sources.session import Session

_CAMERA_ARRAYS = {"matrix": (3, 3), "distortion": (5,), "rotation": (3, 3), "translation": (3,)}


def setup_values(setup: SessionSetup) -> dict[str, Any]:
    """Dicts, lists, texts and numbers."""
    offsets = setup.landmarks.offsets
    return {
        "session": _plain(setup.session.model_dump(by_alias=True, exclude_none=True)),
        "rig": [
            {"name": camera.name, "size_px": list(camera.size_px)}
            | {key: getattr(camera, key).tolist() for key in _CAMERA_ARRAYS}
            for camera in setup.rig.cameras
        ],
        "landmarks": {
            "name": setup.landmarks.name,
            "landmark_names": list(setup.landmarks.landmark_names),
            "offsets": offsets
            and {"everyone": _plain(offsets.everyone), "subjects": _plain(offsets.subjects)},
        },
        "simulated": setup.simulated,
    }


def setup_from_values(values: Mapping[str, Any], file: Path) -> SessionSetup:
    """The setup again; `file` is where it was read, and stands for the session file.

    Raises `InputError` for values that make no setup.
    """
    try:
        return SessionSetup(
            session=Session.model_validate(values["session"], context={"file": file}),
            rig=Rig(cameras=tuple(_camera(camera) for camera in values["rig"])),
            landmarks=_landmarks(values["landmarks"]),
            simulated=bool(values["simulated"]),
        )
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"{file}: its session cannot be used ({where}: {first['msg']})") from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise InputError(
            f"{file}: what it says about cameras and keypoints cannot be used ({error!r})"
        ) from None


def _plain(value: Any) -> Any:
    match value:
        case Mapping():
            return {str(key): _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case Path():
            return value.name
        case str():
            return re.sub(r"(?<=://)[^/@]*@", "", value)
    return value


def _camera(values: Mapping[str, Any]) -> Camera:
    width, height = values["size_px"]
    arrays = {key: np.array(values[key], dtype=np.float64) for key in _CAMERA_ARRAYS}
    for key, shape in _CAMERA_ARRAYS.items():
        if arrays[key].shape != shape:
            raise ValueError(f"{key} is {arrays[key].shape}, expected {shape}")
    return Camera(name=str(values["name"]), size_px=(int(width), int(height)), **arrays)


def _landmarks(values: Mapping[str, Any]) -> LandmarkSet:
    names = tuple(values["landmark_names"])
    unknown = [name for name in names if name not in LANDMARKS]
    if unknown or not names:
        raise ValueError(f"landmark_names holds {unknown[:1]}")
    offsets = values["offsets"]
    return LandmarkSet(
        name=str(values["name"]),
        landmark_names=names,
        offsets=offsets
        and LandmarkOffsets(
            everyone=_offsets(offsets["everyone"]),
            subjects={name: _offsets(table) for name, table in offsets["subjects"].items()},
        ),
    )


def _offsets(table: Mapping[str, Any]) -> dict[str, tuple[float, float, float]]:
    return {name: (float(x), float(y), float(z)) for name, (x, y, z) in table.items()}
