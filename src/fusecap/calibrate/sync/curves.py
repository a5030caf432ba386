"""What a curve over shifts says: its best shift, whether another does as well, and how sure it is.

A curve is a mean cost per shift, kept per block of time (about a second each, for errors within a
second are alike). Whether shift B is worse than the best shift A is a paired test over blocks:

    z = mean_b(cost_b(B) - cost_b(A)) / (std_b(...) / sqrt(blocks))

Below `MIN_Z` the data cannot tell B from A. A walk on a treadmill has such a B one stride away; a
person who stands has one everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

MIN_Z = 3.5
"""Standard errors by which every other peak must be worse."""
BLOCK_S = 1.0
MIN_SHARE = 0.5
"""Of the way from the best to the typical cost: a peak above it is no rival, however few blocks
there are to tell."""
MIN_BLOCKS = 8
"""Of a shorter recording blocks are shorter, so that there are this many."""
MIN_OVERLAP = 0.3
"""A shift that leaves less of the measurements than this share of the best covered one is out."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Sums of a cost (0-1, small is good) over the B blocks of time at S shifts."""

    shifts_s: Float[np.ndarray, " s"]
    """Evenly spaced."""
    total: Float[np.ndarray, "b s"]
    count: Float[np.ndarray, "b s"]

    @property
    def mean(self) -> Float[np.ndarray, " s"]:
        """NaN where too little is left of the recording."""
        count = self.count.sum(0)
        enough = (count >= MIN_OVERLAP * count.max(initial=0)) & (count >= 10)
        return np.where(enough, self.total.sum(0) / np.maximum(count, 1), np.nan)

    def moved(self, by_s: float) -> Curve:
        """The curve whose shift 0 is this one's `by_s`; unknown beyond the ends."""
        step = round(by_s / (self.shifts_s[1] - self.shifts_s[0]))
        total, count = np.zeros_like(self.total), np.zeros_like(self.count)
        size = len(self.shifts_s)
        kept = slice(max(0, -step), min(size, size - step))
        source = slice(kept.start + step, kept.stop + step)
        if kept.stop > kept.start:
            total[:, kept], count[:, kept] = self.total[:, source], self.count[:, source]
        return Curve(shifts_s=self.shifts_s, total=total, count=count)

    def reversed(self) -> Curve:
        """The curve of the negative shift; shifts must be symmetric about 0."""
        return Curve(shifts_s=self.shifts_s, total=self.total[:, ::-1], count=self.count[:, ::-1])


@dataclass(frozen=True, kw_only=True)
class Peak:
    """The best shift of a curve and its rivals."""

    shift_s: float
    cost: float
    depth: float
    """How far the best lies below the typical cost, 0-1."""
    rivals_s: tuple[float, ...]
    """Shifts that the data cannot tell from the best."""
    worst_z: float
    """Standard errors by which the nearest rival is worse; infinite without one."""
    depth_z: float
    """Standard errors by which a typical shift is worse."""
    at_edge: bool
    """The best is the end of the range: the true one may lie beyond."""

    @property
    def distinct(self) -> bool:
        """Whether the data can tell the best from everything else."""
        return not self.rivals_s and not self.at_edge and self.depth_z >= MIN_Z


def peak_of(curve: Curve, separation_s: float) -> Peak | None:
    """The lowest point of a curve; None where no shift has measurements.

    Rivals are local minima more than `separation_s` away.
    """
    mean = curve.mean
    known = np.isfinite(mean)
    if not known.any():
        return None
    best = int(np.nanargmin(mean))
    far = known & (np.abs(curve.shifts_s - curve.shifts_s[best]) > separation_s)
    typical = float(np.median(mean[far])) if far.any() else float(mean[best])
    padded = np.where(known, mean, np.inf)
    before = np.concatenate([[np.inf], padded[:-1]])
    after = np.concatenate([padded[1:], [np.inf]])
    minima = np.flatnonzero(far & (padded <= before) & (padded <= after))
    rivals, worst = [], np.inf
    for index in minima[np.argsort(mean[minima])][:12]:
        if mean[index] - mean[best] > MIN_SHARE * (typical - mean[best]):
            break
        z = _worse_by(curve, int(index), best)
        worst = min(worst, z)
        if z < MIN_Z:
            rivals.append(float(curve.shifts_s[index]))
    depth_z = 0.0
    if far.any():
        others = np.flatnonzero(far)
        like = others[np.argsort(np.abs(mean[others] - typical))[:9]]
        depth_z = float(np.median([_worse_by(curve, int(index), best) for index in like]))
    edge_s = 1.5 * (curve.shifts_s[1] - curve.shifts_s[0])
    return Peak(
        shift_s=float(curve.shifts_s[best]),
        cost=float(mean[best]),
        depth=typical - float(mean[best]),
        rivals_s=tuple(rivals),
        worst_z=float(worst),
        depth_z=depth_z,
        at_edge=bool(abs(curve.shifts_s[best]) > curve.shifts_s[-1] - edge_s),
    )


def _worse_by(curve: Curve, index: int, best: int) -> float:
    """Z of the paired test over the blocks that both shifts have."""
    both = (curve.count[:, index] > 0) & (curve.count[:, best] > 0)
    if both.sum() < 3:
        return 0.0
    a = curve.total[both, index] / curve.count[both, index]
    b = curve.total[both, best] / curve.count[both, best]
    weight = np.minimum(curve.count[both, index], curve.count[both, best])
    difference = a - b
    mean = float(np.average(difference, weights=weight))
    spread = float(np.average((difference - mean) ** 2, weights=weight))
    blocks = weight.sum() ** 2 / np.sum(weight**2)
    return mean / float(np.sqrt(spread / max(blocks - 1, 1)) + 1e-6)


def blocks_of(times_s: Float[np.ndarray, " t"]) -> Int[np.ndarray, " t"]:
    """The block of time that each instant falls into."""
    if len(times_s) == 0:
        return np.zeros(0, dtype=np.int64)
    duration_s = float(times_s.max() - times_s.min())
    length_s = min(BLOCK_S, max(duration_s, 1e-3) / MIN_BLOCKS)
    return np.floor((times_s - times_s.min()) / length_s).astype(np.int64)


def clustered_covariance(
    gradient: Float[np.ndarray, "n p"],
    slope: Float[np.ndarray, "p p"],
    *clusters: Int[np.ndarray, " n"],
) -> Float[np.ndarray, "p p"]:
    """Covariance of the root of sum g = 0 where errors are alike within clusters.

    `gradient` holds g of each measurement, `slope` the derivative H of their sum. With one way of
    clustering H^-1 (sum_c g_c g_c') H^-T; with two the sum of both less that of their
    intersection, but never less than either alone.
    """
    inverse = np.linalg.pinv(slope)

    def meat(cluster: Int[np.ndarray, " n"]) -> np.ndarray:
        _, index = np.unique(cluster, return_inverse=True)
        size = int(index.max(initial=-1)) + 1
        sums = np.zeros((size, gradient.shape[1]))
        np.add.at(sums, index, gradient)
        return sums.T @ sums * (size / max(size - 1, 1))

    ways = [inverse @ meat(cluster) @ inverse.T for cluster in clusters]
    result = ways[0]
    if len(ways) == 2:
        both = clusters[0] * (int(clusters[1].max(initial=0)) + 1) + clusters[1]
        result = ways[0] + ways[1] - inverse @ meat(both) @ inverse.T
        floor = np.maximum(np.diag(ways[0]), np.diag(ways[1]))
        scale = np.sqrt(np.maximum(floor / np.maximum(np.diag(result), 1e-30), 1.0))
        result = result * np.outer(scale, scale)
    return result
