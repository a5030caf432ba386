"""BVH motion: a hierarchy of offsets, then one line of channels per frame.

Channels are rotations about moving axes in the order listed, in degrees. Many conversions of the
CMU database open with one frame of rest pose; it is dropped.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.motion.motion import (
    CMU_UNIT_M,
    Motion,
    chain_rotations,
    numbers,
)
from fusecap.motion.motion_format import MotionFormat


@dataclass
class _Joint:
    name: str
    parent: int
    offset: list[float] = field(default_factory=list)
    channels: list[str] = field(default_factory=list)


def parse_bvh(text: str, name: str, unit_m: float = CMU_UNIT_M) -> Motion:
    """A BVH take, `unit_m` metres to the unit; raises `InputError` where the file is broken."""
    head, found, tail = text.partition("MOTION")
    if not found or not head.split() or head.split()[0] != "HIERARCHY":
        raise InputError(f"{name}: expected 'HIERARCHY' and 'MOTION'; this is not a BVH file")
    joints, ends = _hierarchy(head.split()[1:], name)
    values, rate_hz = _frames(tail.split(), sum(len(j.channels) for j in joints), name)

    frames = len(values)
    position = np.zeros((frames, 3))
    local = np.empty((frames, len(joints), 3, 3))
    column = 0
    for index, joint in enumerate(joints):
        order = ""
        angles = []
        for channel in joint.channels:
            if channel.endswith("rotation"):
                order += channel[0]
                angles.append(values[:, column])
            elif index == 0:
                position[:, "XYZ".index(channel[0])] = values[:, column] * unit_m
            column += 1
        turn = Rotation.from_euler(order, np.stack(angles, axis=-1), degrees=True)
        local[:, index] = turn.as_matrix()

    parents = tuple(joint.parent for joint in joints)
    motion = Motion(
        name=name,
        joint_names=tuple(joint.name for joint in joints),
        parents=parents,
        bone_vector_m=_bone_vectors(joints, ends) * unit_m,
        root_position_m=position + np.array(joints[0].offset) * unit_m,
        rotation_in_world=chain_rotations(parents, local),
        rate_hz=rate_hz,
    )
    at_rest = np.all(np.isclose(local[0], np.eye(3)), axis=(1, 2))
    return motion[1:] if frames > 1 and at_rest[0] and at_rest.mean() > 0.5 else motion


def _hierarchy(words: list[str], name: str) -> tuple[list[_Joint], dict[int, list[float]]]:
    """Joints in the order of their channels, and end-site offsets by joint."""
    joints: list[_Joint] = []
    ends: dict[int, list[float]] = {}
    open_blocks: list[int | None] = []
    pending: int | None = None
    words = words[::-1]

    def take(count: int, what: str) -> list[str]:
        if len(words) < count:
            raise InputError(f"{name}: the hierarchy ends before {what}")
        return [words.pop() for _ in range(count)]

    while words:
        word = words.pop()
        if word in ("ROOT", "JOINT"):
            parent = open_blocks[-1] if open_blocks else None
            if (parent is None) != (not joints):
                raise InputError(f"{name}: a {word} stands outside the one tree of joints")
            joints.append(_Joint(take(1, "a joint's name")[0], -1 if parent is None else parent))
            pending = len(joints) - 1
        elif word == "End":
            take(1, "'Site'")
            pending = None
        elif word == "{":
            open_blocks.append(pending)
        elif word == "}":
            if not open_blocks:
                raise InputError(f"{name}: a '}}' too many in the hierarchy")
            open_blocks.pop()
        elif word == "OFFSET" and open_blocks:
            offset = numbers(take(3, "an offset"), f"{name}, offset")
            if open_blocks[-1] is not None:
                joints[open_blocks[-1]].offset = offset
            elif len(open_blocks) > 1 and open_blocks[-2] is not None:
                ends[open_blocks[-2]] = offset
        elif word == "CHANNELS" and open_blocks and open_blocks[-1] is not None:
            count = int(numbers(take(1, "a channel count"), f"{name}, channel count")[0])
            joints[open_blocks[-1]].channels = take(count, "the channels")
        else:
            raise InputError(f"{name}: unexpected '{word[:40]}' in the hierarchy")
    if open_blocks or not joints:
        raise InputError(f"{name}: the hierarchy is not closed; the file may be cut short")
    known = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
    for joint in joints:
        rotations = [c for c in joint.channels if c.endswith("rotation")]
        if len(joint.offset) != 3 or not set(joint.channels) <= known or len(rotations) != 3:
            raise InputError(
                f"{name}: joint '{joint.name}' needs an OFFSET and three rotation CHANNELS; "
                f"found {' '.join(joint.channels) or 'none'}"
            )
    return joints, ends


def _frames(words: list[str], width: int, name: str) -> tuple[Float[np.ndarray, "t c"], float]:
    if len(words) < 5 or words[0] != "Frames:" or words[2:4] != ["Frame", "Time:"]:
        raise InputError(f"{name}: expected 'Frames: N' and 'Frame Time: seconds' after MOTION")
    count, frame_time_s = numbers([words[1], words[4]], f"{name}, motion header")
    if count < 1 or count != int(count) or frame_time_s <= 0:
        raise InputError(f"{name}: {count:g} frames of {frame_time_s:g} s")
    if len(words) - 5 != count * width:
        raise InputError(
            f"{name}: {len(words) - 5} values; {count:g} frames of {width} channels need "
            f"{count * width:g}; the file may be cut short"
        )
    values = np.array(numbers(words[5:], f"{name}, motion")).reshape(int(count), width)
    return values, 1.0 / frame_time_s


def _bone_vectors(joints: list[_Joint], ends: dict[int, list[float]]) -> Float[np.ndarray, "j 3"]:
    """The end site or the first child that lies away from the joint."""
    vectors = np.zeros((len(joints), 3))
    for index in range(len(joints)):
        offsets = [joint.offset for joint in joints if joint.parent == index]
        if index in ends:
            offsets.append(ends[index])
        vectors[index] = next((offset for offset in offsets if np.any(offset)), np.zeros(3))
    return vectors


FORMAT = MotionFormat(
    what="a .bvh", suffix=".bvh", parse=lambda text, path, _beside: parse_bvh(text, path)
)
