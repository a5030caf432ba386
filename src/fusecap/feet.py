"""When feet come down and leave the floor, from how low and slow they are.

A foot stands while its ankle or toes are near the floor and slow; what lasts less than 0.1 s counts
as neither standing nor stepping. On stairs, or where the floor is not at y = 0, none stands.

On a treadmill the floor moves: its velocity is that of the lower foot, in the median, of somebody
who gets nowhere. There a foot is down from where it is farthest before the hips to where it is
farthest behind (Zeni, Richards and Higginson, Gait and Posture 27, 2008), which noise disturbs less
than its speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import find_peaks

from fusecap.take import Take

_LOW_M, _SLOW_M_S = 0.15, 0.35
_SHORT_S = 0.1
_STIRS_M = 0.05
"""A foot within this of where it stood has not left."""
_STAYS = 0.3
"""Share of the floor's speed below which hips get nowhere."""
_STILL = np.zeros(3)
_STRIDE, _STEP_S = 0.5, 0.5
"""Of the usual reach a step has at least so much, and it is so long after the last of the foot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FootEvent:
    """A foot that comes down or leaves."""

    side: str
    """left or right"""
    strikes: bool
    frame: int


def standing(take: Take, subject: int, side: str) -> Bool[np.ndarray, " t"]:
    """Whether the foot stands, per frame; never where the person is not tracked."""
    tracked = take.tracked[subject]
    stands = np.zeros(len(tracked), dtype=bool)
    if len(tracked) < 2:
        return stands
    places = []
    for bone in ("foot", "toes"):
        place, velocity = _moves(take, subject, f"{side}_{bone}")
        slow = np.linalg.norm(velocity, axis=1) < _SLOW_M_S
        stands |= slow & (place[:, 1] < _LOW_M)
        places.append(place)
    stands = _without_short(stands & tracked, max(1, round(_SHORT_S * take.rate_hz)))
    return _without_stirring(stands, np.stack(places)) & tracked


def on_floor(take: Take, subject: int, side: str) -> Bool[np.ndarray, " t"]:
    """Whether the foot stands on what it walks on, a floor or a belt; else as `standing`."""
    floor_m_s = floor_velocity(take, subject)
    if not floor_m_s.any():
        return standing(take, subject, side)
    tracked = take.tracked[subject]
    foot, _ = _moves(take, subject, f"{side}_foot")
    hips, _ = _moves(take, subject, take.bone_names[0])
    ahead_m = (hips - foot) @ floor_m_s / np.linalg.norm(floor_m_s)
    ahead_m = np.where(tracked, ahead_m, np.nanmedian(ahead_m[tracked]))
    stride_m = np.ptp(np.percentile(ahead_m[tracked], (5, 95)))
    strikes, leaves = (
        find_peaks(
            turned, prominence=_STRIDE * stride_m, distance=max(1.0, _STEP_S * take.rate_hz)
        )[0]
        for turned in (ahead_m, -ahead_m)
    )
    down = np.zeros(len(tracked), dtype=bool)
    for strike, end in zip(strikes, np.searchsorted(leaves, strikes), strict=True):
        down[strike : leaves[end] if end < len(leaves) else strike + 1] = True
    return down & tracked


def floor_velocity(take: Take, subject: int) -> Float[np.ndarray, "3"]:
    """Of the belt somebody walks on [m/s]; 0 on a floor that stands still."""
    tracked = take.tracked[subject]
    if tracked.sum() < 2:
        return _STILL
    moves = [_moves(take, subject, f"{side}_toes") for side in ("left", "right")]
    heights = np.stack([place[:, 1] for place, _ in moves])[:, tracked]
    velocities = np.stack([velocity for _, velocity in moves])[:, tracked]
    lower = velocities[heights.argmin(axis=0), np.arange(heights.shape[1])]
    _, hips = _moves(take, subject, take.bone_names[0])
    known = np.isfinite(lower).all(axis=1) & np.isfinite(hips[tracked]).all(axis=1)
    if not known.any():
        return _STILL
    floor = np.median(lower[known], axis=0) * [1.0, 0.0, 1.0]
    gone = np.median(hips[tracked][known], axis=0) * [1.0, 0.0, 1.0]
    speed = np.linalg.norm(floor)
    stays = np.linalg.norm(gone) < _STAYS * speed
    return floor if speed > _SLOW_M_S and stays else _STILL


def foot_events(take: Take, subject: int) -> list[FootEvent]:
    """In the order of time, on a floor or on a treadmill's belt."""
    tracked = take.tracked[subject]
    events: list[FootEvent] = []
    for side in ("left", "right"):
        stands = on_floor(take, subject, side)
        for frame in np.flatnonzero(np.diff(stands)) + 1:
            if tracked[frame - 1] and tracked[frame]:
                events.append(FootEvent(side=side, strikes=bool(stands[frame]), frame=int(frame)))
    return sorted(events, key=lambda event: event.frame)


def _moves(
    take: Take, subject: int, bone: str
) -> tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3"]]:
    """A joint's place [m] and velocity [m/s]; there are two frames at least."""
    place = take.bone_position_in_world_m[subject, :, take.skeleton.bone(bone)]
    return place, np.gradient(place, take.time_s, axis=0)


def _without_stirring(
    stands: Bool[np.ndarray, " t"], places_m: Float[np.ndarray, "p t 3"]
) -> Bool[np.ndarray, " t"]:
    """Between two stances whoever's foot stays about where both are has not stepped."""
    stands = stands.copy()
    for first, end in pairwise(np.flatnonzero(np.diff(stands)) + 1):
        if stands[first]:
            continue
        between = places_m[:, first:end]
        both = (places_m[:, first - 1] + places_m[:, end]) / 2
        if (np.linalg.norm(between - both[:, None], axis=2).max(axis=1) < _STIRS_M).any():
            stands[first:end] = True
    return stands


def _without_short(values: Bool[np.ndarray, " t"], frames: int) -> Bool[np.ndarray, " t"]:
    """Runs shorter than `frames` become what was before them, first the gaps."""
    values = values.copy()
    for kind in (False, True):
        edges = np.flatnonzero(np.diff(values)) + 1
        for first, end in pairwise(edges):
            if values[first] == kind and end - first < frames:
                values[first:end] = not kind
    return values
