"""Rigs: the joints that other programs' characters have, by preset; exports and streams use them.

A preset says what its joints are called, which of our bones each turns with, where it sits, how the
character stands at rest and how the joints' axes lie there. What was solved does not change: every
joint of a rig that is also one of ours is where the take has it, in every frame.

    native    our bones, and the bones that connect them: pelvis, clavicles
    mixamo    mixamorig:...; y along the bone              humanik   Hips, LeftUpLeg, ...
    unity     as Unity's humanoid avatar names them        vrm       as VRM 1.0 names them
    ue5       Manny's, his reference pose and axes too; root on the floor
    rokoko    Hips, Spine1, ..., LeftThigh                 xsens     MVN's segments

Skeletons with three spine bones get ours folded: the lowest turns halfway between our two lowest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fusecap.body.skeleton import EXTENDED23
from fusecap.errors import InputError, nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class RigJoint:
    """One joint of a preset; bones are those of `EXTENDED23`."""

    name: str
    parent: str
    """Of the same preset; "" for the root."""
    turns_with: tuple[str, ...]
    """A bone, or two that it turns halfway between; none for a joint that never moves."""
    sits_at: str
    """The bone whose joint is at the same place at rest."""
    towards: tuple[str, float] | None = None
    """Or that share of the way to another one."""


Direction = tuple[float, float, float]
_UP, _DOWN, _LEFT = (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)
_FORWARD, _BACK = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class JointAxes:
    """How a joint's axes lie in a T-pose; they turn with the limb to how it really rests."""

    along: str
    """The axis along the bone, "-x" against it."""
    not_along: Direction | None = None
    """Where that axis points instead."""
    second: str
    points: Direction
    """Where another axis points, as nearly as the first allows."""


@dataclass(frozen=True, kw_only=True)
class RigPreset:
    """What a receiving program calls joints, and how its character stands at rest."""

    name: str
    about: str
    joints: tuple[RigJoint, ...]
    axes: Mapping[str, JointAxes] = field(default_factory=dict)
    """By our bones without their side, "root" for what never moves, "" for others.

    All axes are the world's where it is empty.
    """
    holder: str = ""
    """What its program wants the node above the root called in FBX; "" for the person's name."""
    mirrored: bool = False
    """Whether axes of the right side point against the mirror image of the left one's."""
    rest_deg: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    """Angle-axis vectors of bones at rest [deg], local; a T-pose without."""

    @property
    def name_at(self) -> dict[str, str]:
        """Names of joints by our bones that have the same place and turn them."""
        ours = (j for j in self.joints if j.turns_with[:1] == (j.sits_at,) and j.towards is None)
        return {joint.sits_at: joint.name for joint in ours}


def rig_preset(name: str) -> RigPreset:
    """The preset called `name`; raises `InputError` naming the known ones."""
    if name not in PRESETS:
        raise InputError(f"no rig '{name}'{nearest(name, PRESETS)}")
    return PRESETS[name]


_SIDES = (("left", "Left", "l"), ("right", "Right", "r"))


def _joint(name: str, parent: str, bone: str, *, also: str = "") -> RigJoint:
    return RigJoint(
        name=name, parent=parent, turns_with=(bone, also) if also else (bone,), sits_at=bone
    )


def _native() -> tuple[RigJoint, ...]:
    joints: list[RigJoint] = []
    for bone, parent in zip(EXTENDED23.bone_names, EXTENDED23.parents, strict=True):
        above = EXTENDED23.bone_names[parent] if parent >= 0 else ""
        if bone.endswith("_thigh"):
            above = bone.replace("thigh", "pelvis")
            joints.append(
                RigJoint(name=above, parent="hips", turns_with=("hips",), sits_at="spine")
            )
        joints.append(_joint(bone, above, bone))
    return tuple(joints)


def _limbs(
    hips: str, chest: str, arm: tuple[str, str, str, str], leg: tuple[str, str, str, str]
) -> list[RigJoint]:
    """Names hold {Side} (Left), {side} (left) or {s} (l)."""
    joints: list[RigJoint] = []
    for bones, names, above in (
        (("clavicle", "upper_arm", "forearm", "hand"), arm, chest),
        (("thigh", "shank", "foot", "toes"), leg, hips),
    ):
        for side, big, short in _SIDES:
            parent = above
            for bone, pattern in zip(bones, names, strict=True):
                name = pattern.format(Side=big, side=side, s=short)
                joints.append(_joint(name, parent, f"{side}_{bone}"))
                parent = name
    return joints


def _three_spines(
    hips: str,
    spines: tuple[str, str, str],
    neck: str,
    head: str,
    arm: tuple[str, str, str, str],
    leg: tuple[str, str, str, str],
) -> tuple[RigJoint, ...]:
    low, middle, high = spines
    return (
        _joint(hips, "", "hips"),
        _joint(low, hips, "spine", also="spine1"),
        _joint(middle, low, "spine2"),
        _joint(high, middle, "spine3"),
        _joint(neck, high, "neck"),
        _joint(head, neck, "head"),
        *_limbs(hips, high, arm, leg),
    )


def _four_spines(
    hips: str,
    spines: tuple[str, str, str, str],
    neck: str,
    head: str,
    arm: tuple[str, str, str, str],
    leg: tuple[str, str, str, str],
) -> tuple[RigJoint, ...]:
    above, joints = hips, [_joint(hips, "", "hips")]
    names = (*spines, neck, head)
    for name, bone in zip(names, EXTENDED23.bone_names[1:7], strict=True):
        joints.append(_joint(name, above, bone))
        above = name
    return (*joints, *_limbs(hips, spines[-1], arm, leg))


_HUMANIK_ARM = ("{Side}Shoulder", "{Side}Arm", "{Side}ForeArm", "{Side}Hand")
_HUMANIK_LEG = ("{Side}UpLeg", "{Side}Leg", "{Side}Foot", "{Side}ToeBase")
_HUMANIK = _three_spines(
    "Hips", ("Spine", "Spine1", "Spine2"), "Neck", "Head", _HUMANIK_ARM, _HUMANIK_LEG
)


def _prefixed(prefix: str, joints: tuple[RigJoint, ...]) -> tuple[RigJoint, ...]:
    return tuple(
        RigJoint(
            name=prefix + joint.name,
            parent=prefix + joint.parent if joint.parent else "",
            turns_with=joint.turns_with,
            sits_at=joint.sits_at,
        )
        for joint in joints
    )


def _manny() -> tuple[RigJoint, ...]:
    arm = ("clavicle_{s}", "upperarm_{s}", "lowerarm_{s}", "hand_{s}")
    leg = ("thigh_{s}", "calf_{s}", "foot_{s}", "ball_{s}")
    return (
        RigJoint(name="root", parent="", turns_with=(), sits_at=""),
        _joint("pelvis", "root", "hips"),
        _joint("spine_01", "pelvis", "spine"),
        _joint("spine_02", "spine_01", "spine1"),
        _joint("spine_03", "spine_02", "spine2"),
        _joint("spine_04", "spine_03", "spine3"),
        RigJoint(
            name="spine_05",
            parent="spine_04",
            turns_with=("spine3",),
            sits_at="spine3",
            towards=("neck", 0.5),
        ),
        _joint("neck_01", "spine_05", "neck"),
        RigJoint(
            name="neck_02",
            parent="neck_01",
            turns_with=("neck",),
            sits_at="neck",
            towards=("head", 0.5),
        ),
        _joint("head", "neck_02", "head"),
        *_limbs("pelvis", "spine_05", arm, leg),
    )


_MIXAMO_AXES = {
    "": JointAxes(along="y", second="z", points=_FORWARD),
    "foot": JointAxes(along="y", second="z", points=_UP),
    "toes": JointAxes(along="y", second="z", points=_UP),
}
_MANNY_AXES = {
    "root": JointAxes(along="x", not_along=_LEFT, second="z", points=_UP),
    "": JointAxes(along="x", second="y", points=_BACK),
    "hand": JointAxes(along="x", second="y", points=_DOWN),
    "thigh": JointAxes(along="-x", second="y", points=_BACK),
    "shank": JointAxes(along="-x", second="y", points=_BACK),
    "foot": JointAxes(along="x", not_along=_UP, second="y", points=_BACK),
    "toes": JointAxes(along="x", second="y", points=_UP),
}
_MANNY_RESTS_DEG = {
    "upper_arm": (13.4, 6.2, -41.4),
    "forearm": (4.5, -28.4, -1.1),
    "hand": (-0.9, 3.8, -12.1),
    "thigh": (0.3, 0.0, 6.6),
    "shank": (4.5, 0.0, -1.8),
    "foot": (-4.58, 4.83, -5.01),
}
"""Of the left side, from the published local rotations of Unreal's skeleton; soles level."""
_UNITY_ARM = ("{Side}Shoulder", "{Side}UpperArm", "{Side}LowerArm", "{Side}Hand")
_UNITY_LEG = ("{Side}UpperLeg", "{Side}LowerLeg", "{Side}Foot", "{Side}Toes")
_VRM_ARM = ("{side}Shoulder", "{side}UpperArm", "{side}LowerArm", "{side}Hand")
_VRM_LEG = ("{side}UpperLeg", "{side}LowerLeg", "{side}Foot", "{side}Toes")
_MVN_ARM = ("{Side}Shoulder", "{Side}UpperArm", "{Side}ForeArm", "{Side}Hand")
_MVN_LEG = ("{Side}UpperLeg", "{Side}LowerLeg", "{Side}Foot", "{Side}Toe")

PRESETS = {
    preset.name: preset
    for preset in (
        RigPreset(name="native", about="our bones, connected", joints=_native()),
        RigPreset(
            name="mixamo",
            about="Mixamo's characters and the tools made for them",
            joints=_prefixed("mixamorig:", _HUMANIK),
            axes=_MIXAMO_AXES,
        ),
        RigPreset(
            name="ue5",
            about="Unreal's Manny",
            holder="Armature",
            joints=_manny(),
            axes=_MANNY_AXES,
            mirrored=True,
            rest_deg={
                f"{side}_{bone}": (x, sign * y, sign * z)
                for side, sign in (("left", 1.0), ("right", -1.0))
                for bone, (x, y, z) in _MANNY_RESTS_DEG.items()
            },
        ),
        RigPreset(
            name="unity",
            about="Unity's humanoid avatar",
            joints=_three_spines(
                "Hips", ("Spine", "Chest", "UpperChest"), "Neck", "Head", _UNITY_ARM, _UNITY_LEG
            ),
        ),
        RigPreset(name="humanik", about="MotionBuilder and Maya", joints=_HUMANIK),
        RigPreset(
            name="vrm",
            about="VRM 1.0 avatars",
            joints=_three_spines(
                "hips", ("spine", "chest", "upperChest"), "neck", "head", _VRM_ARM, _VRM_LEG
            ),
        ),
        RigPreset(
            name="rokoko",
            about="Rokoko Studio",
            joints=_four_spines(
                "Hips",
                ("Spine1", "Spine2", "Spine3", "Spine4"),
                "Neck",
                "Head",
                _HUMANIK_ARM,
                ("{Side}Thigh", "{Side}Shin", "{Side}Foot", "{Side}Toe"),
            ),
        ),
        RigPreset(
            name="xsens",
            about="the segments of Xsens MVN",
            joints=_four_spines(
                "Pelvis", ("L5", "L3", "T12", "T8"), "Neck", "Head", _MVN_ARM, _MVN_LEG
            ),
        ),
    )
}
"""By name; `fusecap export --rig`."""
