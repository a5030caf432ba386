"""FBX, which Blender writes from our GLB: for Unreal, Unity, MotionBuilder, Maya.

A person has a file: game engines want one skeleton in each, and joints whose names are unique.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.exports.blender import blender_command
from fusecap.exports.fbx_motion import NodeMotion, write_fbx
from fusecap.exports.gltf_people import people_at_rest
from fusecap.exports.rig_motion import rig_motions
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat


def write(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes one person, whole or not at all; raises `InputError` without Blender."""
    still, [(motion, nodes)] = people_at_rest(rig_motions(take, options.rig))
    holder = next(node for node in still.tree["nodes"] if nodes[0] in node.get("children", ()))
    holder["name"] = motion.rest.preset.holder or motion.name
    places, turns = motion.in_world()
    moves = {
        node: NodeMotion(rest=rest, turn=turn, place_m=place)
        for node, rest, place, turn in zip(nodes, motion.rest.rotation, places, turns, strict=True)
    }
    write_fbx(still, moves, path, time_s=take.time_s, rate_hz=take.rate_hz)


FORMAT = TakeFormat(
    suffix=".fbx",
    write=write,
    per_person=True,
    has_rig=True,
    holds=True,
    check_needs=blender_command,
)
