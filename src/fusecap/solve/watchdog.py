"""A right person in a wrong pose: turned about, or a limb in another minimum, and there to stay.

A solve begins at the pose before, so one that was wrong stays wrong while its minimum lasts, and
motion follows it. What tells is that it fits worse than people do, for a while: the cost of an
instant alone, from where the window goes on, per keypoint. Then the pose is found as if nothing
were known before, and replaces the other where it fits far better.
"""

from __future__ import annotations

import math

POOR = 0.03
"""Cost per keypoint, in the mean of the last moments; right poses of people have 0.01 to 0.03,
people turned about 0.05 to 0.3 (simulated, training)."""
FITS = 0.5
"""Of the cost: what is found anew must be as good as that. Mirror images in one view are not."""
_MEAN_S = 0.25
_FIRST_TRIAL_S, _LAST_TRIAL_S = 0.25, 4.0
"""Between two trials in vain: twice as long each time, for they cost a few solves."""
_MOST = 0.2
"""Of one instant, so that a single one says nothing."""


class Watchdog:
    """Of one subject; holds no clock."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Somebody, or the same one, begins anew."""
        self._mean = 0.0
        self._last_ns: int | None = None
        self._sound_ns: int | None = None
        self._wait_s = _FIRST_TRIAL_S
        self._next_ns: int | None = None

    def doubts(self, cost: float, keypoints: int, now_ns: int) -> bool:
        """Whether the pose should be found anew now, for a comparison."""
        if not keypoints:
            return False
        elapsed_s = 0.0 if self._last_ns is None else (now_ns - self._last_ns) * 1e-9
        self._last_ns = now_ns
        share = -math.expm1(-elapsed_s / _MEAN_S)
        told = min(cost / keypoints, _MOST) if cost < math.inf else _MOST
        self._mean += share * (told - self._mean)
        if self._mean <= POOR or self._sound_ns is None:
            self._sound_ns = now_ns
            self._wait_s = _FIRST_TRIAL_S
        return self._mean > POOR and (self._next_ns is None or now_ns >= self._next_ns)

    def tried(self, fits: bool, now_ns: int) -> int | None:
        """What a trial gave. Where it fits, since when [ns] the pose before was wrong."""
        self._next_ns = now_ns + round(self._wait_s * 1e9)
        if not fits:
            self._wait_s = min(2.0 * self._wait_s, _LAST_TRIAL_S)
            return None
        # The mean lags behind.
        sound_ns = now_ns if self._sound_ns is None else self._sound_ns
        since_ns = sound_ns - round(_MEAN_S * 1e9)
        self._mean, self._sound_ns, self._wait_s = 0.0, now_ns, _FIRST_TRIAL_S
        return since_ns
