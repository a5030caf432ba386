"""Points of a body that marker formats carry, as if markers were worn there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import LANDMARKS
from fusecap.body.pose import landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.take import Take

_AXIS_M = 0.08
"""From a joint to the markers that show its bone's axes."""


Marker = tuple[str, str, Float[np.ndarray, "3"]]
"""Name, bone and place in the bone's frame [m]."""


def bone_markers(shape: BodyShape, *, axes: bool = True) -> list[Marker]:
    """The markers of a body.

    Landmarks, joints that none of them marks, and with `axes` two more per bone that show how it
    is turned.
    """
    points = [(name, bone, shape.height_m * np.array(at)) for name, (bone, at) in LANDMARKS.items()]
    marked = {bone for _, bone, at in points if not at.any()}
    for bone in shape.skeleton.bone_names:
        if bone not in marked:
            points.append((f"{bone}_joint", bone, np.zeros(3)))
        if axes:
            points.append((f"{bone}_front", bone, np.array([0.0, 0.0, _AXIS_M])))
            points.append((f"{bone}_left", bone, np.array([_AXIS_M, 0.0, 0.0])))
    return points


def marker_positions_m(take: Take, markers: Sequence[Marker]) -> Float[np.ndarray, "t m 3"]:
    """The one subject's markers in our world; NaN where untracked."""
    bones = np.array([take.skeleton.bone(bone) for _, bone, _ in markers])
    at = np.array([place for _, _, place in markers])
    return landmarks_in_world(
        take.bone_position_in_world_m[0], take.bone_rotation_in_world(0), bones, at
    )
