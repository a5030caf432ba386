"""fusecap in Blender: takes as armatures with actions, people of a live stream."""

import math

import bpy
import numpy as np
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from .live import Client
from .retarget import Follower, baked_motion
from .skeleton import Person
from .take_file import import_take


def scene_rate_hz():
    render = bpy.context.scene.render
    return render.fps / render.fps_base


class IMPORT_OT_fusecap_take(bpy.types.Operator, ImportHelper):
    """Import a take of fusecap: an armature with an action per person"""

    bl_idname = "import_anim.fusecap_take"
    bl_label = "Import fusecap take"
    bl_options = {"REGISTER", "UNDO"}
    filename_ext = ".npz"
    filter_glob: StringProperty(default="*.npz", options={"HIDDEN"})

    def execute(self, context):
        try:
            _, length_s = import_take(self.filepath, scene_rate_hz())
        except (OSError, ValueError, KeyError) as error:
            self.report({"ERROR"}, f"{self.filepath}: {error}")
            return {"CANCELLED"}
        last = 1 + math.ceil(length_s * scene_rate_hz())
        context.scene.frame_end = max(context.scene.frame_end, last)
        return {"FINISHED"}


class Live:
    """People of a stream while it lasts."""

    def __init__(self, address):
        self.client = Client(address)
        self.people = {}
        self.recorded = {}
        self.followers = {}
        """Characters by the names of people whose motion they have."""

    def tick(self, recording):
        """Takes what has come; how long to wait for the next call, None at the end."""
        cast, frames = self.client.news(all_frames=recording)
        if cast is not None:
            self.set_cast(cast)
        for frame in frames:
            for name, pose in frame["people"].items():
                if recording and name in self.people:
                    kept = (frame["time_s"], pose["position_m"], pose["rotation_wxyz"])
                    self.recorded.setdefault(name, []).append(kept)
        for name, pose in frames[-1]["people"].items() if frames else ():
            if name in self.people:
                shown = self._poses(name, [pose["position_m"]], [pose["rotation_wxyz"]])
                self.people[name].show(shown)
                for follower in self.followers.get(name, ()):
                    follower.show(shown)
        return None if self.client.ended and not frames else 1 / 60

    def set_cast(self, cast):
        for person in cast["people"]:
            known = self.people.get(person["name"])
            if known is None or not np.allclose(known.told, person["offsets_m"]):
                made = Person(
                    person["name"],
                    person["bones"],
                    person["parents"],
                    person["offsets_m"],
                    person["height_m"],
                )
                made.told = np.array(person["offsets_m"])
                self.people[person["name"]] = made
                self.followers[person["name"]] = [
                    Follower(each.object, made.names, made.rest, each.by_hand)
                    for each in self.followers.get(person["name"], ())
                ]

    def follow(self, armature, character, by_hand):
        """Puts a character in the place of its follower of earlier."""
        person = next(p for p in self.people.values() if p.object == armature)
        follower = Follower(character, person.names, person.rest, by_hand)
        for others in self.followers.values():
            others[:] = [each for each in others if each.object != character]
        self.followers.setdefault(person.name, []).append(follower)
        return follower

    def shows(self, armature):
        return any(person.object == armature for person in self.people.values())

    def _poses(self, name, places, turns):
        return self.people[name].poses(np.array(places), np.array(turns))

    def bake(self):
        """What was recorded as actions; the number of people."""
        for name, frames in self.recorded.items():
            times = np.array([time for time, _, _ in frames])
            kept = np.concatenate([[True], np.diff(times) > 0])
            at = 1 + (times[kept] - times[0]) * scene_rate_hz()
            _, places, turns = (list(column) for column in zip(*frames, strict=True))
            poses = self._poses(name, places, turns)[kept]
            self.people[name].bake(at, poses)
            for follower in self.followers.get(name, ()):
                follower.bake(at, poses, f"{name} on {follower.object.name}")
        count, self.recorded = len(self.recorded), {}
        return count


_live = None


def _timer():
    if _live is None:
        return None
    return _live.tick(bpy.context.scene.fusecap_record)


def _end():
    """Closes the stream; what was live."""
    global _live
    ended, _live = _live, None
    if bpy.app.timers.is_registered(_timer):
        bpy.app.timers.unregister(_timer)
    ended.client.close()
    return ended


class SCENE_OT_fusecap_connect(bpy.types.Operator):
    """Show the people of fusecap's WebSocket stream (fusecap live ... --to ws)"""

    bl_idname = "scene.fusecap_connect"
    bl_label = "Connect"

    def execute(self, context):
        global _live
        if _live is not None:
            _end()
        try:
            _live = Live(context.scene.fusecap_address)
        except OSError as error:
            self.report({"ERROR"}, f"nothing from {context.scene.fusecap_address}: {error}")
            return {"CANCELLED"}
        bpy.app.timers.register(_timer)
        return {"FINISHED"}


class SCENE_OT_fusecap_disconnect(bpy.types.Operator):
    """End the stream; what was recorded becomes actions"""

    bl_idname = "scene.fusecap_disconnect"
    bl_label = "Disconnect and bake"

    @classmethod
    def poll(cls, context):
        return _live is not None

    def execute(self, context):
        ended = _end()
        ended.tick(context.scene.fusecap_record)
        self.report({"INFO"}, f"{ended.bake()} people were recorded")
        return {"FINISHED"}


class OBJECT_OT_fusecap_retarget(bpy.types.Operator):
    """Put a person's motion onto the active armature: select the person, then the character"""

    bl_idname = "object.fusecap_retarget"
    bl_label = "Retarget to active"
    bl_options = {"REGISTER", "UNDO"}
    bones: StringProperty(
        name="Bones", description="Where names are not guessed: left_thigh=Bone_17, ..."
    )

    @classmethod
    def poll(cls, context):
        return _person_and_character(context) is not None

    def execute(self, context):
        person, character = _person_and_character(context)
        context.view_layer.update()  # else what was moved a moment ago stands where it was
        try:
            by_hand = _pairs(self.bones)
            if _live is not None and _live.shows(person):
                follower = _live.follow(person, character, by_hand)
            else:
                frames, names, rest, pose = baked_motion(person)
                follower = Follower(character, names, rest, by_hand)
                follower.bake(frames, pose, f"{person.name} on {character.name}")
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if follower.held:
            held = ", ".join(follower.held)
            self.report({"WARNING"}, f"constraints hold {held}: mute them, or take another rig")
        pairs = ", ".join(f"{b} {follower.names[n]}" for b, n in follower.bones.items())
        self.report({"INFO"}, f"{person.name}, scaled by {follower.scale:.3f}: {pairs}")
        return {"FINISHED"}


def _person_and_character(context):
    """The other selected armature and the active one."""
    others = [o for o in context.selected_objects if o.type == "ARMATURE" and o != context.object]
    active = context.object
    if active is None or active.type != "ARMATURE" or len(others) != 1:
        return None
    return others[0], active


def _pairs(text):
    pairs = {}
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        bone, equals, name = part.partition("=")
        if not (bone and equals and name):
            raise ValueError(f"'{part}': expected BONE=NAME")
        pairs[bone.strip()] = name.strip()
    return pairs


class VIEW3D_PT_fusecap(bpy.types.Panel):
    bl_label = "fusecap"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "fusecap"

    def draw(self, context):
        layout = self.layout
        layout.operator(IMPORT_OT_fusecap_take.bl_idname)
        layout.prop(context.scene, "fusecap_address")
        layout.prop(context.scene, "fusecap_record")
        layout.operator(SCENE_OT_fusecap_connect.bl_idname)
        layout.operator(SCENE_OT_fusecap_disconnect.bl_idname)
        layout.operator(OBJECT_OT_fusecap_retarget.bl_idname)


def _menu(self, _):
    self.layout.operator(IMPORT_OT_fusecap_take.bl_idname, text="fusecap take (.npz)")


_CLASSES = (
    IMPORT_OT_fusecap_take,
    SCENE_OT_fusecap_connect,
    SCENE_OT_fusecap_disconnect,
    OBJECT_OT_fusecap_retarget,
    VIEW3D_PT_fusecap,
)


def register():
    for one in _CLASSES:
        bpy.utils.register_class(one)
    bpy.types.Scene.fusecap_address = StringProperty(
        name="Stream", default="ws://127.0.0.1:8765", description="Where fusecap serves people"
    )
    bpy.types.Scene.fusecap_record = BoolProperty(
        name="Record", default=False, description="Keep frames, to bake when the stream ends"
    )
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister():
    if _live is not None:
        _end()
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    del bpy.types.Scene.fusecap_address, bpy.types.Scene.fusecap_record
    for one in reversed(_CLASSES):
        bpy.utils.unregister_class(one)
