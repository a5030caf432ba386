"""A distribution of errors in four numbers, as the paper's tables give it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A distribution of errors in four numbers, over the values that are not NaN."""

    mean: float
    std: float
    median: float
    mad: float
    """Median absolute deviation from the median."""
    count: int

    def scaled(self, factor: float) -> Summary:
        """The same in another unit."""
        return Summary(
            mean=self.mean * factor,
            std=self.std * factor,
            median=self.median * factor,
            mad=self.mad * factor,
            count=self.count,
        )


def summarize(errors: Float[np.ndarray, "..."]) -> Summary:
    """Summary of `errors`; NaN throughout where there are none."""
    values = errors[np.isfinite(errors)]
    if len(values) == 0:
        return Summary(mean=np.nan, std=np.nan, median=np.nan, mad=np.nan, count=0)
    median = float(np.median(values))
    return Summary(
        mean=float(values.mean()),
        std=float(values.std()),
        median=median,
        mad=float(np.median(np.abs(values - median))),
        count=len(values),
    )
