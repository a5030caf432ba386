"""FBX, which Blender writes from our GLB: for Unreal, Unity, MotionBuilder, Maya."""

from __future__ import annotations

import tempfile
from pathlib import Path

from fusecap.exports.blender import blender_command, run_in_blender
from fusecap.exports.formats.glb import write_glb
from fusecap.exports.library import written_by_name
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.take import Take

_SCRIPT = """
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = max(1, round(told["rate_hz"]))
scene.render.fps_base = scene.render.fps / told["rate_hz"]
bpy.ops.import_scene.gltf(filepath=told["glb"], disable_bone_shape=True)
scene.frame_start, scene.frame_end = 0, told["frames"] - 1
bpy.ops.export_scene.fbx(
    filepath=told["fbx"], object_types={"ARMATURE", "MESH"}, add_leaf_bones=False,
    bake_anim_use_all_actions=False, bake_anim_use_nla_strips=False,
    bake_anim_simplify_factor=0.0,
)
"""


def write_fbx(take: Take, path: Path, options: ExportOptions) -> None:
    """Writes everybody who is tracked, whole or not at all; raises `InputError` without Blender."""
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder) / "people.glb"
        write_glb(take, glb, options)
        fbx_from_glb(glb, path, rate_hz=take.rate_hz, frames=len(take.timestamps_ns))


def fbx_from_glb(glb: Path, path: Path, *, rate_hz: float, frames: int) -> None:
    """Bakes every frame, whole or not at all; raises `InputError` without Blender."""

    def convert(fbx: Path) -> None:
        told = {"rate_hz": rate_hz, "frames": frames, "glb": str(glb), "fbx": str(fbx)}
        run_in_blender(_SCRIPT, told, fbx)

    written_by_name(path, convert)


FORMAT = TakeFormat(
    suffix=".fbx", write=write_fbx, per_person=False, has_rig=True, check_needs=blender_command
)
