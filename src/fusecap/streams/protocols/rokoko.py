"""Rokoko Studio's live stream, JSON v3, plain text [1].

    {"version": 3, "fps": 60, "scene": {"timestamp": s, "actors": [{"name": .., "meta": {..},
     "dimensions": {"totalHeight": m, "hipHeight": m},
     "body": {"hip": {"position": {x, y, z}, "rotation": {x, y, z, w}}, ...}}], "props": []}}

Positions [m] and rotations are in the world, in Unity's axes. A bone's rotation is not zero in the
T-pose: Studio's reference actor has its own bone axes, and receivers divide by them [2]. So what is
sent is the bone's turn from the T-pose times that reference, a left upper arm at rest
(-0.5, -0.5, 0.5, -0.5). Studio's spine has two bones: `spine` turns as our spine1, `chest` as
spine3.

Studio can also compress with LZ4; this does not, and receivers that read nothing else stay still.

[1] https://support.rokoko.com/hc/en-us/article_attachments/41280345093777 (the layout);
    JsonLiveSerializerV3.cs and live_data_manager.py of Rokoko's plugins for Unity and Blender
[2] `SmartsuitTPose` in Actor.cs (Unity), `actor_bones` in animation_lists.py (Blender)
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import EXTENDED23
from fusecap.geometry.quaternions import to_xyzw
from fusecap.streams.axes import UNITY
from fusecap.streams.person_pose import (
    PersonPose,
    StreamFrame,
)
from fusecap.streams.stream import udp_protocol

_H = np.sqrt(0.5)
_UPRIGHT = (0.0, 0.0, 1.0, 0.0)
_LEFT_ARM, _RIGHT_ARM = (-0.5, -0.5, 0.5, -0.5), (0.5, -0.5, 0.5, 0.5)
_LEFT_LEG, _RIGHT_LEG = (0.0, _H, 0.0, _H), (0.0, -_H, 0.0, _H)
_LEFT_FOOT, _RIGHT_FOOT = (0.0, _H, -_H, 0.0), (0.0, -_H, _H, 0.0)

_ACTOR = {
    "hip": ("hips", (0.0, 0.0, 0.0, 1.0)),
    "spine": ("spine1", _UPRIGHT),
    "chest": ("spine3", _UPRIGHT),
    "neck": ("neck", _UPRIGHT),
    "head": ("head", _UPRIGHT),
    "leftShoulder": ("left_clavicle", (0.0, 0.0, _H, -_H)),
    "leftUpperArm": ("left_upper_arm", _LEFT_ARM),
    "leftLowerArm": ("left_forearm", _LEFT_ARM),
    "leftHand": ("left_hand", _LEFT_ARM),
    "rightShoulder": ("right_clavicle", (0.0, 0.0, _H, _H)),
    "rightUpperArm": ("right_upper_arm", _RIGHT_ARM),
    "rightLowerArm": ("right_forearm", _RIGHT_ARM),
    "rightHand": ("right_hand", _RIGHT_ARM),
    "leftUpLeg": ("left_thigh", _LEFT_LEG),
    "leftLeg": ("left_shank", _LEFT_LEG),
    "leftFoot": ("left_foot", _LEFT_FOOT),
    "leftToe": ("left_toes", _LEFT_FOOT),
    "rightUpLeg": ("right_thigh", _RIGHT_LEG),
    "rightLeg": ("right_shank", _RIGHT_LEG),
    "rightFoot": ("right_foot", _RIGHT_FOOT),
    "rightToe": ("right_toes", _RIGHT_FOOT),
}
"""Of Studio's bone: ours, and its rotation (xyzw) in the reference T-pose."""
_BONES = [EXTENDED23.bone(bone) for bone, _ in _ACTOR.values()]
_REFERENCE = Rotation.from_quat([xyzw for _, xyzw in _ACTOR.values()]).as_matrix()
_META = {
    "hasGloves": False,
    "hasLeftGlove": False,
    "hasRightGlove": False,
    "hasBody": True,
    "hasFace": False,
}
_COLOURS = ((230, 90, 60), (60, 140, 230), (80, 190, 90), (220, 180, 50), (160, 90, 200))


def rokoko_datagrams(frame: StreamFrame, rate_hz: float) -> list[bytes]:
    """Everyone tracked, in one datagram: a receiver takes who is missing from it for gone."""
    order = list(frame.people)
    scene = {
        "timestamp": round(frame.time_s, 6),
        "actors": [
            _actor(pose.extended, _COLOURS[order.index(pose.name) % len(_COLOURS)])
            for pose in frame.tracked
        ],
        "characters": [],
        "props": [],
    }
    packet = {"version": 3, "fps": rate_hz, "scene": scene}
    return [json.dumps(packet, separators=(",", ":")).encode("ascii")]


def _actor(pose: PersonPose, colour: tuple[int, int, int]) -> dict[str, Any]:
    rotation = UNITY.rotations(pose.bone_rotation_in_world[_BONES]) @ _REFERENCE
    positions = np.round(UNITY.positions(pose.bone_position_in_world_m[_BONES]), 5).tolist()
    quaternions = np.round(to_xyzw(Rotation.from_matrix(rotation)), 6).tolist()
    return {
        "name": pose.name,
        "color": colour,
        "meta": _META,
        "dimensions": {
            "totalHeight": round(pose.shape.height_m, 4),
            "hipHeight": round(pose.shape.standing_root_height_m, 4),
        },
        "body": {
            name: {
                "position": dict(zip("xyz", xyz, strict=True)),
                "rotation": dict(zip("xyzw", xyzw, strict=True)),
            }
            for name, xyz, xyzw in zip(_ACTOR, positions, quaternions, strict=True)
        },
    }


PROTOCOL = udp_protocol(rokoko_datagrams, port=14043)
