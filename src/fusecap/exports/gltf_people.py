"""People in a glTF document: a tree of joints each, a body, and one animation of everybody."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.exports.body_mesh import body_mesh
from fusecap.exports.gltf import Gltf
from fusecap.exports.rig_motion import RigMotion
from fusecap.take import made_by

COLOURS = (
    *((0.30, 0.55, 0.85), (0.90, 0.50, 0.25), (0.35, 0.70, 0.45), (0.80, 0.40, 0.60)),
    *((0.65, 0.60, 0.30), (0.45, 0.45, 0.80), (0.25, 0.65, 0.70), (0.75, 0.35, 0.30)),
)
"""Of people, in order; linear light."""


def people_at_rest(motions: Iterable[RigMotion]) -> tuple[Gltf, list[tuple[RigMotion, list[int]]]]:
    """A document of everybody, one in the other, and everybody's nodes by joint."""
    gltf, people = Gltf.new(made_by()), []
    for row, motion in enumerate(motions):
        nodes = add_joints(gltf, motion)
        add_body(gltf, motion, nodes, COLOURS[row % len(COLOURS)])
        people.append((motion, nodes))
    return gltf, people


def add_joints(gltf: Gltf, motion: RigMotion) -> list[int]:
    """The tree of one person at rest below a node of their name; nodes by joint."""
    rest = motion.rest
    xyzw = Rotation.from_matrix(rest.rotation_in_parent).as_quat()
    nodes = [
        gltf.add(
            "nodes",
            {
                "name": name,
                "translation": rest.position_in_parent_m[joint].tolist(),
                "rotation": xyzw[joint].tolist(),
            },
        )
        for joint, name in enumerate(rest.names)
    ]
    for joint, parent in enumerate(rest.parents):
        if parent >= 0:
            gltf.tree["nodes"][nodes[parent]].setdefault("children", []).append(nodes[joint])
    owner = gltf.add("nodes", {"name": motion.name, "children": [nodes[0]]})
    gltf.tree["scenes"][0]["nodes"].append(owner)
    return nodes


def add_body(gltf: Gltf, motion: RigMotion, nodes: list[int], colour: tuple[float, ...]) -> None:
    """A skinned mesh beside the joints."""
    mesh = body_mesh(motion.rest)
    count = len(mesh.vertices_m)
    joints, weights = np.zeros((count, 4), dtype=np.uint16), np.zeros((count, 4), dtype=np.float32)
    joints[:, :2], weights[:, :2] = mesh.joints, mesh.weights
    joints[weights == 0] = 0
    same = joints[:, 0] == joints[:, 1]
    weights[same, 0], weights[same, 1] = 1.0, 0.0
    joints[same, 1] = 0
    material = gltf.add(
        "materials",
        {
            "name": f"{motion.name} body",
            "pbrMetallicRoughness": {
                "baseColorFactor": [*colour, 1.0],
                "metallicFactor": 0.0,
                "roughnessFactor": 0.8,
            },
        },
    )
    primitive = {
        "attributes": {
            "POSITION": gltf.vertices(mesh.vertices_m.astype(np.float32), bounds=True),
            "NORMAL": gltf.vertices(mesh.normals.astype(np.float32)),
            "JOINTS_0": gltf.vertices(joints),
            "WEIGHTS_0": gltf.vertices(weights),
        },
        "indices": gltf.indices(mesh.faces.astype(np.uint16).ravel()),
        "material": material,
    }
    skin = gltf.add(
        "skins",
        {
            "name": motion.name,
            "joints": nodes,
            "skeleton": nodes[0],
            "inverseBindMatrices": gltf.array(_inverse_binds(motion)),
        },
    )
    shape = gltf.add("meshes", {"name": f"{motion.name} body", "primitives": [primitive]})
    node = gltf.add("nodes", {"name": f"{motion.name} body", "mesh": shape, "skin": skin})
    gltf.tree["scenes"][0]["nodes"].append(node)


def add_animation(
    gltf: Gltf, people: list[tuple[RigMotion, list[int]]], name: str, *, only_root_moves: bool
) -> None:
    """One animation of everybody: rotations of all joints, places of those that move."""
    samplers: list[dict[str, Any]] = []
    channels: list[dict[str, Any]] = []
    times = gltf.array(people[0][0].time_s.astype(np.float32), bounds=True)

    def add(node: int, path: str, values: np.ndarray) -> None:
        samplers.append({"input": times, "output": gltf.array(values.astype(np.float32))})
        target = {"node": node, "path": path}
        channels.append({"sampler": len(samplers) - 1, "target": target})

    for motion, nodes in people:
        for joint, node in enumerate(nodes):
            add(node, "rotation", motion.rotation_xyzw[:, joint])
            if joint in motion.moving and (joint == 0 or not only_root_moves):
                add(node, "translation", motion.position_m[:, joint])
    gltf.add("animations", {"name": name, "samplers": samplers, "channels": channels})


def hide_untracked(gltf: Gltf, people: list[tuple[RigMotion, list[int]]]) -> None:
    """In the one animation: who is not tracked has no size. glTF's core knows no visibility."""
    animation = gltf.tree["animations"][0]
    for motion, nodes in people:
        frames = motion.turns_of_tracked()
        if not len(frames):
            continue
        owner = next(
            index
            for index, node in enumerate(gltf.tree["nodes"])
            if nodes[0] in node.get("children", ())
        )
        size = np.repeat(motion.tracked[frames, None], 3, axis=1).astype(np.float32)
        sampler = {
            "input": gltf.array(motion.time_s[frames].astype(np.float32), bounds=True),
            "output": gltf.array(size),
            "interpolation": "STEP",
        }
        animation["samplers"].append(sampler)
        target = {"node": owner, "path": "scale"}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})


def _inverse_binds(motion: RigMotion) -> Float[np.ndarray, "j 16"]:
    """Column by column, as glTF stores matrices."""
    rest = motion.rest
    inverse = np.tile(np.eye(4), (len(rest.names), 1, 1))
    inverse[:, :3, :3] = rest.rotation.transpose(0, 2, 1)
    inverse[:, :3, 3] = -np.einsum("jki,jk->ji", rest.rotation, rest.position_m)
    return inverse.transpose(0, 2, 1).reshape(-1, 16).astype(np.float32)
