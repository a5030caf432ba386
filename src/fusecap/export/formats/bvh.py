"""BVH: one skeleton per file, for Blender, Unity, Unreal, MotionBuilder.

The rest pose is ours, a T-pose facing +z with y up and all rotations zero, so offsets and rotations
are copies. The root has six channels and every joint three, rotations in the order Z X Y:
R = Rz(a) Rx(b) Ry(c). Writing rows of R out gives

    R21 = sin b, R01 = -sin a cos b, R11 = cos a cos b

so b and a follow; c comes from Rz(a)ᵀ R = Rx(b) Ry(c), whose first row is (cos c, 0, sin c). That
holds at b = ±90° too, where a is arbitrary and c makes up for it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.body.shape import BodyShape, end_offsets_m
from fusecap.body.skeleton import Skeleton
from fusecap.errors import TakeError
from fusecap.export.take_files import TakeFormat
from fusecap.files import written_whole
from fusecap.take import Take


def write_bvh(take: Take, subject: str, path: Path, *, units_per_m: float = 1.0) -> None:
    """Write one subject's motion, whole or not at all.

    A frame where the subject is not tracked holds the pose before it, and one before the first
    tracked frame that one's. Raises `TakeError` for a subject that is never tracked.
    """
    index = take.subject(subject)
    frames = _held_frames(take, index)
    lines = [
        *_hierarchy(take.shape(index), units_per_m),
        "MOTION",
        f"Frames: {len(frames)}",
        f"Frame Time: {1 / take.rate_hz:.7f}",
    ]
    channels = np.concatenate(
        [
            take.bone_position_in_world_m[index, frames, 0] * units_per_m,
            _angles_deg(take, index, frames),
        ],
        axis=1,
    )
    with written_whole(path) as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        np.savetxt(file, channels, fmt="%.6f")


def euler_zxy_rad(rotation: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    """Angles a, b, c with rotation = Rz(a) Rx(b) Ry(c), exact also in gimbal lock."""
    r = rotation
    a = np.arctan2(-r[:, 0, 1], r[:, 1, 1])
    b = np.arctan2(r[:, 2, 1], np.hypot(r[:, 2, 0], r[:, 2, 2]))
    cos_a, sin_a = np.cos(a), np.sin(a)
    c = np.arctan2(cos_a * r[:, 0, 2] + sin_a * r[:, 1, 2], cos_a * r[:, 0, 0] + sin_a * r[:, 1, 0])
    return np.stack([a, b, c], axis=1)


def _held_frames(take: Take, subject: int) -> np.ndarray:
    """For every frame the tracked frame whose pose it shows."""
    tracked = take.tracked[subject]
    if not tracked.any():
        raise TakeError(f"'{take.subject_names[subject]}' is tracked in no frame: no BVH to write")
    latest = np.maximum.accumulate(np.where(tracked, np.arange(len(tracked)), -1))
    return np.where(latest < 0, np.argmax(tracked), latest)


def _angles_deg(take: Take, subject: int, frames: np.ndarray) -> Float[np.ndarray, "t b*3"]:
    """Per bone, depth first, Z, X, Y relative to the parent; no jumps of a full turn."""
    world = take.bone_rotation_in_world(subject)[frames]
    angles = np.empty((len(frames), len(take.parents), 3))
    for row, bone in enumerate(_depth_first(take.skeleton)):
        local, parent = world[:, bone], take.parents[bone]
        if parent >= 0:
            local = np.swapaxes(world[:, parent], 1, 2) @ local
        angles[:, row] = np.unwrap(euler_zxy_rad(local), axis=0)
    return np.degrees(angles).reshape(len(frames), -1)


def _depth_first(skeleton: Skeleton, bone: int = 0) -> list[int]:
    """Bones in the order in which a BVH file nests them, and lists their channels."""
    order = [bone]
    for child in skeleton.children(bone):
        order += _depth_first(skeleton, child)
    return order


def _hierarchy(shape: BodyShape, scale: float) -> list[str]:
    """The HIERARCHY section; the root's offset is zero, its position is all in the channels."""
    skeleton = shape.skeleton
    ends = end_offsets_m(shape)
    lines = ["HIERARCHY"]

    def add(bone: int, depth: int) -> None:
        tab, name = "\t" * depth, skeleton.bone_names[bone]
        root = skeleton.parents[bone] < 0
        offset = np.zeros(3) if root else shape.offsets_m[bone]
        rotations = "Zrotation Xrotation Yrotation"
        lines.append(f"{tab}{'ROOT' if root else 'JOINT'} {name}")
        lines.append(f"{tab}{{")
        lines.append(f"{tab}\tOFFSET {_vector(offset * scale)}")
        lines.append(
            f"{tab}\tCHANNELS 6 Xposition Yposition Zposition {rotations}"
            if root
            else f"{tab}\tCHANNELS 3 {rotations}"
        )
        children = skeleton.children(bone)
        for child in children:
            add(child, depth + 1)
        if not children:
            end = f"OFFSET {_vector(ends[name] * scale)}"
            lines.extend([f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\t{end}", f"{tab}\t}}"])
        lines.append(f"{tab}}}")

    add(0, 0)
    return lines


def _vector(xyz: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in xyz)


FORMAT = TakeFormat(suffix=".bvh", write=write_bvh)
