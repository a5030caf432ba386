"""Which corners and views a calibration listens to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from fusecap.calibrate.cameras.bundle_adjustment import Corners, residuals_px
from fusecap.geometry.camera import Camera

RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2D vector whose coordinates are normal with sigma 1."""
ROBUST_SIGMAS = 3.0
"""Huber's loss turns at this many standard deviations of a corner's error, per axis."""
MIN_ROBUST_PX = 0.3
OUTLIER = 5.0
"""A view that misses by more than this many times the median view is left out."""
OUTLIER_PX = 2.0
"""But never one that misses by less."""


def robust_scale_px(errors: Float[np.ndarray, " n"]) -> float:
    """Where Huber's loss turns, from corners' distances."""
    return max(MIN_ROBUST_PX, ROBUST_SIGMAS * float(np.nanmedian(errors)) / RAYLEIGH_MEDIAN)


def view_rms_px(
    cameras: Sequence[Camera],
    boards: Float[np.ndarray, "b 4 4"],
    corners: Corners,
    view: Int[np.ndarray, " m"],
) -> Float[np.ndarray, " v"]:
    """Root mean square distance per view; `view` numbers each corner's."""
    squared = np.nan_to_num((residuals_px(cameras, boards, corners) ** 2).sum(axis=1), nan=1e8)
    return np.sqrt(np.bincount(view, squared) / np.bincount(view))


def outlying(rms_px: Float[np.ndarray, " v"]) -> Bool[np.ndarray, " v"]:
    """Views that contradict the rest."""
    return rms_px > max(OUTLIER_PX, OUTLIER * float(np.median(rms_px)))
