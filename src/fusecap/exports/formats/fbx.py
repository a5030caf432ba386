"""FBX, which Blender writes from our GLB: for Unreal, Unity, MotionBuilder, Maya.

Blender is the one that FUSECAP_BLENDER names, else `blender` on the PATH, else this Python where it
has `bpy`. It bakes every frame, about six times as slowly as the motion lasts.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from fusecap.errors import InputError
from fusecap.exports.formats.glb import write_glb
from fusecap.exports.library import written_by_name
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.take import Take

VARIABLE = "FUSECAP_BLENDER"
_SCRIPT = """
import bpy, json
told = json.loads({told!r})
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = max(1, round(told["rate_hz"]))
scene.render.fps_base = scene.render.fps / told["rate_hz"]
bpy.ops.import_scene.gltf(filepath=told["glb"], disable_bone_shape=True)
scene.frame_start, scene.frame_end = 0, told["frames"] - 1
bpy.ops.export_scene.fbx(
    filepath=told["fbx"], object_types={{"ARMATURE", "MESH"}}, add_leaf_bones=False,
    bake_anim_use_all_actions=False, bake_anim_use_nla_strips=False,
    bake_anim_simplify_factor=0.0,
)
"""


def write_fbx(take: Take, path: Path, options: ExportOptions) -> None:
    """Writes everybody who is tracked, whole or not at all; raises `InputError` without Blender."""
    command = _blender()
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder) / "people.glb"
        write_glb(take, glb, options)

        def convert(fbx: Path) -> None:
            told = {
                "rate_hz": take.rate_hz,
                "frames": len(take.timestamps_ns),
                "glb": str(glb),
                "fbx": str(fbx),
            }
            script = _SCRIPT.format(told=json.dumps(told))
            try:
                run = subprocess.run(
                    [*command, script], capture_output=True, text=True, check=False
                )
            except OSError as error:
                raise InputError(f"cannot run {command[0]}: {error.strerror or error}") from error
            if not fbx.exists():
                last = (run.stderr.strip() or run.stdout.strip() or "no word").splitlines()[-1]
                raise InputError(f"{command[0]} wrote no FBX: {last}")

        written_by_name(path, convert)


def _blender() -> list[str]:
    """What runs a script that follows as the last argument."""
    named = os.environ.get(VARIABLE) or shutil.which("blender")
    if not named and find_spec("bpy") is not None:
        named = sys.executable
    if not named:
        raise InputError(
            f"FBX is written by Blender, and there is none: install Blender 4.2 or newer so that "
            f"`blender` runs, or set {VARIABLE} to its program or to a Python that has bpy "
            "(pip install bpy); GLB needs neither"
        )
    if Path(named).name.startswith("python"):
        return [named, "-c"]
    return [named, "--background", "--factory-startup", "--python-expr"]


FORMAT = TakeFormat(suffix=".fbx", write=write_fbx, per_person=False, has_rig=True)
