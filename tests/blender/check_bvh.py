"""Imports BVH files into Blender and compares every joint of every frame with the take.

Run by a Python that has bpy, which needs no fusecap (tests/test_bvh_blender.py does):

    python check_bvh.py EXPECTED.npz [PICTURE.npz]

EXPECTED holds, per file, `path_<i>`, `bones_<i>` (B,) and `position_m_<i>` (T, B, 3), y up. Prints
per file a line of JSON with the largest distance in millimetres. PICTURE, if named, receives the
heads and tails that Blender reports, in Blender's own z-up world.
"""

from __future__ import annotations

import json
import sys

import bpy
import numpy as np

Y_UP_FROM_BLENDER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def imported(path: str, frames: int) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Bone names, heads and tails (T, B, 3) in Blender's world, as the importer's defaults give."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_anim.bvh(filepath=path)
    armature = bpy.context.object
    names = [bone.name for bone in armature.pose.bones]
    heads, tails = np.empty((2, frames, len(names), 3))
    for frame in range(frames):
        bpy.context.scene.frame_set(frame + 1)
        for index, bone in enumerate(armature.pose.bones):
            heads[frame, index] = armature.matrix_world @ bone.head
            tails[frame, index] = armature.matrix_world @ bone.tail
    keyed = armature.animation_data.action.frame_range
    assert tuple(keyed) == (1, frames), (tuple(keyed), frames)
    return names, heads, tails


def main() -> None:
    expected = np.load(sys.argv[1])
    picture = {}
    for index in range(sum(key.startswith("path_") for key in expected.files)):
        path = str(expected[f"path_{index}"])
        position_m = expected[f"position_m_{index}"]
        names, heads, tails = imported(path, len(position_m))
        bones = expected[f"bones_{index}"].tolist()
        assert {*bones} <= {*names}, (names, bones)
        found_m = heads[:, [names.index(name) for name in bones]] @ Y_UP_FROM_BLENDER.T
        error_mm = 1e3 * np.linalg.norm(found_m - position_m, axis=-1)
        report = {
            "file": path,
            "frames": len(position_m),
            "bones": len(bones),
            "max_error_mm": float(error_mm.max()),
        }
        print(json.dumps(report))
        picture |= {f"heads_{index}": heads, f"tails_{index}": tails}
    if len(sys.argv) > 2:
        np.savez(sys.argv[2], **picture)


if __name__ == "__main__":
    main()
