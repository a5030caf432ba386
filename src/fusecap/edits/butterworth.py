"""A zero-lag Butterworth filter, for those who must report one.

Second order, forwards and backwards, so fourth order without delay. Two passes damp twice at the
cut-off, so each is designed for a higher one (Winter, "Biomechanics and Motor Control of Human
Movement", eq. 3.9): both together let half the power of the stated frequency through.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.take import Take

_PASSES = 2
_SHORTEST = 13
"""Frames of a run; shorter ones have too little on either side to filter, and stay."""


def butterworth(take: Take, cutoff_hz: float) -> tuple[Take, int]:
    """Filters roots and joint rotations of every tracked run; returns frames that stayed as is.

    Raises `InputError` for a cut-off that the take's rate does not carry.
    """
    corrected = (2 ** (1 / _PASSES) - 1) ** 0.25
    nyquist_hz = take.rate_hz / 2
    designed_hz = np.arctan(np.tan(np.pi * cutoff_hz / take.rate_hz) / corrected) * (
        take.rate_hz / np.pi
    )
    if not 0 < cutoff_hz < 0.9 * nyquist_hz:
        raise InputError(
            f"a cut-off of {cutoff_hz:g} Hz: expected above 0 and below {0.9 * nyquist_hz:g} Hz, "
            f"for the take has {take.rate_hz:g} Hz"
        )
    sections = butter(2, designed_hz, fs=take.rate_hz, output="sos")
    theta, left = take.theta.copy(), 0
    for row in range(len(take.subject_names)):
        for first, end in runs(take.tracked[row]):
            if end - first < _SHORTEST:
                left += end - first
                continue
            span = slice(first, end)
            theta[row, span, :3] = sosfiltfilt(sections, take.theta[row, span, :3], axis=0)
            for bone in range(len(take.bone_names)):
                columns = slice(3 + 3 * bone, 6 + 3 * bone)
                quaternion = Rotation.from_rotvec(take.theta[row, span, columns]).as_quat()
                flips = np.einsum("ti,ti->t", quaternion[1:], quaternion[:-1]) < 0
                signs = np.where(np.logical_xor.accumulate([False, *flips]), -1.0, 1.0)
                smooth = sosfiltfilt(sections, quaternion * signs[:, None], axis=0)
                theta[row, span, columns] = Rotation.from_quat(smooth).as_rotvec()
    return take.with_theta(theta), left


def runs(tracked: np.ndarray) -> list[tuple[int, int]]:
    """First frame, and the one after the last, of what is tracked without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], tracked.astype(int), [0]])))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]
