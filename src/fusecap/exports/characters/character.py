"""A rigged character of a GLB or VRM file: its tree of nodes at rest, and the file around it."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.inputs import CHARACTER, read_bytes


@dataclass(frozen=True, kw_only=True)
class Character:
    """Nodes at rest; parents come before children."""

    path: Path
    tree: dict[str, Any]
    """The file's JSON."""
    binary: bytes
    names: tuple[str, ...]
    parents: tuple[int, ...]
    """-1 for nodes without one."""
    order: tuple[int, ...]
    """Node indices from parents to children."""
    position_m: Float[np.ndarray, "n 3"]
    """Relative to the parents."""
    rotation: Float[np.ndarray, "n 3 3"]
    scale: Float[np.ndarray, "n"]
    """Uniform."""
    world_position_m: Float[np.ndarray, "n 3"]
    world_rotation: Float[np.ndarray, "n 3 3"]
    world_scale: Float[np.ndarray, "n"]
    joints: tuple[int, ...]
    """Nodes that skins bend."""
    told: dict[str, int]
    """What the file itself says of bones: VRM's names to nodes."""


def read_character(path: Path) -> Character:
    """Raises `InputError` for a file that is not a GLB, or has no skin."""
    tree, binary = _read_glb(path)
    nodes = tree.get("nodes", [])
    parents = [-1] * len(nodes)
    for index, node in enumerate(nodes):
        for child in node.get("children", ()):
            if not (isinstance(child, int) and 0 <= child < len(nodes)) or parents[child] != -1:
                raise InputError(f"{path}: node {index} has a child that is not one")
            parents[child] = index
    order = _from_parents(parents, path)
    count = len(nodes)
    position, rotation, scale = np.zeros((count, 3)), np.empty((count, 3, 3)), np.ones(count)
    sizes = np.ones((count, 3))
    for index, node in enumerate(nodes):
        position[index], rotation[index], sizes[index] = _local(node)
        scale[index] = sizes[index, 0]
    world_position, world_rotation = position.copy(), rotation.copy()
    world_scale = scale.copy()
    for index in order:
        above = parents[index]
        if above >= 0:
            turned = world_rotation[above] @ position[index]
            world_position[index] = world_position[above] + world_scale[above] * turned
            world_rotation[index] = world_rotation[above] @ rotation[index]
            world_scale[index] = world_scale[above] * scale[index]
    joints = {joint for skin in tree.get("skins", ()) for joint in skin.get("joints", ())}
    if not joints:
        raise InputError(f"{path}: has no skin, so there is no rig to move")
    _check_sizes(nodes, sizes, joints, parents, path)
    return Character(
        path=path,
        tree=tree,
        binary=binary,
        names=tuple(str(node.get("name", f"node {i}")) for i, node in enumerate(nodes)),
        parents=tuple(parents),
        order=tuple(order),
        position_m=position,
        rotation=rotation,
        scale=scale,
        world_position_m=world_position,
        world_rotation=world_rotation,
        world_scale=world_scale,
        joints=tuple(sorted(joints)),
        told=_told(tree),
    )


def _read_glb(path: Path) -> tuple[dict[str, Any], bytes]:
    data = read_bytes(path, CHARACTER)
    if data[:4] != b"glTF":
        raise InputError(f"{path}: expected a binary glTF (.glb or .vrm)")
    at, tree, binary = 12, None, b""
    try:
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<I4s", data, at)
            chunk = data[at + 8 : at + 8 + length]
            if len(chunk) < length:
                raise InputError(f"{path}: is cut short")
            if kind == b"JSON":
                tree = json.loads(chunk)
            elif kind == b"BIN\0":
                binary = chunk
            at += 8 + length
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is damaged ({error})") from error
    if not isinstance(tree, dict):
        raise InputError(f"{path}: is damaged: it has no tree of nodes")
    return tree, binary


def _from_parents(parents: list[int], path: Path) -> list[int]:
    children: dict[int, list[int]] = {}
    for index, parent in enumerate(parents):
        children.setdefault(parent, []).append(index)
    order, ahead = [], list(children.get(-1, ()))[::-1]
    while ahead:
        index = ahead.pop()
        order.append(index)
        ahead += children.get(index, ())[::-1]
    if len(order) != len(parents):
        raise InputError(f"{path}: its nodes form a circle")
    return order


def _local(node: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, rotation and sizes of a node in its parent."""
    if "matrix" in node:
        matrix = np.array(node["matrix"], dtype=float).reshape(4, 4).T
        sizes = np.linalg.norm(matrix[:3, :3], axis=0)
        position, rotation = matrix[:3, 3], matrix[:3, :3] / np.maximum(sizes, 1e-12)
    else:
        position = np.array(node.get("translation", (0, 0, 0)), dtype=float)
        turn = Rotation.from_quat(np.array(node.get("rotation", (0, 0, 0, 1)), dtype=float))
        rotation = turn.as_matrix()
        sizes = np.array(node.get("scale", (1, 1, 1)), dtype=float)
    return position, rotation, sizes


def _check_sizes(
    nodes: list[dict[str, Any]],
    sizes: Float[np.ndarray, "n 3"],
    joints: set[int],
    parents: list[int],
    path: Path,
) -> None:
    """Joints, and what they hang on, are of one size in all directions."""
    for joint in sorted(joints):
        index = joint
        while index >= 0:
            size = sizes[index]
            if not np.allclose(size, size[0], rtol=1e-3) or size[0] <= 0:
                raise InputError(
                    f"{path}: node '{nodes[index].get('name', index)}' is scaled by "
                    f"{size.round(3).tolist()}; apply scales in the program that made it"
                )
            index = parents[index]


def _told(tree: dict[str, Any]) -> dict[str, int]:
    extensions = tree.get("extensions", {})
    humanoid = extensions.get("VRMC_vrm", {}).get("humanoid", {}).get("humanBones", {})
    if humanoid:
        return {name: int(bone["node"]) for name, bone in humanoid.items()}
    older = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    return {str(bone["bone"]): int(bone["node"]) for bone in older}
