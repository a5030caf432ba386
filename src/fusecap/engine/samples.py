"""What a camera or a sensor delivered lately, in the order of its own times.

Samples come late, twice, or out of order; what is kept does not depend on it, as long as they come
before the instant that needs them.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from itertools import pairwise
from typing import Generic, TypeVar

KEPT_NS = 2_000_000_000
"""Samples so much older than the last instant are of no more use."""
AHEAD_NS = 10_000_000_000
"""Samples so much later than the last instant are off: a clock has jumped."""
MAX_SAMPLES = 8192
"""Of one source: what one at 680 Hz delivers from the oldest to the farthest ahead."""
PERIOD_SAMPLES = 9
"""From which a period is taken: eight intervals, a quarter of a second at 30 Hz."""
MIN_PERIOD_SAMPLES = 4
"""After an outage the gap must not pass for the period."""
_NEVER = -(10**18)

Item = TypeVar("Item")


class Samples(Generic[Item]):
    """One source's latest items by time [ns]."""

    def __init__(self) -> None:
        self._times: list[int] = []
        self._items: list[Item] = []
        self._now_ns: int | None = None

    def insert(self, timestamp_ns: int, item: Item) -> None:
        """Keep an item, wherever in time it belongs.

        Of two of the same time the first stays; one too old or too far ahead is of no use.
        """
        now_ns = self._now_ns
        if now_ns is not None and not -KEPT_NS <= timestamp_ns - now_ns <= AHEAD_NS:
            return
        at = bisect_left(self._times, timestamp_ns)
        if at < len(self._times) and self._times[at] == timestamp_ns:
            return
        self._times.insert(at, timestamp_ns)
        self._items.insert(at, item)
        if len(self._times) > MAX_SAMPLES:
            del self._times[0], self._items[0]

    def forget_before(self, now_ns: int) -> None:
        """Let go of what is too old for the instant `now_ns` and those after it."""
        self._now_ns = now_ns
        old = bisect_left(self._times, now_ns - KEPT_NS)
        del self._times[:old], self._items[:old]

    def around(self, now_ns: int, exact_ns: int = 0) -> tuple[int, int]:
        """Indices of the last item before an instant and of the first not before it.

        -1 and `len` where there is none; an item up to `exact_ns` early is at the instant.
        """
        after = bisect_left(self._times, now_ns - exact_ns)
        return after - 1, after

    def __len__(self) -> int:
        return len(self._times)

    def at(self, index: int) -> tuple[int, Item]:
        """Time and item; index 0 is the oldest."""
        return self._times[index], self._items[index]

    def since(self, timestamp_ns: int) -> list[Item]:
        """Items of that time and later."""
        return self._items[bisect_left(self._times, timestamp_ns) :]

    @property
    def newest_ns(self) -> int:
        """Of all items; long ago without any."""
        return self._times[-1] if self._times else _NEVER

    def last_ns(self, now_ns: int) -> int:
        """Of the items up to an instant; long ago without any."""
        upto = bisect_right(self._times, now_ns)
        return self._times[upto - 1] if upto else _NEVER

    def period_s(self, now_ns: int) -> float | None:
        """Median interval up to the first item not before an instant; None without enough items."""
        upto = min(bisect_left(self._times, now_ns) + 1, len(self._times))
        recent = self._times[max(upto - PERIOD_SAMPLES, 0) : upto]
        if len(recent) < MIN_PERIOD_SAMPLES:
            return None
        intervals = sorted(b - a for a, b in pairwise(recent))
        return 1e-9 * intervals[(len(intervals) - 1) // 2]
