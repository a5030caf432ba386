"""Virtual Motion Capture protocol 3.1, as a performer sends it to a marionette [1].

    /VMC/Ext/T f            /VMC/Ext/OK i i i i       /VMC/Ext/Root/Pos s fff ffff
    /VMC/Ext/Bone/Pos s fff ffff      local to the parent, metres, quaternion xyzw, Unity's axes

The stream of a port is one avatar. The root stands at the world's origin; the hips carry the
person through the room. Bones have the names of Unity's `HumanBodyBones`. Unity's spine has three
bones and ours four: the second (`spine1`) is left out of the tree, so that `Chest` turns as spine1
and spine2 do together and everything above keeps its place in the world.

[1] https://protocol.vmc.info, marionette specification
"""

from __future__ import annotations

from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import EXTENDED23
from fusecap.geometry.quaternions import to_xyzw
from fusecap.streams.axes import UNITY
from fusecap.streams.osc_packets import bundles, message
from fusecap.streams.person_pose import (
    PersonPose,
    in_parents,
)

DEFAULT_PORT = 39539
PORT_STEP = 10
"""From one person's port to the next one's."""

_LOADED, _CALIBRATED, _NORMAL_MODE = 1, 3, 0

_TREE = {
    "Hips": ("hips", ""),
    "Spine": ("spine", "Hips"),
    "Chest": ("spine2", "Spine"),
    "UpperChest": ("spine3", "Chest"),
    "Neck": ("neck", "UpperChest"),
    "Head": ("head", "Neck"),
}
for _side, _Side in (("left", "Left"), ("right", "Right")):
    _TREE |= {
        f"{_Side}Shoulder": (f"{_side}_clavicle", "UpperChest"),
        f"{_Side}UpperArm": (f"{_side}_upper_arm", f"{_Side}Shoulder"),
        f"{_Side}LowerArm": (f"{_side}_forearm", f"{_Side}UpperArm"),
        f"{_Side}Hand": (f"{_side}_hand", f"{_Side}LowerArm"),
        f"{_Side}UpperLeg": (f"{_side}_thigh", "Hips"),
        f"{_Side}LowerLeg": (f"{_side}_shank", f"{_Side}UpperLeg"),
        f"{_Side}Foot": (f"{_side}_foot", f"{_Side}LowerLeg"),
        f"{_Side}Toes": (f"{_side}_toes", f"{_Side}Foot"),
    }
_NAMES = tuple(_TREE)
_BONES = [EXTENDED23.bone(bone) for bone, _ in _TREE.values()]
_PARENTS = tuple(_NAMES.index(parent) if parent else -1 for _, parent in _TREE.values())


def vmc_datagrams(pose: PersonPose | None, time_s: float) -> list[bytes]:
    """One instant of one person; without a pose only that it is not tracked."""
    tracking = int(pose is not None)
    messages = [
        message("/VMC/Ext/T", float(time_s)),
        message("/VMC/Ext/OK", _LOADED, _CALIBRATED, _NORMAL_MODE, tracking),
    ]
    if pose is not None:
        messages.append(message("/VMC/Ext/Root/Pos", "root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        messages += _bones(pose.extended)
    return bundles(messages)


def _bones(pose: PersonPose) -> list[bytes]:
    position_m, rotation = in_parents(
        _PARENTS, pose.bone_position_in_world_m[_BONES], pose.bone_rotation_in_world[_BONES]
    )
    positions = UNITY.positions(position_m).tolist()
    quaternions = to_xyzw(Rotation.from_matrix(UNITY.rotations(rotation))).tolist()
    return [
        message("/VMC/Ext/Bone/Pos", name, *xyz, *xyzw)
        for name, xyz, xyzw in zip(_NAMES, positions, quaternions, strict=True)
    ]
