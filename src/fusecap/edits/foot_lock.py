"""Feet that stand stay where they are: legs reach for the places of feet (two-bone kinematics).

While a foot stands (`fusecap.feet`) its ankle goes to the mean place of that stance, eased in and
out over a tenth of a second. Hips and foot rotation stay; thigh and shank turn by the least that
brings the ankle there, and the knee keeps the plane it bends in.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.pose import theta_from_rotations
from fusecap.edits.butterworth import runs
from fusecap.feet import standing
from fusecap.take import Take

_EASE_S = 0.1
_STRETCHED = 0.9995
"""A leg reaches no further than this share of its length."""


def lock_feet(take: Take, strength: float) -> tuple[Take, int]:
    """`strength` 0-1 of the way to where feet stand; returns the stances that were locked."""
    theta, stances = take.theta.copy(), 0
    for row in range(len(take.subject_names)):
        tracked = take.tracked[row]
        if not tracked.any():
            continue
        rotation = take.bone_rotation_in_world(row)
        for side in ("left", "right"):
            ankle = take.bone_position_in_world_m[row, :, take.skeleton.bone(f"{side}_foot")]
            target = ankle.copy()
            for first, end in runs(standing(take, row, side)):
                stances += 1
                place = ankle[first:end].mean(axis=0)
                ease = _eased(tracked, first, end, max(1, round(_EASE_S * take.rate_hz)))
                target += ease[:, None] * (place - ankle) * strength
            _reach(take, row, side, rotation, target)
        theta[row, tracked] = theta_from_rotations(
            take.parents, take.bone_position_in_world_m[row, tracked, 0], rotation[tracked]
        )
    return take.with_theta(theta), stances


def _eased(tracked: np.ndarray, first: int, end: int, ramp: int) -> Float[np.ndarray, " t"]:
    """1 in the stance, falling smoothly to 0 on both sides; 0 beyond a gap."""
    frames = np.arange(len(tracked))
    away = np.maximum(np.maximum(first - frames, frames - (end - 1)), 0) / ramp
    weight = np.where(away < 1, 0.5 + 0.5 * np.cos(np.pi * np.minimum(away, 1.0)), 0.0)
    for start, stop in runs(tracked):
        if not start <= first < stop:
            weight[start:stop] = 0.0
    return weight


def _reach(
    take: Take,
    row: int,
    side: str,
    rotation: Float[np.ndarray, "t b 3 3"],
    target: Float[np.ndarray, "t 3"],
) -> None:
    """Turns thigh and shank in `rotation` so that the ankle comes to `target`."""
    thigh, shank, foot = (take.skeleton.bone(f"{side}_{b}") for b in ("thigh", "shank", "foot"))
    hip, knee, ankle = (take.bone_position_in_world_m[row, :, b] for b in (thigh, shank, foot))
    moves = take.tracked[row] & (np.linalg.norm(target - ankle, axis=1) > 1e-7)
    if not moves.any():
        return
    hip, knee, ankle, target = hip[moves], knee[moves], ankle[moves], target[moves]
    upper, lower = np.linalg.norm(take.offsets_m[row, [shank, foot]], axis=1)
    reach = np.linalg.norm(target - hip, axis=1)
    reach = np.clip(reach, abs(upper - lower) * 1.001, (upper + lower) * _STRETCHED)
    along = _unit(target - hip)
    beside = (knee - hip) - along * _dot(knee - hip, along)
    forward = rotation[moves][:, thigh, :, 2]
    forward = forward - along * _dot(forward, along)
    straight = np.linalg.norm(beside, axis=1) < 1e-4
    bend = _unit(np.where(straight[:, None], forward, beside))
    cosine = np.clip((upper**2 + reach**2 - lower**2) / (2 * upper * reach), -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    new_knee = hip + upper * (cosine[:, None] * along + sine[:, None] * bend)
    new_ankle = hip + reach[:, None] * along
    rotation[moves, thigh] = _least_turn(knee - hip, new_knee - hip) @ rotation[moves, thigh]
    turn = _least_turn(ankle - knee, new_ankle - new_knee)
    rotation[moves, shank] = turn @ rotation[moves, shank]


def _least_turn(
    one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3 3"]:
    """The shortest rotation that takes one direction to the other."""
    axis = np.cross(one, other)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ni,ni->n", one, other))
    vector = axis * (angle / np.maximum(sine, 1e-15))[:, None]
    return Rotation.from_rotvec(vector).as_matrix()


def _unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _dot(one: Float[np.ndarray, "n 3"], other: Float[np.ndarray, "n 3"]) -> np.ndarray:
    return np.einsum("ni,ni->n", one, other)[:, None]
