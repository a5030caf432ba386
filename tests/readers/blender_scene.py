"""Where Blender puts the bones of every armature of a file; needs bpy, no fusecap.

    python blender_scene.py FILE FRAMES OUT.npz

OUT holds per armature `names_<object>` (B,), `heads_<object>` and `tails_<object>` (T, B, 3) [m],
turned to y up.
"""

from __future__ import annotations

import json
import sys

import bpy
import numpy as np

Y_UP_FROM_BLENDER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def main() -> None:
    path, frames, out = sys.argv[1], int(sys.argv[2]), sys.argv[3]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 60
    if path.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=path)
    elif path.endswith(".fbx"):
        bpy.ops.import_scene.fbx(filepath=path)
    else:
        bpy.ops.wm.usd_import(filepath=path)
    armatures = [o for o in bpy.context.scene.objects if o.type == "ARMATURE"]
    found = {}
    for armature in armatures:
        found[f"names_{armature.name}"] = np.array([b.name for b in armature.pose.bones])
        for kind in ("heads", "tails"):
            found[f"{kind}_{armature.name}"] = np.empty((frames, len(armature.pose.bones), 3))
    first = 0 if path.endswith((".glb", ".usdc")) else 1
    for frame in range(frames):
        bpy.context.scene.frame_set(frame + first)
        for armature in armatures:
            for index, bone in enumerate(armature.pose.bones):
                for kind, point in (("heads", bone.head), ("tails", bone.tail)):
                    world = np.array(armature.matrix_world @ point)
                    found[f"{kind}_{armature.name}"][frame, index] = Y_UP_FROM_BLENDER @ world
    np.savez(out, **found)
    meshes = [o.name for o in bpy.context.scene.objects if o.type == "MESH"]
    counts = {"armatures": len(armatures), "meshes": len(meshes)}
    print(json.dumps({"blender": bpy.app.version_string, **counts}))


if __name__ == "__main__":
    main()
