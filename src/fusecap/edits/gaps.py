"""Frames without a subject: gaps made where error bars are wide, bridged where short."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from fusecap.errors import InputError
from fusecap.take import Take


def mark_gaps(take: Take, above_deg: float) -> tuple[Take, int]:
    """Takes out frames whose bones have a mean error bar above this; returns how many."""
    mean_deg = np.where(take.tracked, np.nan_to_num(take.bone_sigma_deg).mean(axis=2), 0.0)
    worse = take.tracked & (mean_deg > above_deg)
    tracked = take.tracked & ~worse
    if take.tracked.any() and not tracked.any():
        raise InputError(
            f"gaps above {above_deg:g} deg: that is every frame; the least mean error bar is "
            f"{mean_deg[take.tracked].min():.1f} deg"
        )
    return take.with_theta(
        np.where(tracked[:, :, None], take.theta, np.nan),
        tracked=tracked,
        bone_sigma_deg=np.where(tracked[:, :, None], take.bone_sigma_deg, np.nan),
        position_sigma_m=np.where(tracked[:, :, None], take.position_sigma_m, np.nan),
    ), int(worse.sum())


def fill_gaps(take: Take, up_to_s: float) -> tuple[Take, int]:
    """Bridges gaps between two tracked frames that last no longer than this; returns frames filled.

    Roots go along monotone cubics through the frames around, every joint turns evenly from the last
    pose to the next. The error bars of a filled frame are those of the worse end and half of what
    changes across the gap: nothing was measured there.
    """
    theta, tracked = take.theta.copy(), take.tracked.copy()
    turn_deg, place_m = take.bone_sigma_deg.copy(), take.position_sigma_m.copy()
    filled = 0
    for row in range(len(take.subject_names)):
        known = np.flatnonzero(take.tracked[row])
        for first, end in gaps(take.tracked[row]):
            span = slice(first, end)
            missing_s = float(take.time_s[end] - take.time_s[first - 1])
            if missing_s > up_to_s + 1.5 / take.rate_hz:
                continue
            around = known[(known >= first - 3) & (known < end + 3)]
            path = PchipInterpolator(take.time_s[around], take.theta[row, around, :3])
            theta[row, span, :3] = path(take.time_s[span])
            ends = [first - 1, end]
            for bone in range(len(take.bone_names)):
                columns = slice(3 + 3 * bone, 6 + 3 * bone)
                turns = Rotation.from_rotvec(take.theta[row, ends][:, columns])
                between = Slerp(take.time_s[ends], turns)(take.time_s[span])
                theta[row, span, columns] = between.as_rotvec()
            across = Rotation.from_quat(
                np.roll(take.bone_rotation_in_world_wxyz[row, ends], -1, axis=-1).reshape(-1, 4)
            )
            bones = len(take.bone_names)
            changed = np.degrees((across[:bones].inv() * across[bones:]).magnitude())
            moved = np.linalg.norm(
                np.diff(take.bone_position_in_world_m[row, ends], axis=0)[0], axis=1
            )
            turn_deg[row, span] = take.bone_sigma_deg[row, ends].max(axis=0) + changed / 2
            place_m[row, span] = take.position_sigma_m[row, ends].max(axis=0) + moved / 2
            tracked[row, span] = True
            filled += end - first
    filled_take = take.with_theta(
        theta, tracked=tracked, bone_sigma_deg=turn_deg, position_sigma_m=place_m
    )
    return filled_take, filled


def gaps(tracked: Bool[np.ndarray, " t"]) -> list[tuple[int, int]]:
    """First frame, and the one after the last, of gaps with tracked frames on both sides."""
    edges = np.flatnonzero(np.diff(tracked.astype(int)))
    leave = [int(edge) + 1 for edge in edges if tracked[edge]]
    enter = [int(edge) + 1 for edge in edges if not tracked[edge]]
    return [
        (first, next(end for end in enter if end > first))
        for first in leave
        if any(end > first for end in enter)
    ]
