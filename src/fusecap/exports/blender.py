"""Blender, where there is one: for FBX, which no library writes as well.

It is the one that FUSECAP_BLENDER names, else `blender` on the PATH, else this Python where it has
`bpy`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fusecap.errors import InputError

VARIABLE = "FUSECAP_BLENDER"
_FBX_FROM_GLB = """
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = max(1, round(told["rate_hz"]))
scene.render.fps_base = scene.render.fps / told["rate_hz"]
bpy.ops.import_scene.gltf(filepath=told["glb"], disable_bone_shape=True)
scene.frame_start, scene.frame_end = 0, told["frames"] - 1
bpy.ops.export_scene.fbx(
    filepath=told["fbx"], object_types={"ARMATURE", "MESH"}, add_leaf_bones=False,
    bake_anim_use_all_actions=False, bake_anim_use_nla_strips=False,
    bake_anim_simplify_factor=0.0, bake_anim_step=told["step"],
)
"""


def run_in_blender(script: str, told: Mapping[str, Any], makes: Path) -> None:
    """Runs a script that knows `told`; raises `InputError` unless it made a file."""
    command = blender_command()
    text = f"import bpy, json\ntold = json.loads({json.dumps(dict(told))!r})\n{script}"
    try:
        run = subprocess.run([*command, text], capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"cannot run {command[0]}: {error.strerror or error}") from error
    if not makes.exists():
        last = (run.stderr.strip() or run.stdout.strip() or "no word").splitlines()[-1]
        raise InputError(
            f"{command[0]} wrote no {makes.suffix.upper()[1:]}, is it Blender 4.2 or newer, or a "
            f"Python that has bpy? It said: {last}"
        )


def fbx_from_glb(glb: Path, fbx: Path, *, rate_hz: float, frames: int, step: int = 1) -> None:
    """Bakes each `step`-th frame; raises `InputError` without Blender."""
    told = {"rate_hz": rate_hz, "frames": frames, "step": step, "glb": str(glb), "fbx": str(fbx)}
    run_in_blender(_FBX_FROM_GLB, told, fbx)


def blender_command() -> list[str]:
    """What runs a script that follows as the last argument."""
    told = os.environ.get(VARIABLE)
    if told and shutil.which(told) is None:
        raise InputError(f"{VARIABLE} names {told}, which is no program that can be run")
    named = told or shutil.which("blender")
    if not named and find_spec("bpy") is not None:
        named = sys.executable
    if not named:
        raise InputError(
            "FBX needs Blender, and there is none: install Blender 4.2 or newer so that `blender` "
            f"runs, or set {VARIABLE} to its program or to a Python that has bpy (pip install "
            "bpy); GLB needs neither"
        )
    if Path(named).name.startswith("python"):
        return [named, "-c"]
    return [named, "--background", "--factory-startup", "--python-expr"]
