"""Gait cycles: a leg's angles from one foot strike to the next of the same foot."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from fusecap.angles.joint_angles import JointAngles
from fusecap.feet import foot_events
from fusecap.take import Take

PERCENT = np.linspace(0.0, 100.0, 101)
_SHORTEST_S, _LONGEST_S = 0.5, 2.5
_LEG = ("hip", "knee", "ankle")
_UPRIGHT_M = 0.3
"""Whose hips are not so far above the foot lies, kneels or crawls."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GaitCycles:
    """Of one side, every cycle stretched to 0-100 %."""

    side: str
    start_s: Float[np.ndarray, " c"]
    names: tuple[str, ...]
    deg: Float[np.ndarray, "c 101 a"]
    strikes: int
    """How often the foot came down, also where that made no cycle."""

    @property
    def why_none(self) -> str:
        """Of a side without a cycle."""
        if not self.strikes:
            return (
                "it is nowhere low and slow after a step and walks on no belt; is the floor at "
                "y = 0, and are feet seen or worn?"
            )
        if self.strikes == 1:
            return "it comes down once"
        return (
            f"it comes down {self.strikes} times, but no two strikes lie {_SHORTEST_S:g} to "
            f"{_LONGEST_S:g} s apart with the person followed, and upright, between them"
        )

    @property
    def mean_deg(self) -> Float[np.ndarray, "101 a"]:
        """Over cycles; NaN without one."""
        return self.deg.mean(axis=0) if len(self.deg) else np.full(self.deg.shape[1:], np.nan)

    @property
    def band_deg(self) -> Float[np.ndarray, "101 a"]:
        """Standard deviation over cycles; NaN with fewer than two."""
        if len(self.deg) < 2:
            return np.full(self.deg.shape[1:], np.nan)
        return self.deg.std(axis=0, ddof=1)


def gait_cycles(take: Take, angles: JointAngles, subject: int, side: str) -> GaitCycles:
    """Cycles of 0.5 to 2.5 s of one leg in which the subject was tracked and upright throughout."""
    columns = [
        column
        for column, name in enumerate(angles.names)
        if name.startswith(tuple(f"{side}_{joint}_" for joint in _LEG))
    ]
    strikes = [
        event.frame for event in foot_events(take, subject) if event.strikes and event.side == side
    ]
    height_m = take.bone_position_in_world_m[subject, :, :, 1]
    upright = height_m[:, 0] - height_m[:, take.skeleton.bone(f"{side}_foot")] > _UPRIGHT_M
    starts, cycles = [], []
    for first, end in pairwise(strikes):
        time_s = angles.time_s[first : end + 1]
        whole = (take.tracked[subject] & upright)[first : end + 1].all()
        if whole and _SHORTEST_S <= time_s[-1] - time_s[0] <= _LONGEST_S:
            at_s = np.interp(PERCENT, (0.0, 100.0), (time_s[0], time_s[-1]))
            curves = angles.deg[subject, first : end + 1, columns]
            cycles.append(np.stack([np.interp(at_s, time_s, curve) for curve in curves], axis=1))
            starts.append(time_s[0])
    return GaitCycles(
        side=side,
        strikes=len(strikes),
        start_s=np.array(starts),
        names=tuple(angles.names[column] for column in columns),
        deg=np.array(cycles).reshape(-1, len(PERCENT), len(columns)),
    )
