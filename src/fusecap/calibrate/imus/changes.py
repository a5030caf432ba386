"""Whether a sensor slipped during the recording.

A sensor that turns on its bone by d shifts e (`fusecap.calibrate.imus.fit`) by d from then on. For
every instant between two stretches of `CORRELATION_S`, the mean of e before and after, each
weighed by what the cameras observe, are compared; the split that differs most surely counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.calibrate.imus.fit import Fit, Pairs

MIN_TURN_RAD = np.radians(18.0)
"""About the axes that are observed."""
MIN_SIGNIFICANCE = 30.0
"""Squared standard deviations that the two sides are apart."""
MIN_BLOCKS = 2
"""On either side."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """A sensor that sat otherwise before than after."""

    time_s: float
    """On the session's clock, to within about `CORRELATION_S`."""
    turn_rad: float
    significance: float


def find_change(pairs: Pairs, fitted: Fit) -> Change | None:
    """The surest change of mounting (or jump of heading); None where nothing stands out."""
    pairs = pairs.where(pairs.block >= 0)
    error = fitted.errors(pairs)
    blocks = np.unique(pairs.block).tolist()
    if len(blocks) < 2 * MIN_BLOCKS:
        return None
    sums = [_sums(pairs, error, block) for block in blocks]
    weight, mean = np.array([w for w, _ in sums]), np.array([m for _, m in sums])
    scatter = _scatter(weight, mean)
    best: Change | None = None
    for split in range(MIN_BLOCKS, len(blocks) - MIN_BLOCKS + 1):
        before, after = weight[:split].sum(axis=0), weight[split:].sum(axis=0)
        turn = np.linalg.solve(after, np.einsum("bij,bj->i", weight[split:], mean[split:]))
        turn -= np.linalg.solve(before, np.einsum("bij,bj->i", weight[:split], mean[:split]))
        covariance = np.linalg.inv(before) + np.linalg.inv(after)
        share = np.linalg.inv(covariance)
        share /= np.linalg.eigvalsh(share)[-1]
        significance = float(turn @ np.linalg.solve(covariance, turn)) / scatter
        if best is None or significance > best.significance:
            best = Change(
                time_s=float(pairs.times_s[pairs.block == blocks[split]][0]),
                turn_rad=float(np.sqrt(turn @ share @ turn)),
                significance=significance,
            )
    if best is None or best.turn_rad < MIN_TURN_RAD or best.significance < MIN_SIGNIFICANCE:
        return None
    return best


def _sums(
    pairs: Pairs, error: Float[np.ndarray, "n 3"], block: int
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    rows = pairs.block == block
    weight = pairs.information[rows].sum(axis=0) + 1e-6 * np.eye(3)
    return weight, np.linalg.solve(
        weight, np.einsum("nij,nj->i", pairs.information[rows], error[rows])
    )


def _scatter(weight: Float[np.ndarray, "b 3 3"], mean: Float[np.ndarray, "b 3"]) -> float:
    """How much more neighbouring stretches differ than their weights say; 0.2 at least."""
    step = np.diff(mean, axis=0)
    covariance = np.linalg.inv(weight)
    expected = covariance[:-1] + covariance[1:]
    squared = np.einsum("bi,bi->b", step, np.linalg.solve(expected, step[..., None])[..., 0])
    return max(float(np.median(squared)) / 2.366, 0.2)
