"""A page that plays the take in any browser, from the file alone: no server, no network.

Joints are whole millimetres in 16 bits, wider rooms in coarser steps; a person who is not tracked
is not shown.
"""

from __future__ import annotations

import base64
import json
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.body.shape import REFERENCE_HEIGHT_M
from fusecap.body.sticks import (
    HEAD_CENTRE_M,
    HEAD_M,
    NOSE_M,
    NOSE_RADIUS_M,
    RIGHT_SHADE,
    stick_radius_m,
)
from fusecap.exports.gltf_people import COLOURS
from fusecap.exports.rest_rig import RestRig
from fusecap.exports.rig_motion import RigMotion, rig_motions
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat
from fusecap.files import written_whole

_MOST, _HIDDEN = 32767, -32768
_DATA = '"data":null'
"""Where a person's frames go; no name holds it, for its quotes are escaped."""


def write_html(take: AnyTake, path: Path, _: ExportOptions) -> None:
    """Writes everybody, whole or not at all."""
    people: list[dict[str, Any]] = []
    places: list[np.ndarray] = []
    for row, motion in enumerate(rig_motions(take, "native")):
        points = np.concatenate([_points_m(part).astype(np.float32) for part in motion.blocks()])
        points[~motion.tracked] = np.nan
        places.append(points)
        people.append(
            {
                "name": motion.name,
                "colour": COLOURS[row % len(COLOURS)],
                "sticks": _sticks(motion.rest),
                "points": points.shape[1],
                "data": None,
            }
        )
    step_m = max(1e-3, *(float(np.nanmax(np.abs(points))) / _MOST for points in places))
    told = {
        "title": path.stem,
        "step_m": step_m,
        "time_s": np.round(take.time_s, 5).tolist(),
        "simulated": bool(take.provenance.get("simulated")),
        "people": people,
    }
    # No "<" of a name may end the script that holds it.
    data = json.dumps(told, separators=(",", ":")).replace("<", "\\u003c")
    page = (files("fusecap.exports") / "page.html").read_text(encoding="utf-8")
    page = page.replace("@TAKE@", data)
    with written_whole(path) as file:
        for points in places:
            above, mark, page = page.partition(_DATA)
            steps = np.nan_to_num(np.round(points / step_m), nan=_HIDDEN).astype("<i2")
            file.write(above.encode() + mark.replace("null", '"').encode())
            file.write(base64.b64encode(steps.tobytes()) + b'"')
        file.write(page.encode())


def _points_m(motion: RigMotion) -> np.ndarray:
    """Joints, tips of leaves, the head's middle, the nose: (T, P, 3) in the world."""
    rest = motion.rest
    places, turns = motion.in_world()
    tips = [
        places[leaf] + turns[leaf].apply(rest.tip_m[leaf] - rest.position_m[leaf])
        for leaf in rest.leaves
    ]
    head = rest.names.index("head")
    face = [
        places[head] + turns[head].apply(_size(rest) * np.array(at))
        for at in (HEAD_CENTRE_M, NOSE_M)
    ]
    return np.stack([*places, *tips, *face], axis=1)


def _sticks(rest: RestRig) -> list[list[float]]:
    """Start, end, radius [m] and shade: the right side is darker, so that a mirror is seen."""
    ends = {leaf: len(rest.names) + index for index, leaf in enumerate(rest.leaves)}
    sticks = []
    for joint, name in enumerate(rest.names):
        children = [child for child, parent in enumerate(rest.parents) if parent == joint]
        shade = RIGHT_SHADE if name.startswith("right_") else 1.0
        radius = _size(rest) * stick_radius_m(name)
        if joint in ends and name != "head":
            sticks.append([joint, ends[joint], radius, shade])
        for child in children:
            between = rest.names[child]
            side = between.startswith(("left_", "right_")) and not name.startswith(
                ("left_", "right_")
            )
            thin = _size(rest) * stick_radius_m(between) if side else radius
            sticks.append(
                [joint, child, thin, RIGHT_SHADE if between.startswith("right_") else shade]
            )
    head = len(rest.names) + len(rest.leaves)
    sticks.append([rest.names.index("head"), head, _size(rest) * stick_radius_m("head"), 1.0])
    sticks.append([head, head, _size(rest) * HEAD_M[2], 1.0])
    sticks.append([head + 1, head + 1, _size(rest) * NOSE_RADIUS_M, 0.9])
    return sticks


def _size(rest: RestRig) -> float:
    return rest.shape.height_m / REFERENCE_HEIGHT_M


FORMAT = TakeFormat(suffix=".html", write=write_html, per_person=False)
