"""GLB: everybody with a skin and a plain body each, and one animation; for viewers and engines.

Metres, y up. Where a person is not tracked, the node of their name has the scale zero, and their
joints the last pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusecap.exports.gltf import Gltf
from fusecap.exports.gltf_people import COLOURS, add_animation, add_body, add_joints, hide_untracked
from fusecap.exports.rig_motion import RigMotion, rig_motions
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.take import Take, made_by


def write_glb(take: Take, path: Path, options: ExportOptions) -> None:
    """Writes everybody who is tracked, whole or not at all."""
    write_people(rig_motions(take, options.rig), path, animated=True)


def write_people(motions: Sequence[RigMotion], path: Path, *, animated: bool) -> None:
    """Whole or not at all; at rest, one in the other, unless they are animated."""
    gltf = Gltf.new(made_by())
    people = []
    for row, motion in enumerate(motions):
        nodes = add_joints(gltf, motion)
        add_body(gltf, motion, nodes, COLOURS[row % len(COLOURS)])
        people.append((motion, nodes))
    if animated:
        add_animation(gltf, people, "take", only_root_moves=False)
        hide_untracked(gltf, people)
    gltf.write(path)


FORMAT = TakeFormat(suffix=".glb", write=write_glb, per_person=False, has_rig=True)
