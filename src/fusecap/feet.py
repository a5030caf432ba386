"""When feet come down and leave the floor, from how low and slow they are.

A foot stands while its ankle or toes are near the floor and slow; what lasts less than 0.1 s counts
as neither standing nor stepping. On stairs, or where the floor is not at y = 0, none stands.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool

from fusecap.take import Take

_LOW_M, _SLOW_M_S = 0.15, 0.35
_SHORT_S = 0.1


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
    for bone in ("foot", "toes"):
        place = take.bone_position_in_world_m[subject, :, take.skeleton.bone(f"{side}_{bone}")]
        velocity = np.gradient(place, take.time_s, axis=0)
        slow = np.linalg.norm(velocity, axis=1) < _SLOW_M_S
        stands |= slow & (place[:, 1] < _LOW_M)
    return _without_short(stands & tracked, max(1, round(_SHORT_S * take.rate_hz))) & tracked


def foot_events(take: Take, subject: int) -> list[FootEvent]:
    """In the order of time."""
    tracked = take.tracked[subject]
    events: list[FootEvent] = []
    for side in ("left", "right"):
        stands = standing(take, subject, side)
        for frame in np.flatnonzero(np.diff(stands)) + 1:
            if tracked[frame - 1] and tracked[frame]:
                events.append(FootEvent(side=side, strikes=bool(stands[frame]), frame=int(frame)))
    return sorted(events, key=lambda event: event.frame)


def _without_short(values: Bool[np.ndarray, " t"], frames: int) -> Bool[np.ndarray, " t"]:
    """Runs shorter than `frames` become what was before them, first the gaps."""
    values = values.copy()
    for kind in (False, True):
        edges = np.flatnonzero(np.diff(values)) + 1
        for first, end in pairwise(edges):
            if values[first] == kind and end - first < frames:
                values[first:end] = not kind
    return values
