"""How bones turned according to something other than the sensors, and how sure that is.

Cameras see points. Two points fix the direction of a limb but not its turn about itself, so a
solve without sensors fills that in from its pose prior, and a calibration that believed it would
inherit the guess. What the cameras did see is in the covariance of the solved orientations: with
absolute rotation errors w_b of the bones (world axes) and an error t of the root, a landmark k on
bone n moves by

    dp_k = t + sum over the bones b from the root to n of  w_b x s_b,k

where s_b,k leads from the joint of b to the next joint on the way, or to the landmark itself. All
landmarks (`LANDMARK_SIGMA_M`) and weak limits on how far a joint's solved rotation may be from the
true one (`_joint`) give the normal matrix of (t, w); the 3 x 3 blocks of its inverse are the
covariances.

A worked number: the forearm of a person of 1.75 m is 256 mm long, so its direction is known to
20 mm * sqrt(2) / 256 mm = 6.3 deg per instant; its turn about itself to 46 deg, which is the joint
limit alone. A bent elbow shows how the upper arm is turned about itself, because elbows are hinges.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.skeleton import ELBOW_HINGE, Skeleton
from fusecap.take import Take

LANDMARK_SIGMA_M = 0.02
"""Per axis, of a solved landmark: noise and the constant distance of a detector's landmarks."""
OPTICAL_SIGMA_RAD = np.radians(3.0)
"""Per axis, of a bone of a take that observes every axis."""
MAX_RATE_HZ = 20.0
"""Instants closer together tell nothing new."""

KNEE_HINGE = np.array([1.0, 0.0, 0.0])
"""In the thigh's frame and, but for `_joint`'s looseness, in the shank's."""

_LOOSE_RAD = 3.0
_CHUNK = 400
_ROOT_SIGMA_M = 10.0


@dataclass(frozen=True, kw_only=True)
class ReferenceMotion:
    """T instants of the B bones of one subject."""

    subject: str
    skeleton: Skeleton
    times_s: Float[np.ndarray, " t"]
    """On the session's clock."""
    rotation_in_world: Float[np.ndarray, "t b 3 3"]
    covariance_rad2: Float[np.ndarray, "t b 3 3"]
    """Of the rotation error e in R_seen = R_true exp(e), in the bone's frame."""

    @property
    def duration_s(self) -> float:
        """From the first to the last instant."""
        return float(self.times_s[-1] - self.times_s[0]) if len(self.times_s) else 0.0


def reference_motion(
    take: Take, subject: int, landmarks: LandmarkSet | None = None
) -> ReferenceMotion:
    """One subject of a take at up to `MAX_RATE_HZ`, where it is tracked and seen.

    With `landmarks`, the take is one that followed them; without, it observes every axis of every
    bone, as optical motion capture does.
    """
    step = max(1, round(take.rate_hz / MAX_RATE_HZ))
    seen = take.tracked[subject] & (np.nan_to_num(take.bone_quality[subject]).max(axis=1) > 0)
    frames = np.flatnonzero(seen)[::step]
    rotation = take.bone_rotation_in_world(subject)[frames]
    shape = (*rotation.shape[:2], 3, 3)
    if landmarks is None:
        covariance = np.broadcast_to(np.eye(3) * OPTICAL_SIGMA_RAD**2, shape).copy()
    else:
        covariance = np.empty(shape)
        quality = take.bone_quality[subject][frames]
        offsets = take.offsets_m[subject]
        landmarks = landmarks.of(take.subject_names[subject])
        at_m = landmarks.offsets_m(take.shape(subject))
        bones = landmarks.bones(take.skeleton)
        for start in range(0, len(frames), _CHUNK):
            part = slice(start, start + _CHUNK)
            rotation[part], covariance[part] = with_hinges(
                take.skeleton, offsets, bones, at_m, rotation[part], quality[part]
            )
    return ReferenceMotion(
        subject=take.subject_names[subject],
        skeleton=take.skeleton,
        times_s=take.timestamps_ns[frames] * 1e-9,
        rotation_in_world=rotation,
        covariance_rad2=covariance,
    )


def with_hinges(
    skeleton: Skeleton,
    offsets_m: Float[np.ndarray, "b 3"],
    landmark_bone: np.ndarray,
    landmark_offset_m: Float[np.ndarray, "k 3"],
    rotation_in_world: Float[np.ndarray, "t b 3 3"],
    quality: Float[np.ndarray, "t b"],
) -> tuple[Float[np.ndarray, "t b 3 3"], Float[np.ndarray, "t b 3 3"]]:
    """Bone rotations with elbows and knees brought towards hinges, and their covariances [rad²].

    A covariance is in its bone's frame.
    A landmark counts as much as the quality (0-1) of its bone or of the one above, for a wrist is
    seen where a hand's turn is not.
    """
    frames, bones = rotation_in_world.shape[:2]
    size = 3 + 3 * bones
    normal = np.zeros((frames, size, size))
    pull = np.zeros((frames, size))
    normal[:, range(3), range(3)] = 1 / _ROOT_SIGMA_M**2
    for bone, offset in zip(landmark_bone, landmark_offset_m, strict=True):
        jacobian = np.zeros((frames, 3, size))
        jacobian[:, range(3), range(3)] = 1.0
        segment = rotation_in_world[:, bone] @ offset
        at = int(bone)
        while at >= 0:
            jacobian[:, :, 3 + 3 * at : 6 + 3 * at] = -_cross(segment)
            segment = rotation_in_world[:, skeleton.parents[at]] @ offsets_m[at]
            at = skeleton.parents[at]
        above = max(skeleton.parents[bone], 0)
        weight = np.maximum(quality[:, bone], quality[:, above]) / LANDMARK_SIGMA_M**2
        normal += weight[:, None, None] * (np.swapaxes(jacobian, 1, 2) @ jacobian)
    for bone, parent in enumerate(skeleton.parents):
        own = slice(3 + 3 * bone, 6 + 3 * bone)
        if parent < 0:
            normal[:, own, own] += np.eye(3) / _LOOSE_RAD**2
            continue
        axes, sigma, missing = _joint(
            skeleton.bone_names[bone], rotation_in_world[:, parent], rotation_in_world[:, bone]
        )
        precision = (axes / sigma**2) @ np.swapaxes(axes, 1, 2)
        towards = np.einsum("tij,tj->ti", axes / sigma**2, missing)
        above = slice(3 + 3 * parent, 6 + 3 * parent)
        normal[:, own, own] += precision
        normal[:, above, above] += precision
        normal[:, own, above] -= precision
        normal[:, above, own] -= precision
        pull[:, own] += towards
        pull[:, above] -= towards
    inverse = np.linalg.inv(normal)
    turn = np.einsum("tij,tj->ti", inverse, pull)[:, 3:].reshape(-1, 3)
    turned = Rotation.from_rotvec(turn).as_matrix().reshape(rotation_in_world.shape)
    rotation = turned @ rotation_in_world
    blocks = [inverse[:, 3 + 3 * b : 6 + 3 * b, 3 + 3 * b : 6 + 3 * b] for b in range(bones)]
    return rotation, np.swapaxes(rotation, -1, -2) @ np.stack(blocks, axis=1) @ rotation


def _joint(
    bone: str, parent_rotation: Float[np.ndarray, "t 3 3"], rotation: Float[np.ndarray, "t 3 3"]
) -> tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "3"], Float[np.ndarray, "t 3"]]:
    """A joint's axes (columns, in the world), its looseness and its distance from the hinge [rad].

    Elbows and knees are hinges: free about the hinge, which is fixed in the bone above, loose (a
    forearm) or nearly tight (a shank) about their own length, tight about the third axis. Of other
    joints the solved rotation is as good a guess as any.
    """
    part = bone.removeprefix("left_").removeprefix("right_")
    missing = np.zeros((len(rotation), 3))
    if part in ("forearm", "shank"):
        along = rotation[:, :, 0 if part == "forearm" else 1]
        hinge = parent_rotation @ (ELBOW_HINGE if part == "forearm" else KNEE_HINGE)
        lean = np.sum(hinge * along, axis=1)
        axis = hinge - lean[:, None] * along
        axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
        third = np.cross(axis, along)
        missing[:, 2] = np.arcsin(np.clip(lean, -1.0, 1.0))
        if part == "shank":
            own = rotation @ KNEE_HINGE
            sideways = np.sum(along * np.cross(own, axis), axis=1)
            missing[:, 1] = np.arctan2(sideways, np.sum(own * axis, axis=1))
        sigma = np.array([_LOOSE_RAD, 0.8 if part == "forearm" else 0.15, 0.12])
        return np.stack([axis, along, third], axis=2), sigma, missing
    if part.startswith("spine"):
        sigma = 0.12
    elif part in ("neck", "head", "clavicle", "toes"):
        sigma = 0.25
    elif part in ("hand", "foot"):
        sigma = 0.5
    else:
        sigma = 1.0
    return rotation, np.full(3, sigma), missing


def _cross(vector: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3 3"]:
    """[v]x per row."""
    x, y, z = vector.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
