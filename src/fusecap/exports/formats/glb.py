"""GLB: everybody with a skin and a plain body each, and one animation; for viewers and engines.

Metres, y up. Where a person is not tracked, the node of their name has the scale zero, and their
joints the last pose.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.exports.gltf_people import add_animation, hide_untracked, people_at_rest
from fusecap.exports.rig_motion import rig_motions
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat


def write_glb(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes everybody who is tracked, whole or not at all."""
    gltf, people = people_at_rest(rig_motions(take, options.rig))
    add_animation(gltf, people, "take", only_root_moves=False)
    hide_untracked(gltf, people)
    gltf.write(path)


FORMAT = TakeFormat(suffix=".glb", write=write_glb, per_person=False, has_rig=True)
