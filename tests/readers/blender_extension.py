"""Uses the extension as a person would: imports a take, retargets, receives a stream, bakes it.

    python blender_extension.py EXTENSION_FOLDER TAKE.npz OUT.npz ws://ADDRESS CHARACTER.glb...

EXTENSION_FOLDER holds the unpacked `fusecap_motion`. OUT receives, per armature, names and heads
per frame in fusecap's axes: `import_*` of the take, `live_*` of the baked stream, `character_<n>`
and `character_names_<n>` of the first person's motion on each character, `live_character` of the
stream's on the last.
"""

from __future__ import annotations

import json
import sys
import time
from types import SimpleNamespace

import bpy
import numpy as np

Y_UP_FROM_BLENDER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def heads(armature, first: float, frames: int) -> np.ndarray:
    found = np.empty((frames, len(armature.pose.bones), 3))
    for frame in range(frames):
        whole = int(np.floor(first + frame))
        bpy.context.scene.frame_set(whole, subframe=first + frame - whole)
        for index, bone in enumerate(armature.pose.bones):
            world = np.array(armature.matrix_world @ bone.head)
            found[frame, index] = Y_UP_FROM_BLENDER @ world
    return found


def people():
    return [o for o in bpy.context.scene.objects if o.type == "ARMATURE"]


def load_character(path: str):
    before = {*people()}
    bpy.ops.import_scene.gltf(filepath=path, guess_original_bind_pose=False)
    (loaded,) = {*people()} - before
    return loaded


def retarget(person, character) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    for one in (person, character):
        one.select_set(True)
    bpy.context.view_layer.objects.active = character
    assert bpy.ops.object.fusecap_retarget() == {"FINISHED"}


class Layout:
    """Stands where Blender gives a panel its layout; what is drawn must exist."""

    def __init__(self) -> None:
        self.drawn: list[str] = []

    def operator(self, name: str, **options: object) -> None:
        group, _, operator = name.partition(".")
        assert getattr(getattr(bpy.ops, group), operator).get_rna_type().name
        self.drawn.append(name)

    def prop(self, owner, name: str, **options: object) -> None:
        assert owner.bl_rna.properties[name].name
        self.drawn.append(name)


def draw(extension) -> list[str]:
    """What the panel and the import menu show."""
    here = SimpleNamespace(layout=Layout())
    extension.VIEW3D_PT_fusecap.draw(here, bpy.context)
    extension._menu(here, bpy.context)
    return here.layout.drawn


def main() -> None:
    folder, take, out, address, *characters = sys.argv[1:]
    sys.path.insert(0, folder)
    import fusecap_motion

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 60
    fusecap_motion.register()
    drawn = draw(fusecap_motion)
    with np.load(take) as file:
        frames = len(file["timestamps_ns"])
    assert bpy.ops.import_anim.fusecap_take(filepath=take) == {"FINISHED"}
    found, imported = {}, people()
    for armature in imported:
        found[f"import_{armature.name}"] = heads(armature, 1, frames)
        found[f"names_{armature.name}"] = np.array([b.name for b in armature.pose.bones])
    for number, path in enumerate(characters):
        character = load_character(path)
        retarget(imported[0], character)
        found[f"character_{number}"] = heads(character, 1, frames)
        found[f"character_names_{number}"] = np.array([b.name for b in character.pose.bones])
    for armature in people():
        bpy.data.objects.remove(armature)
    bpy.context.scene.fusecap_address = address
    bpy.context.scene.fusecap_record = True
    assert bpy.ops.scene.fusecap_connect() == {"FINISHED"}
    character = load_character(characters[-1])
    until = time.monotonic() + 3.0
    while time.monotonic() < until:
        fusecap_motion._timer()
        if len(people()) > 1 and character.animation_data is None:
            character.animation_data_create()
            retarget(next(o for o in people() if o != character), character)
        time.sleep(0.02)
    assert bpy.ops.scene.fusecap_disconnect() == {"FINISHED"}
    for armature in people():
        length = armature.animation_data.action.frame_range[1]
        kind = "live_character" if armature == character else f"live_{armature.name}"
        found[kind] = heads(armature, 1, int(length))
    fusecap_motion.unregister()
    np.savez(out, **found)
    print(json.dumps({"blender": bpy.app.version_string, "people": len(people()), "drawn": drawn}))


if __name__ == "__main__":
    main()
