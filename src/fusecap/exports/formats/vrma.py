"""VRMA: a person's motion for any VRM avatar (VRMC_vrm_animation 1.0, a GLB with a map of bones).

The extension knows rotations of bones and the place of the hips, no other places: the folded spine
(`fusecap.body.rigs`) puts what is above it within millimetres, as it does on any avatar.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.exports.gltf import Gltf
from fusecap.exports.gltf_people import add_animation, add_joints
from fusecap.exports.rig_motion import rig_motions
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat
from fusecap.take import made_by

_EXTENSION = "VRMC_vrm_animation"


def write_vrma(take: AnyTake, path: Path, _: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    gltf = Gltf.new(made_by())
    (motion,) = rig_motions(take, "vrm")
    nodes = add_joints(gltf, motion)
    add_animation(gltf, [(motion, nodes)], "take", only_root_moves=True)
    bones = {name: {"node": node} for name, node in zip(motion.rest.names, nodes, strict=True)}
    gltf.tree["extensionsUsed"] = [_EXTENSION]
    gltf.tree["extensions"] = {
        _EXTENSION: {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
    }
    gltf.write(path)


FORMAT = TakeFormat(suffix=".vrma", write=write_vrma, per_person=True, holds=True)
