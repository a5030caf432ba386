"""Motion of the CMU database on our skeletons.

Joints are matched by name, bones by their rotation in the world, so bone lengths play no part in
the pose. The source's rest pose differs from ours only in the legs, which it splays by 20 degrees:
each leg bone is turned so that our straight-down rest direction falls on its own; foot and toes
turn with the shank, which keeps the sole flat. Neck and head stand upright where the database's
lean by its neutral angles. The four bones of our spine share the source's three rotations evenly;
the forearm carries the wrist's pronation.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.pose import forward_kinematics, theta_from_rotations
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import InputError
from fusecap.motion.motion import Motion

_BVH_NAMES = {
    "Hips": "root",
    "LowerBack": "lowerback",
    "Spine": "upperback",
    "Spine1": "thorax",
    "Neck": "lowerneck",
    "Neck1": "upperneck",
    "Head": "head",
} | {
    f"{bvh_side}{bvh}": f"{side}{asf}"
    for bvh_side, side in (("Left", "l"), ("Right", "r"))
    for bvh, asf in (
        ("Shoulder", "clavicle"),
        ("Arm", "humerus"),
        ("ForeArm", "radius"),
        ("Hand", "wrist"),
        ("FingerBase", "hand"),
        ("UpLeg", "femur"),
        ("Leg", "tibia"),
        ("Foot", "foot"),
        ("ToeBase", "toes"),
    )
}
_BVH_NAMES |= {"LHipJoint": "lhipjoint", "RHipJoint": "rhipjoint"}

_TRUNK = ("root", "lowerback", "upperback", "thorax", "lowerneck", "upperneck", "head")
_ARM = ("clavicle", "humerus", "radius", "wrist", "hand")
_LEG = ("hipjoint", "femur", "tibia", "foot", "toes")
_NEEDED = (*_TRUNK, *(side + part for side in "lr" for part in (*_ARM, *_LEG)))

_NEUTRAL_PITCH_DEG = {"lowerneck": -16.0, "upperneck": 5.0, "head": 16.0}
"""Forward lean of a person who looks straight ahead: the rest pose that opens the database's BVH
files, and within a degree the median over its walks."""

_SOLE = (
    ("{side}_foot", (0.0, -0.039, -0.030)),
    ("{side}_toes", (0.0, -0.012, 0.0)),
    ("{side}_toes", (0.0, -0.012, 0.045)),
)
"""Heel, ball and tip of the sole in the bones' frames, as fractions of stature."""
_FLOOR_PERCENTILE = 2.0
"""Share of the frames, in percent, in which the lowest sole may dip below the floor."""


def retarget(motion: Motion, skeleton: Skeleton) -> Float[np.ndarray, "t p"]:
    """`motion` as `theta` of a person of 1.75 m whose soles reach the floor at y = 0.

    Raises `InputError` naming the joints that `motion` lacks.
    """
    shape = BodyShape.from_height(skeleton, REFERENCE_HEIGHT_M)
    joints = _joints(motion)
    rotation = _bone_rotations(motion, skeleton, joints)

    vectors = motion.bone_vector_m
    theirs = sum(float(np.linalg.norm(vectors[joints[name]])) for name in ("lfemur", "ltibia"))
    ours = sum(
        float(np.linalg.norm(shape.offsets_m[skeleton.bone(name)]))
        for name in ("left_shank", "left_foot")
    )
    their_hips = (vectors[joints["lhipjoint"]] + vectors[joints["rhipjoint"]]) / 2
    our_hips = shape.offsets_m[[skeleton.bone("left_thigh"), skeleton.bone("right_thigh")]].mean(0)
    hip_centre_m = motion.root_position_m + rotation[:, 0] @ their_hips
    root_m = hip_centre_m * (ours / theirs) - rotation[:, 0] @ our_hips

    theta = theta_from_rotations(skeleton.parents, root_m, rotation)
    theta[:, 1] -= np.percentile(sole_heights_m(shape, theta).min(axis=1), _FLOOR_PERCENTILE)
    return theta


def sole_heights_m(shape: BodyShape, theta: Float[np.ndarray, "t p"]) -> Float[np.ndarray, "t 6"]:
    """Heights over the floor of heel, ball and tip of the left, then the right sole."""
    position, rotation = forward_kinematics(shape, theta)
    heights = []
    for side in ("left", "right"):
        for bone_name, offset in _SOLE:
            bone = shape.skeleton.bone(bone_name.format(side=side))
            point = position[:, bone] + rotation[:, bone] @ (np.array(offset) * shape.height_m)
            heights.append(point[:, 1])
    return np.stack(heights, axis=1)


def _joints(motion: Motion) -> dict[str, int]:
    """ASF bone name to joint of `motion`."""
    joints = {_BVH_NAMES.get(name, name): i for i, name in enumerate(motion.joint_names)}
    missing = [name for name in _NEEDED if name not in joints]
    if missing:
        unknown = [n for n in motion.joint_names if _BVH_NAMES.get(n, n) not in _NEEDED]
        raise InputError(
            f"{motion.name}: no joint for {', '.join(missing)}; joints of unknown meaning: "
            f"{', '.join(unknown) or 'none'}; expected the names of the CMU database (ASF) or of "
            "its BVH conversion (Hips, LowerBack, LeftUpLeg, ...)"
        )
    return joints


def _bone_rotations(
    motion: Motion, skeleton: Skeleton, joints: dict[str, int]
) -> Float[np.ndarray, "t b 3 3"]:
    def source(name: str) -> Float[np.ndarray, "t 3 3"]:
        rotation = motion.rotation_in_world[:, joints[name]]
        upright = Rotation.from_euler("x", -_NEUTRAL_PITCH_DEG.get(name, 0.0), degrees=True)
        return rotation @ upright.as_matrix()

    bones = {
        "hips": source("root"),
        "spine": _between(source("root"), source("lowerback"), 0.75),
        "spine1": _between(source("lowerback"), source("upperback"), 0.5),
        "spine2": _between(source("upperback"), source("thorax"), 0.25),
        "spine3": source("thorax"),
        "neck": _between(source("lowerneck"), source("upperneck"), 0.5),
        "head": source("head"),
    }
    for side in ("left", "right"):
        s = side[0]
        femur = _from_straight_down(motion, joints[f"{s}femur"])
        tibia = _from_straight_down(motion, joints[f"{s}tibia"])
        bones |= {
            f"{side}_clavicle": source(f"{s}clavicle"),
            f"{side}_upper_arm": source(f"{s}humerus"),
            f"{side}_forearm": source(f"{s}wrist"),
            f"{side}_hand": source(f"{s}hand"),
            f"{side}_thigh": source(f"{s}femur") @ femur,
            f"{side}_shank": source(f"{s}tibia") @ tibia,
            f"{side}_foot": source(f"{s}foot") @ tibia,
            f"{side}_toes": source(f"{s}toes") @ tibia,
        }
    return np.stack([bones[name] for name in skeleton.bone_names], axis=1)


def _between(
    a: Float[np.ndarray, "t 3 3"], b: Float[np.ndarray, "t 3 3"], share: float
) -> Float[np.ndarray, "t 3 3"]:
    """The rotation a `share` of the way from `a` to `b`."""
    turn = Rotation.from_matrix(np.swapaxes(a, -1, -2) @ b).as_rotvec()
    return a @ Rotation.from_rotvec(share * turn).as_matrix()


def _from_straight_down(motion: Motion, joint: int) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes straight down to the joint's rest direction."""
    vector = motion.bone_vector_m[joint]
    length = float(np.linalg.norm(vector))
    if length == 0.0 or vector[1] >= 0.0:
        raise InputError(
            f"{motion.name}: '{motion.joint_names[joint]}' does not point down in the rest pose"
        )
    down = np.array([0.0, -1.0, 0.0])
    axis = np.cross(down, vector / length)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arcsin(min(sine, 1.0))).as_matrix()
