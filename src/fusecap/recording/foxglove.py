"""What Foxglove's panels draw by themselves: skeletons in 3D, and pictures.

JSON in the layouts of foxglove.SceneUpdate and foxglove.CompressedImage
(https://github.com/foxglove/foxglove-sdk, schemas/jsonschema). The 3D panel has z up, so the scene
is turned: x stays, y is our -z, z is our y.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from fusecap.types import Estimate

SCENE_SCHEMA = "foxglove.SceneUpdate"
IMAGE_SCHEMA = "foxglove.CompressedImage"
_FRAME = "world"
_LINE_LIST = 2
_THICKNESS_M = 0.03
_TEXT_M = 0.12
_COLOURS = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16))
_NO_POSE = {
    "position": {"x": 0, "y": 0, "z": 0},
    "orientation": {"x": 0, "y": 0, "z": 0, "w": 1},
}
_UNUSED = ("arrows", "cubes", "spheres", "cylinders", "triangles", "models")
_LIFETIME = {"sec": 1, "nsec": 0}


def scene_message(estimates: Iterable[Estimate], unix_ns: int) -> str:
    """Everyone's bones as lines and their names above their heads; gone after a second."""
    return json.dumps(
        {"deletions": [], "entities": [_entity(estimate, unix_ns) for estimate in estimates]},
        separators=(",", ":"),
    )


def image_message(jpeg: bytes, frame_id: str, unix_ns: int) -> str:
    """A camera's picture."""
    data = base64.b64encode(jpeg).decode()
    return json.dumps(
        {"timestamp": _time(unix_ns), "frame_id": frame_id, "format": "jpeg", "data": data},
        separators=(",", ":"),
    )


def _entity(estimate: Estimate, unix_ns: int) -> dict[str, Any]:
    points = _points(estimate.bone_position_in_world_m)
    parents = estimate.shape.skeleton.parents
    red, green, blue = _COLOURS[estimate.track_id % len(_COLOURS)]
    colour = {"r": red, "g": green, "b": blue, "a": 1.0}
    head = max(points, key=lambda point: point["z"])
    return {
        "timestamp": _time(unix_ns),
        "frame_id": _FRAME,
        "id": estimate.name,
        "lifetime": _LIFETIME,
        "frame_locked": False,
        "metadata": [],
        **{kind: [] for kind in _UNUSED},
        "lines": [
            {
                "type": _LINE_LIST,
                "pose": _NO_POSE,
                "thickness": _THICKNESS_M,
                "scale_invariant": False,
                "points": points,
                "color": colour,
                "colors": [],
                "indices": [
                    end
                    for bone, parent in enumerate(parents)
                    if parent >= 0
                    for end in (parent, bone)
                ],
            }
        ],
        "texts": [
            {
                "pose": _NO_POSE | {"position": head | {"z": round(head["z"] + 2 * _TEXT_M, 4)}},
                "billboard": True,
                "font_size": _TEXT_M,
                "scale_invariant": False,
                "color": colour,
                "text": estimate.name,
            }
        ],
    }


def _points(points_in_world_m: Float[np.ndarray, "b 3"]) -> list[dict[str, float]]:
    rows = np.round(points_in_world_m, 4).tolist()
    return [{"x": x, "y": -z, "z": y} for x, y, z in rows]


def _time(unix_ns: int) -> dict[str, int]:
    sec, nsec = divmod(unix_ns, 1_000_000_000)
    return {"sec": sec, "nsec": nsec}


def _object(title: str, **properties: Any) -> dict[str, Any]:
    return {"title": title, "type": "object", "properties": properties}


def _list(items: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_NUMBER = {"type": "number"}
_INTEGER = {"type": "integer"}
_TEXT = {"type": "string"}
_FLAG = {"type": "boolean"}
_STAMP = _object("time", sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object("foxglove.Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POSE = _object(
    "foxglove.Pose",
    position=_VECTOR,
    orientation=_object("foxglove.Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER),
)
_COLOUR = _object("foxglove.Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_LINE = _object(
    "foxglove.LinePrimitive",
    type=_INTEGER,
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_FLAG,
    points=_list(_object("foxglove.Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_list(_INTEGER),
)
_LABEL = _object(
    "foxglove.TextPrimitive",
    pose=_POSE,
    billboard=_FLAG,
    font_size=_NUMBER,
    scale_invariant=_FLAG,
    color=_COLOUR,
    text=_TEXT,
)
_ENTITY = _object(
    "foxglove.SceneEntity",
    timestamp=_STAMP,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_object("duration", sec=_INTEGER, nsec=_INTEGER),
    frame_locked=_FLAG,
    metadata=_list(_object("foxglove.KeyValuePair", key=_TEXT, value=_TEXT)),
    lines=_list(_LINE),
    texts=_list(_LABEL),
    **{kind: _list({"type": "object"}) for kind in _UNUSED},
)
SCHEMAS = {
    SCENE_SCHEMA: _object(
        SCENE_SCHEMA,
        deletions=_list(
            _object("foxglove.SceneEntityDeletion", timestamp=_STAMP, type=_INTEGER, id=_TEXT)
        ),
        entities=_list(_ENTITY),
    ),
    IMAGE_SCHEMA: _object(
        IMAGE_SCHEMA,
        timestamp=_STAMP,
        frame_id=_TEXT,
        data={"type": "string", "contentEncoding": "base64"},
        format=_TEXT,
    ),
}
"""The fields that are written here."""
