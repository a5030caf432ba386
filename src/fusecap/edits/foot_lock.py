"""Feet that stand stay where they are: legs reach for the places of feet (two-bone kinematics).

While a foot stands (`fusecap.feet`) its ankle goes to the mean place of that stance, eased in and
out over a tenth of a second. Hips and foot rotation stay; thigh and shank turn by the least that
brings the ankle there, and the knee keeps the plane it bends in.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.body.pose import theta_from_rotations
from fusecap.edits.butterworth import runs
from fusecap.feet import standing
from fusecap.geometry.two_bone import two_bone_turns
from fusecap.take import Take

_EASE_S = 0.1


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
    turn_thigh, turn_shank = two_bone_turns(
        hip, knee, ankle, target, forward=rotation[moves][:, thigh, :, 2]
    )
    rotation[moves, thigh] = turn_thigh @ rotation[moves, thigh]
    rotation[moves, shank] = turn_shank @ rotation[moves, shank]
