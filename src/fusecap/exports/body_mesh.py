"""A plain body to look at: a person's mesh on a rig, with the weights that bend it.

Tubes of rings around the bones of the T-pose: trunk with neck, head with a nose, arms, legs, feet.
Radii are those of an adult of 1.75 m and grow with stature; lengths are the person's own. A ring
belongs to one bone, or to two where a joint bends. 1.2 k vertices a person.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import REFERENCE_HEIGHT_M, end_offsets_m
from fusecap.body.skeleton import EXTENDED23
from fusecap.exports.rest_rig import RestRig

_SIDES = 14
_CAP = 4
"""Rings of a rounded end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyMesh:
    """Vertices at the rig's rest, in the world [m]; triangles seen from outside."""

    vertices_m: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    joints: Int[np.ndarray, "v 2"]
    """Of the rig, that carry each vertex."""
    weights: Float[np.ndarray, "v 2"]
    """Of both, 1 together."""


@dataclass(frozen=True, slots=True)
class _Ring:
    centre: np.ndarray
    across: np.ndarray
    """Half axes; `across` x `over` points along the tube."""
    over: np.ndarray
    bones: tuple[str, str]
    share: float = 0.0
    """Of the second bone."""


def body_mesh(rest: RestRig) -> BodyMesh:
    """The body of the person that the rig stands for."""
    vertices, faces, bones, shares = _in_t_pose(rest)
    position, _ = forward_kinematics(rest.shape, np.zeros((1, EXTENDED23.pose_size)))
    joint_of = _joint_of_bones(rest)
    placed = np.zeros_like(vertices)
    rest_m = rest.bone_rest_positions_m
    for column, share in ((0, 1 - shares), (1, shares)):
        of = bones[:, column]
        turned = np.einsum("vij,vj->vi", rest.bone_rest[of], vertices - position[0, of])
        placed += share[:, None] * (rest_m[of] + turned)
    return BodyMesh(
        vertices_m=placed,
        normals=_normals(placed, faces),
        faces=faces,
        joints=joint_of[bones],
        weights=np.stack([1 - shares, shares], axis=1),
    )


def _joint_of_bones(rest: RestRig) -> Int[np.ndarray, " b"]:
    """For each of our bones the joint of the rig that turns with it."""
    found = np.zeros(EXTENDED23.bone_count, dtype=np.int64)
    for bone, name in enumerate(EXTENDED23.bone_names):
        with_bone = [
            index
            for index, joint in enumerate(rest.preset.joints)
            if name in joint.turns_with and not joint.towards
        ]
        own = [index for index in with_bone if rest.preset.joints[index].sits_at == name]
        found[bone] = (own or with_bone)[0]
    return found


def _in_t_pose(
    rest: RestRig,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces, the two bones of each vertex and the share of the second one."""
    theta = np.zeros((1, EXTENDED23.pose_size))
    position, _ = forward_kinematics(rest.shape, theta)
    at = dict(zip(EXTENDED23.bone_names, position[0], strict=True))
    size = rest.shape.height_m / REFERENCE_HEIGHT_M
    ends = {bone: at[bone] + end for bone, end in end_offsets_m(rest.shape).items()}
    tubes = [_trunk(at, size), _head(at, size), _nose(at, size)]
    for side in ("left", "right"):
        tubes += [_arm(at, ends, size, side), _leg(at, size, side), _foot(at, ends, size, side)]
    vertices, faces, bones, shares = [], [], [], []
    count = 0
    for tube in tubes:
        angle = np.linspace(0, 2 * np.pi, _SIDES, endpoint=False)
        for ring in tube:
            around = np.outer(np.cos(angle), ring.across) + np.outer(np.sin(angle), ring.over)
            vertices.append(ring.centre + around)
            bones += [[EXTENDED23.bone(name) for name in ring.bones]] * _SIDES
            shares += [ring.share] * _SIDES
        faces.append(count + _bands(len(tube)))
        count += len(tube) * _SIDES
    return np.concatenate(vertices), np.concatenate(faces), np.array(bones), np.array(shares)


def _trunk(at: Mapping[str, np.ndarray], size: float) -> list[_Ring]:
    """From below the hips to the neck; half widths and depths in metres."""
    low, top = at["hips"], at["head"]
    shoulder = at["left_upper_arm"][0] - low[0]
    hip = at["left_thigh"][0] - low[0] + 0.075 * size
    rows = (
        (low + [0, -0.115 * size, 0], 0.55 * hip, 0.085, "hips", "hips", 0.0),
        (low + [0, -0.06 * size, 0], hip, 0.110, "hips", "hips", 0.0),
        (low + [0, 0.02 * size, 0], 0.98 * hip, 0.112, "hips", "hips", 0.0),
        (at["spine"], 0.86 * hip, 0.098, "hips", "spine", 0.5),
        (at["spine1"], 0.84 * hip, 0.098, "spine", "spine1", 0.5),
        (at["spine2"], 0.92 * shoulder, 0.110, "spine1", "spine2", 0.5),
        (at["spine3"], 1.00 * shoulder, 0.115, "spine2", "spine3", 0.5),
        (at["spine3"] + [0, 0.06 * size, 0], 0.92 * shoulder, 0.100, "spine3", "spine3", 0.0),
        (at["neck"] + [0, -0.01 * size, 0], 0.45 * shoulder, 0.070, "spine3", "spine3", 0.0),
        (at["neck"] + [0, 0.02 * size, 0], 0.060 * size, 0.058, "spine3", "neck", 0.5),
        (top, 0.056 * size, 0.056, "neck", "head", 0.5),
    )
    rings = [
        _Ring(centre, _x(-width), _z(depth * size), (one, other), share)
        for centre, width, depth, one, other, share in rows
    ]
    return _rounded(rings)


def _head(at: Mapping[str, np.ndarray], size: float) -> list[_Ring]:
    centre = at["head"] + size * np.array([0.0, 0.085, 0.015])
    angles = np.linspace(-np.pi / 2, np.pi / 2, 11)
    return [
        _Ring(
            centre + [0, 0.118 * size * np.sin(a), 0],
            _x(-0.077 * size * np.cos(a)),
            _z(0.094 * size * np.cos(a)),
            ("head", "head"),
        )
        for a in angles
    ]


def _nose(at: Mapping[str, np.ndarray], size: float) -> list[_Ring]:
    """So that one sees where a head looks."""
    tip = at["head"] + size * np.array([0.0, 0.065, 0.130])
    return [
        _Ring(tip - [0, 0, back * size], _x(width * size), _y(width * size), ("head", "head"))
        for back, width in ((0.05, 0.018), (0.01, 0.014), (0.0, 0.0))
    ]


def _arm(
    at: Mapping[str, np.ndarray], ends: Mapping[str, np.ndarray], size: float, side: str
) -> list[_Ring]:
    upper, fore, hand = (f"{side}_{bone}" for bone in ("upper_arm", "forearm", "hand"))
    shoulder, elbow, wrist, tip = at[upper], at[fore], at[hand], ends[hand]
    rows = (
        (shoulder, 0.052, 0.056, upper, upper, 0.0),
        (_mix(shoulder, elbow, 0.35), 0.048, 0.048, upper, upper, 0.0),
        (_mix(shoulder, elbow, 0.92), 0.040, 0.040, upper, fore, 0.3),
        (_mix(elbow, wrist, 0.06), 0.040, 0.040, upper, fore, 0.7),
        (_mix(elbow, wrist, 0.30), 0.042, 0.039, fore, fore, 0.0),
        (_mix(elbow, wrist, 0.95), 0.028, 0.024, fore, hand, 0.4),
        (_mix(wrist, tip, 0.12), 0.032, 0.021, hand, hand, 0.0),
        (_mix(wrist, tip, 0.50), 0.042, 0.018, hand, hand, 0.0),
        (_mix(wrist, tip, 0.90), 0.032, 0.012, hand, hand, 0.0),
    )
    along = 1.0 if side == "left" else -1.0
    return _rounded(
        [
            _Ring(centre, _z(-along * wide * size), _y(thick * size), (one, other), share)
            for centre, wide, thick, one, other, share in rows
        ]
    )


def _leg(at: Mapping[str, np.ndarray], size: float, side: str) -> list[_Ring]:
    thigh, shank, foot = (f"{side}_{bone}" for bone in ("thigh", "shank", "foot"))
    hip, knee, ankle = at[thigh], at[shank], at[foot]
    rows = (
        (hip, 0.078, 0.086, thigh, thigh, 0.0),
        (_mix(hip, knee, 0.30), 0.075, 0.080, thigh, thigh, 0.0),
        (_mix(hip, knee, 0.90), 0.054, 0.056, thigh, shank, 0.3),
        (_mix(knee, ankle, 0.05), 0.052, 0.054, thigh, shank, 0.7),
        (_mix(knee, ankle, 0.28), 0.053, 0.057, shank, shank, 0.0),
        (_mix(knee, ankle, 0.85), 0.034, 0.037, shank, shank, 0.0),
        (ankle, 0.033, 0.038, shank, foot, 0.5),
    )
    return _rounded(
        [
            _Ring(centre, _x(wide * size), _z(deep * size), (one, other), share)
            for centre, wide, deep, one, other, share in rows
        ]
    )


def _foot(
    at: Mapping[str, np.ndarray], ends: Mapping[str, np.ndarray], size: float, side: str
) -> list[_Ring]:
    foot, toes = f"{side}_foot", f"{side}_toes"
    ankle, ball, tip = at[foot], at[toes], ends[toes]
    sole = ball[1] - 0.021 * size
    rows = (
        (ankle[2] - 0.055 * size, 0.030, 0.055, foot, foot, 0.0),
        (ankle[2], 0.036, 0.080, foot, foot, 0.0),
        (float(_mix(ankle, ball, 0.5)[2]), 0.040, 0.064, foot, foot, 0.0),
        (ball[2], 0.046, 0.044, foot, toes, 0.5),
        (float(_mix(ball, tip, 0.75)[2]), 0.042, 0.030, toes, toes, 0.0),
    )
    return _rounded(
        [
            _Ring(
                np.array([ankle[0], sole + tall * size / 2, z]),
                _x(wide * size),
                _y(tall * size / 2),
                (one, other),
                share,
            )
            for z, wide, tall, one, other, share in rows
        ]
    )


def _rounded(rings: Sequence[_Ring]) -> list[_Ring]:
    """With a half ellipsoid at both ends, as deep as half the end is thin."""

    def cap(end: _Ring, sign: float) -> list[_Ring]:
        along = np.cross(end.across, end.over)
        along /= np.linalg.norm(along)
        depth = 0.8 * min(np.linalg.norm(end.across), np.linalg.norm(end.over))
        out = []
        for angle in np.linspace(0, np.pi / 2, _CAP + 1)[1:]:
            centre = end.centre + sign * depth * np.sin(angle) * along
            shrunk = np.cos(angle)
            out.append(_Ring(centre, shrunk * end.across, shrunk * end.over, end.bones, end.share))
        return out

    return [*cap(rings[0], -1.0)[::-1], *rings, *cap(rings[-1], 1.0)]


def _bands(rings: int) -> Int[np.ndarray, "f 3"]:
    here = np.arange(_SIDES)
    after = (here + 1) % _SIDES
    bands = []
    for low in range(0, (rings - 1) * _SIDES, _SIDES):
        high = low + _SIDES
        bands.append(np.stack([low + here, low + after, high + after], axis=1))
        bands.append(np.stack([low + here, high + after, high + here], axis=1))
    return np.concatenate(bands)


def _normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """Of unit length, each the mean of its faces' by their areas."""
    corner = vertices[faces]
    of_face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normals = np.zeros_like(vertices)
    for column in range(3):
        np.add.at(normals, faces[:, column], of_face)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


def _mix(one: np.ndarray, other: np.ndarray, share: float) -> np.ndarray:
    return one + share * (other - one)


def _x(length: float) -> np.ndarray:
    return np.array([length, 0.0, 0.0])


def _y(length: float) -> np.ndarray:
    return np.array([0.0, length, 0.0])


def _z(length: float) -> np.ndarray:
    return np.array([0.0, 0.0, length])
