"""BVH: one skeleton per file, for Blender, Unity, Unreal, MotionBuilder.

The frames of a BVH file are parallel to the world at rest, so joints keep their offsets and turn by
what they turned since the rest pose. Three angles per joint say it, about axes in the order of the
joint's CHANNELS:

    R = R_first(a) R_middle(b) R_last(c)

A middle angle of 90 degrees makes the others meaningless (gimbal lock), and jumps from frame to
frame far beyond what the joint turned: with Z X Y that is every bent knee. No order suits all
joints: where a middle angle passes 60 degrees in this file, the joint has the one of the six orders
that keeps it furthest from 90.

Only the root, and hips below a root that stays on the floor, have position channels: importers
disagree whether another joint's stand in place of its offset or are added to it. A rig with three
spine bones is therefore within millimetres here, and exact in formats that carry places.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.body.rigs import rig_preset
from fusecap.exports.euler import euler_rad
from fusecap.exports.rest_rig import RestRig
from fusecap.exports.rig_motion import rig_motion
from fusecap.exports.take_format import (
    METRE_AND_CM,
    UNITS_PER_M,
    AnyTake,
    ExportOptions,
    TakeFormat,
)
from fusecap.files import written_whole

_ORDERS = ("ZXY", "YXZ", "ZYX", "XYZ", "YZX", "XZY")
"""The first that is safe: importers know Z X Y best."""
_SAFE = np.sin(np.radians(60.0))
"""Up to this middle angle no curve is steeper than twice what the joint turns."""


def write_bvh(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all.

    A frame where the subject is not tracked holds the pose before it, and one before the first
    tracked frame that one's. Raises `TakeError` for a subject that is never tracked.
    """
    motion = rig_motion(take, 0, rig_preset(options.rig))
    scale = UNITS_PER_M[options.unit]
    nested = _depth_first(motion.rest.parents)
    orders: dict[int, str] = {}
    columns: list[np.ndarray] = []
    for joint in nested:
        rotation = motion.rotation_from_rest(joint)
        orders[joint] = best_order(rotation)
        if joint in motion.rest.travelling:
            parent = motion.rest.parents[joint]
            axes = motion.rest.rotation[parent] if parent >= 0 else np.eye(3)
            columns.append(motion.position_m[:, joint] @ axes.T * scale)
        columns.append(np.degrees(euler_rad(rotation, orders[joint])))
    lines = [
        *_hierarchy(motion.rest, orders, scale),
        "MOTION",
        f"Frames: {len(motion.time_s)}",
        f"Frame Time: {1 / motion.rate_hz:.7f}",
    ]
    with written_whole(path) as file:
        file.write(("\n".join(lines) + "\n").encode())
        np.savetxt(file, np.concatenate(columns, axis=1), fmt="%.6f")


def best_order(rotation: Float[np.ndarray, "t 3 3"]) -> str:
    """The first order of axes that is safe, else that which stays furthest from 90 degrees."""
    worst = [np.abs(_sine_of_middle(rotation, order)).max() for order in _ORDERS]
    enough = max(min(worst), _SAFE)
    return next(o for o, w in zip(_ORDERS, worst, strict=True) if w <= enough)


def _sine_of_middle(rotation: Float[np.ndarray, "t 3 3"], order: str) -> Float[np.ndarray, " t"]:
    return rotation[:, "XYZ".index(order[0]), "XYZ".index(order[2])]


def _depth_first(parents: tuple[int, ...], joint: int = 0) -> list[int]:
    """Joints in the order in which a BVH file nests them, and lists their channels."""
    order = [joint]
    for child, parent in enumerate(parents):
        if parent == joint:
            order += _depth_first(parents, child)
    return order


def _hierarchy(rest: RestRig, orders: dict[int, str], scale: float) -> list[str]:
    """The HIERARCHY section; an offset is zero where the position is all in the channels."""
    lines = ["HIERARCHY"]

    def add(joint: int, depth: int) -> None:
        tab, parent = "\t" * depth, rest.parents[joint]
        travels = joint in rest.travelling
        offset = np.zeros(3) if travels else rest.position_m[joint] - rest.position_m[parent]
        turns = " ".join(f"{axis}rotation" for axis in orders[joint])
        lines.append(f"{tab}{'ROOT' if parent < 0 else 'JOINT'} {rest.names[joint]}")
        lines.append(f"{tab}{{")
        lines.append(f"{tab}\tOFFSET {_vector(offset * scale)}")
        lines.append(
            f"{tab}\tCHANNELS 6 Xposition Yposition Zposition {turns}"
            if travels
            else f"{tab}\tCHANNELS 3 {turns}"
        )
        children = [child for child, above in enumerate(rest.parents) if above == joint]
        for child in children:
            add(child, depth + 1)
        if not children:
            end = f"OFFSET {_vector((rest.tip_m[joint] - rest.position_m[joint]) * scale)}"
            lines.extend([f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\t{end}", f"{tab}\t}}"])
        lines.append(f"{tab}}}")

    add(0, 0)
    return lines


def _vector(xyz: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in xyz)


FORMAT = TakeFormat(
    suffix=".bvh", write=write_bvh, per_person=True, units=METRE_AND_CM, has_rig=True, holds=True
)
