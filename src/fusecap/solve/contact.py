"""Which feet stand: told by the sensor they wear, else by how low and slow they are.

A sensor tells without knowing where the body is, so a walk by sensors alone goes from foot to foot.
On a treadmill feet that stand move: without a floor none is said to. Where neither a camera nor a
sensor on a foot could tell where somebody goes the root stays, for the double integral of what
sensors feel is metres off within seconds.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.kernels.groups import Floor, Window
from fusecap.solve.pose_solver import ImuSites
from fusecap.types import GRAVITY_M_S2

STILL_RAD_S = 0.6
"""A foot on the floor turns more slowly; one that swings does so for no more than an instant."""
STILL_M_S2 = 1.5
"""And what its sensor feels is as much as gravity."""
LOW_M, SLOW_M_S = 0.15, 0.35
"""Without a sensor: ankles and toes nearer to the floor, and slower."""
SPAN = 4
"""Instants over which that speed is taken: one would show more noise than speed."""


ANCHORED = 100.0
"""How much a root that stays counts beside a foot that stands."""


class Contact:
    """What decides for one subject."""

    def __init__(
        self, floor: Floor, parents: np.ndarray, sites: ImuSites, *, has_floor: bool
    ) -> None:
        self._has_floor = has_floor
        worn = {bone: row for row, bone in enumerate(sites.bone)}
        self._sensor = [
            worn.get(bone, worn.get(int(parents[bone]), -1)) for bone in floor.bone.tolist()
        ]
        """Per floor joint the sensor on the foot it belongs to, or -1."""

    def at(
        self, row: int, window: Window, feet_m: Float[np.ndarray, "n f 3"]
    ) -> Float[np.ndarray, " r"]:
        """Of the instant `row` of `window`: 0 or 1 per joint of `feet_m`, then of the root.

        `feet_m` are floor joints of instants solved alone: those of a motion would stand because
        they were said to stand.
        """
        rests = np.zeros(len(self._sensor) + 1)
        if row < 1:
            return rests
        first = max(row - SPAN, 0)
        span_s = window.steps[first:row].sum()
        speed = np.sqrt(((feet_m[row] - feet_m[first]) ** 2).sum(axis=1)) / span_s
        stands = (speed < SLOW_M_S) & (feet_m[row, :, 1] < LOW_M) & (feet_m[row - 1, :, 1] < LOW_M)
        told = bool((window.keypoints[row, :, :, 2] > 0.0).any())
        for index, sensor in enumerate(self._sensor):
            if sensor < 0 or not (window.present[row - 1, sensor] and window.present[row, sensor]):
                continue
            told = told or self._has_floor
            felt = window.force[row, sensor]
            before, now = window.rotation[row - 1, sensor], window.rotation[row, sensor]
            # ‖R₁ - R₀‖ = 2 √2 sin(φ/2)
            turned = np.sqrt(0.5 * ((now - before) ** 2).sum())
            still = turned < STILL_RAD_S * window.steps[row - 1]
            weight = np.sqrt(felt @ felt)
            stands[index] = still and not abs(weight - GRAVITY_M_S2) > STILL_M_S2
        if self._has_floor:
            rests[:-1] = stands
        rests[-1] = 0.0 if told else ANCHORED
        return rests
