"""Quantiles of positive numbers that are not kept: counted in steps of half a percent."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_LEAST, _MOST = 1e-6, 1e6
_STEP = 0.005
_LOG_LEAST = np.log(_LEAST)
_COUNT = int((np.log(_MOST) - _LOG_LEAST) / _STEP) + 1
_TOGETHER = 256


class Quantiles:
    """Of all numbers added; NaN counts for nothing."""

    def __init__(self) -> None:
        self._counts = np.zeros(_COUNT, dtype=np.int64)
        self._waiting: list[np.ndarray] = []
        """To be counted together, which is cheaper."""

    @property
    def count(self) -> int:
        """How many were added."""
        self._flush()
        return int(self._counts.sum())

    def add(self, values: Float[np.ndarray, "..."]) -> None:
        """Those under a millionth or over a million count as these."""
        self._waiting.append(values.ravel())
        if len(self._waiting) == _TOGETHER:
            self._flush()

    def at(self, share: float) -> float:
        """The least number that `share` (0-1) of all do not exceed, within 0.3 %; NaN of none."""
        total = self.count
        if not total:
            return float("nan")
        step = int(np.searchsorted(np.cumsum(self._counts), share * total))
        return float(np.exp(_LOG_LEAST + (step + 0.5) * _STEP))

    def _flush(self) -> None:
        if self._waiting:
            values = np.concatenate(self._waiting)
            known = values[np.isfinite(values)]
            steps = np.log(np.clip(known, _LEAST, _MOST)) - _LOG_LEAST
            self._counts += np.bincount((steps / _STEP).astype(np.int64), minlength=_COUNT)
            self._waiting.clear()
