"""Random processes that the simulator draws from."""

from __future__ import annotations

import numpy as np


def correlated_noise(
    rng: np.random.Generator, frames: int, shape: tuple[int, ...], correlation_frames: float
) -> np.ndarray:
    """(frames, *shape) of unit normal AR(1) noise, white for no correlation.

    Its autocorrelation falls to 1/e after `correlation_frames`.
    """
    noise = rng.standard_normal((frames, *shape))
    keep = np.exp(-1.0 / correlation_frames) if correlation_frames > 0 else 0.0
    fresh = np.sqrt(1.0 - keep * keep)
    for frame in range(1, frames):
        noise[frame] = keep * noise[frame - 1] + fresh * noise[frame]
    return noise


def bursts(
    rng: np.random.Generator,
    frames: int,
    shape: tuple[int, ...],
    *,
    share: float,
    mean_frames: float,
) -> np.ndarray:
    """(frames, *shape) of bool, true for `share` of the time in runs of `mean_frames` on average.

    A two-state Markov chain, started in its stationary distribution.
    """
    if share <= 0.0:
        return np.zeros((frames, *shape), dtype=bool)
    if share >= 1.0:
        return np.ones((frames, *shape), dtype=bool)
    leave = 1.0 / max(mean_frames, 1.0)
    enter = min(leave * share / (1.0 - share), 1.0)
    draw = rng.random((frames, *shape))
    active = np.empty((frames, *shape), dtype=bool)
    active[0] = draw[0] < share
    for frame in range(1, frames):
        active[frame] = draw[frame] < np.where(active[frame - 1], 1.0 - leave, enter)
    return active
