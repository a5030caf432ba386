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
"""Instants over which that speed is taken, half of them later where known: one would show more
noise than speed."""
ANCHORED = 100.0
"""How much a root that stays counts beside a foot that stands."""


class Contact:
    """What decides for one subject."""

    def __init__(
        self, floor: Floor, parents: np.ndarray, sites: ImuSites, *, has_floor: bool
    ) -> None:
        self._has_floor = has_floor
        worn = {bone: row for row, bone in enumerate(sites.bone)}
        feet = [worn.get(bone, worn.get(int(parents[bone]), -1)) for bone in floor.bone.tolist()]
        self._worn = np.flatnonzero(np.array(feet) >= 0)
        """Floor joints of feet that wear a sensor, and below it."""
        self._sensor = np.array(feet, dtype=np.int64)[self._worn]

    def between(
        self, first: int, count: int, near: int, window: Window, feet_m: Float[np.ndarray, "n f 3"]
    ) -> Float[np.ndarray, "m r"]:
        """Of the instants from `first` of `count`: 0 or 1 per joint of `feet_m`, then of the root.

        `feet_m` are floor joints of instants solved alone: those of a motion would stand because
        they were said to stand. Against their noise each is the mean of those `near` it, before and
        after, as far as they are known.
        """
        if count < 2:
            return np.zeros((count - first, feet_m.shape[1] + 1))
        feet_m = _means(feet_m[:count], near)
        rows = np.arange(first, count)
        rests = np.zeros((len(rows), feet_m.shape[1] + 1))
        before = np.maximum(rows - 1, 0)
        start = np.maximum(rows - SPAN // 2, 0)
        end = np.minimum(rows + SPAN // 2, count - 1)
        elapsed_s = np.concatenate([[0.0], np.cumsum(window.steps[: count - 1])])
        span_s = elapsed_s[end] - elapsed_s[start]
        speed = np.linalg.norm(feet_m[end] - feet_m[start], axis=2) / span_s[:, None]
        low = feet_m[:, :, 1] < LOW_M
        stands = (speed < SLOW_M_S) & low[rows] & low[before]
        told = (window.keypoints[rows, :, :, 2] > 0.0).any(axis=(1, 2))
        if len(self._worn):
            sensor = self._sensor
            present = (window.present[rows] > 0.0) & (window.present[before] > 0.0)
            here = present[:, sensor]
            told |= self._has_floor & here.any(axis=1)
            # ‖R₁ - R₀‖ = 2 √2 sin(φ/2)
            change = window.rotation[rows][:, sensor] - window.rotation[before][:, sensor]
            turned = np.sqrt(0.5 * (change**2).sum(axis=(2, 3)))
            still = turned < STILL_RAD_S * (elapsed_s[rows] - elapsed_s[before])[:, None]
            weight = np.linalg.norm(window.force[rows][:, sensor], axis=2)
            # A force that is missing is no shock.
            still &= ~(np.abs(weight - GRAVITY_M_S2) > STILL_M_S2)
            stands[:, self._worn] = np.where(here, still, stands[:, self._worn])
        if self._has_floor:
            rests[:, :-1] = stands
        rests[:, -1] = np.where(told, 0.0, ANCHORED)
        rests[rows == 0] = 0.0
        return rests


def _means(places_m: Float[np.ndarray, "n f 3"], near: int) -> Float[np.ndarray, "n f 3"]:
    count = len(places_m)
    rows = np.arange(count)
    low, high = np.maximum(rows - near, 0), np.minimum(rows + near + 1, count)
    sums = np.concatenate([np.zeros_like(places_m[:1]), np.cumsum(places_m, axis=0)])
    return (sums[high] - sums[low]) / (high - low)[:, None, None]
