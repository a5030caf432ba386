"""fusecap in Blender: takes as armatures with actions, people of a live stream."""

import math

import bpy
import numpy as np
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from .live import Client
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
        if frames:
            for name, pose in frames[-1]["people"].items():
                if name in self.people:
                    self.people[name].show(
                        np.array(pose["position_m"]), np.array(pose["rotation_wxyz"])
                    )
        return None if self.client.ended and not frames else 1 / 60

    def set_cast(self, cast):
        for person in cast["people"]:
            known = self.people.get(person["name"])
            if known is None or not np.allclose(known.told, person["offsets_m"]):
                made = Person(
                    person["name"], person["bones"], person["parents"], person["offsets_m"]
                )
                made.told = np.array(person["offsets_m"])
                self.people[person["name"]] = made

    def bake(self):
        """What was recorded as actions; the number of people."""
        for name, frames in self.recorded.items():
            times = np.array([time for time, _, _ in frames])
            kept = np.concatenate([[True], np.diff(times) > 0])
            self.people[name].bake(
                1 + (times[kept] - times[0]) * scene_rate_hz(),
                np.array([place for _, place, _ in frames])[kept],
                np.array([turn for _, _, turn in frames])[kept],
            )
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


def _menu(self, _):
    self.layout.operator(IMPORT_OT_fusecap_take.bl_idname, text="fusecap take (.npz)")


_CLASSES = (
    IMPORT_OT_fusecap_take,
    SCENE_OT_fusecap_connect,
    SCENE_OT_fusecap_disconnect,
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
