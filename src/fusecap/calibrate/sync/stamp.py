"""A stamp of the foot: visible in the video, a peak in the acceleration (the paper's way).

In the video a stamp is a foot that comes down fast and stops at once: the largest upward
acceleration of an ankle. In a sensor on a foot or shank it is the largest specific force. Steps
look alike, only weaker, so a stamp counts where its peak is well above all others; it tells which
of several peaks of `fusecap.calibrate.sync.imus` is the right one, or stands alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.calibrate.sync.signals import smoothed

ABOVE = 1.4
"""Times the second largest peak."""
APART_S = 0.4
"""Peaks nearer than this are one event."""
ERROR_S = 0.015
"""Standard error of a stamp's offset: a frame of the video and the foot's own yielding."""
MIN_FORCE_M_S2 = 25.0

_SMOOTH_S = 0.025


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """One event on both clocks."""

    bone: str
    video_s: float
    sensor_s: float

    @property
    def offset_s(self) -> float:
        """Added to the sensor's times."""
        return self.video_s - self.sensor_s


def find_stamp(
    feet_m: dict[str, tuple[Float[np.ndarray, " t"], Float[np.ndarray, "t 3"]]],
    forces: Sequence[tuple[str, np.ndarray, np.ndarray]],
) -> Stamp | None:
    """The stamp of one person; None where video or sensors show none that stands out.

    `feet_m` holds times and ankle positions (y up) by side; `forces` bone, times (n,) and specific
    force (n, 3) of each sensor on a foot or shank.
    """
    found = []
    for bone, times_s, force in forces:
        side = bone.partition("_")[0]
        if side not in feet_m:
            continue
        video = _peak(feet_m[side][0], _stopping(*feet_m[side]))
        size = np.linalg.norm(force, axis=1)
        sensor = _peak(times_s, np.where(size >= MIN_FORCE_M_S2, size, np.nan))
        if video is not None and sensor is not None:
            found.append((sensor[1], Stamp(bone=bone, video_s=video[0], sensor_s=sensor[0])))
    return max(found, key=lambda each: each[0])[1] if found else None


def _stopping(
    times_s: Float[np.ndarray, " t"], ankle_m: Float[np.ndarray, "t 3"]
) -> Float[np.ndarray, " t"]:
    """Upward acceleration of an ankle that comes down [m/s2]."""
    _, velocity = smoothed(times_s, ankle_m[:, 1:2], times_s, _SMOOTH_S)
    _, acceleration = smoothed(times_s, velocity, times_s, _SMOOTH_S)
    return np.where(velocity[:, 0] < 0, acceleration[:, 0], np.nan)


def _peak(
    times_s: Float[np.ndarray, " t"], size: Float[np.ndarray, " t"]
) -> tuple[float, float] | None:
    """When the largest value is, and how many times the next event it is; None unless `ABOVE`."""
    if not np.isfinite(size).any():
        return None
    best = int(np.nanargmax(size))
    others = size[np.abs(times_s - times_s[best]) > APART_S]
    second = float(np.nanmax(others)) if np.isfinite(others).any() else 0.0
    ratio = float(size[best]) / max(second, 1e-6)
    return (float(times_s[best]), ratio) if ratio >= ABOVE else None
