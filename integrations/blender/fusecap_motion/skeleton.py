"""People of fusecap as armatures: built from bones and offsets, posed by places and rotations.

fusecap's world is y up, Blender's z up: (x, y, z) becomes (x, -z, y). In the rest pose fusecap's
bones are parallel to the world, Blender's lie along their bones; a bone's matrix is the turn since
the rest pose times its rest matrix.
"""

import bpy
import numpy as np
from mathutils import Vector

BLENDER_FROM_FUSECAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_MAIN_CHILD = {"hips": "spine", "spine3": "neck"}
_SHORT_M = 0.08


_TOE_HEIGHT = 0.012
"""Of the joints of toes over the floor, as a share of the stature."""


def connected(bones, parents, offsets_m):
    """The tree with the bones that tie limbs to the trunk.

    Returns names, parents, offsets [m], and for each the fusecap bone that it turns with.
    """
    offsets_m = np.asarray(offsets_m, dtype=float)
    names, above, offsets, turns_with = [], [], [], []
    index = {}
    for bone, parent, offset in zip(bones, parents, offsets_m, strict=True):
        at = index.get(bones[parent], -1) if parent >= 0 else -1
        side = bone.partition("_")[0]
        if bone.endswith("_thigh") and parent >= 0:
            start = offsets_m[bones.index("spine")]
            names.append(f"{side}_pelvis")
        elif bone.endswith("_upper_arm") and f"{side}_clavicle" not in bones:
            start = offset * [0.15, 1.0, 1.0]
            names.append(f"{side}_clavicle")
        else:
            start = None
        if start is not None:
            above.append(at)
            offsets.append(start)
            turns_with.append(parent)
            at, offset = len(names) - 1, offset - start
        index[bone] = len(names)
        names.append(bone)
        above.append(at)
        offsets.append(np.zeros(3) if parent < 0 else offset)
        turns_with.append(bones.index(bone))
    return names, above, np.array(offsets), turns_with


class Person:
    """An armature object and how it is posed."""

    def __init__(self, name, bones, parents, offsets_m, height_m):
        self.name = name
        self._sole_m = _TOE_HEIGHT * height_m
        self.names, self.parents, self.offsets_m, self._turns = connected(
            list(bones), list(parents), offsets_m
        )
        self._of_bone = {n: i for i, n in enumerate(bones)}
        self.object = self._build()
        self.rest = np.array([np.array(self.object.data.bones[n].matrix_local) for n in self.names])
        """In the world (J, 4, 4): standing on the floor."""

    def _build(self):
        heads = np.zeros((len(self.names), 3))
        for bone, parent in enumerate(self.parents):
            if parent >= 0:
                heads[bone] = heads[parent] + self.offsets_m[bone]
        heads = heads @ BLENDER_FROM_FUSECAP.T
        heads[:, 2] += self._sole_m - heads[:, 2].min()
        data = bpy.data.armatures.new(self.name)
        made = bpy.data.objects.new(self.name, data)
        bpy.context.scene.collection.objects.link(made)
        bpy.context.view_layer.objects.active = made
        bpy.ops.object.mode_set(mode="EDIT")
        for bone, name in enumerate(self.names):
            edit = data.edit_bones.new(name)
            edit.head = heads[bone]
            edit.tail = self._tail(bone, heads)
            if self.parents[bone] >= 0:
                edit.parent = data.edit_bones[self.names[self.parents[bone]]]
        bpy.ops.object.mode_set(mode="OBJECT")
        for bone in made.pose.bones:
            bone.rotation_mode = "QUATERNION"
        return made

    def _tail(self, bone, heads):
        children = [c for c, parent in enumerate(self.parents) if parent == bone]
        main = _MAIN_CHILD.get(self.names[bone])
        children = [c for c in children if self.names[c] == main] or children
        if children:
            tail = Vector(heads[children[0]])
            if (tail - Vector(heads[bone])).length > 1e-4:
                return tail
        parent = self.parents[bone]
        along = Vector(heads[bone]) - Vector(heads[parent]) if parent >= 0 else Vector((0, 0, 1))
        if self.names[bone] == "head":
            along = Vector((0, 0, 1))
        return Vector(heads[bone]) + along.normalized() * _SHORT_M

    def poses(self, position_m, rotation_wxyz):
        """Matrices of pose bones (T, J, 4, 4) in the world."""
        position_m = np.asarray(position_m, dtype=float) @ BLENDER_FROM_FUSECAP.T
        turn = matrices(np.asarray(rotation_wxyz, dtype=float))
        turn = BLENDER_FROM_FUSECAP @ turn @ BLENDER_FROM_FUSECAP.T
        pose = np.tile(np.eye(4), (len(position_m), len(self.names), 1, 1))
        for bone, (name, with_bone) in enumerate(zip(self.names, self._turns, strict=True)):
            pose[:, bone, :3, :3] = turn[:, with_bone] @ self.rest[bone, :3, :3]
            if name in self._of_bone:
                pose[:, bone, :3, 3] = position_m[:, self._of_bone[name]]
            else:
                start = turn[:, with_bone] @ (BLENDER_FROM_FUSECAP @ self.offsets_m[bone])
                pose[:, bone, :3, 3] = position_m[:, with_bone] + start
        return pose

    def channels(self, pose):
        """Locations (T, J, 3) and quaternions (T, J, 4) of pose bones."""
        places = np.empty((*pose.shape[:2], 3))
        wxyz = np.empty((*pose.shape[:2], 4))
        for bone, parent in enumerate(self.parents):
            basis = np.linalg.inv(self.rest[bone])
            if parent >= 0:
                basis = basis @ self.rest[parent] @ np.linalg.inv(pose[:, parent])
            basis = basis @ pose[:, bone]
            places[:, bone] = basis[:, :3, 3]
            wxyz[:, bone] = quaternions(basis[:, :3, :3])
        return places, wxyz

    def show(self, pose):
        """One frame (1, J, 4, 4), at once."""
        places, wxyz = self.channels(pose)
        for bone, name in enumerate(self.names):
            posed = self.object.pose.bones[name]
            posed.location = places[0, bone]
            posed.rotation_quaternion = wxyz[0, bone]

    def bake(self, frames, pose):
        """An action with a key for each of `frames` (T,)."""
        places, wxyz = self.channels(pose)
        told = {}
        for bone, name in enumerate(self.names):
            told[name] = {"rotation_quaternion": wxyz[:, bone]}
            if np.abs(places[:, bone]).max() > 1e-5:
                told[name]["location"] = places[:, bone]
        bake_channels(self.object, f"{self.name} take", frames, told)


def bake_channels(owner, label, frames, told):
    """A new action on an armature: values (T, 3 or 4) by channels by names of pose bones."""
    curves = _new_curves(owner, label)
    for name, channels in told.items():
        path = f'pose.bones["{bpy.utils.escape_identifier(name)}"]'
        for channel, values in channels.items():
            for axis, column in enumerate(values.T):
                _fill(curves.new(f"{path}.{channel}", index=axis), frames, column)


def _new_curves(owner, name):
    """The curves of a new action on an object, before and since actions have slots."""
    action = bpy.data.actions.new(name)
    owner.animation_data_create().action = action
    if not hasattr(action, "slots"):
        return action.fcurves
    slot = action.slots.new(id_type="OBJECT", name=owner.name)
    owner.animation_data.action_slot = slot
    strip = action.layers.new("take").strips.new(type="KEYFRAME")
    return strip.channelbag(slot, ensure=True).fcurves


def _fill(curve, frames, values):
    points = curve.keyframe_points
    points.add(len(frames))
    points.foreach_set("co", np.stack([frames, values], axis=1).astype(np.float32).ravel())
    linear = bpy.types.Keyframe.bl_rna.properties["interpolation"].enum_items["LINEAR"].value
    points.foreach_set("interpolation", np.full(len(frames), linear, dtype=np.int32))
    curve.update()


def matrices(wxyz):
    """Rotations (..., 3, 3) of quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quaternions(turns):
    """w, x, y, z; neighbours are near, so that curves do not jump."""
    from mathutils import Matrix

    found = np.array([tuple(Matrix(m.tolist()).to_quaternion()) for m in turns])
    flips = np.einsum("ti,ti->t", found[1:], found[:-1]) < 0
    signs = np.where(np.logical_xor.accumulate(np.concatenate([[False], flips])), -1.0, 1.0)
    return found * signs[:, None]
