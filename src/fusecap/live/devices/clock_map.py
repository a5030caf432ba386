"""Times of a device's clock brought to the session's, from when its samples arrive.

A sample stamped s by its device and arriving at a has taken a - s, up to the unknown constant
between the two clocks. Delays only ever add to the shortest way, so a plot of a - s over s is a
line (the clocks, one a little faster) with noise above it. The line is found as the edge of the
lower convex hull under the middle of the window: of all lines below every point it is the closest
to them on average [1]. Per `BUCKET_S` the second smallest point stands for all, so that one wrong
stamp moves nothing.

With packets that take 2 to 30 ms (mean 8) and a clock that runs 100 ppm fast the mapped times
are within 0.5 ms of the truth plus the shortest way, once the window has filled (10 s).

What cannot be seen is the shortest way itself: `delay_s` states it.

[1] S. B. Moon, P. Skelly, D. Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999.
"""

from __future__ import annotations

from collections import deque

WINDOW_S = 10.0
BUCKET_S = 0.25
SLOPE_AFTER_S = 3.0
"""With less to look at both clocks are taken to run alike."""
MAX_SLOPE = 2e-3
"""Of the clocks' rates; 30 and 29.97 frames per second differ by 1e-3."""
JUMP_NS = 200_000_000
"""A stamp this far off is of a clock that was set, if the next ones agree."""
BELIEVED = 5
"""Samples in a row that make a jump."""
PATIENCE_NS = 2_000_000_000
"""How long all samples must come late before it is the clock that is late."""
TRUSTED_AGE_NS = 2_000_000_000
"""A stamp that is said to be on the session's clock may be this old, and not of the future."""


class ClockMap:
    """Maps the stamps of one source; holds no clock. Output times strictly ascend."""

    def __init__(self, *, delay_s: float = 0.0) -> None:
        """`delay_s` is the shortest way from the measurement to the arrival: stated, not measured.

        It is taken off every time but those of stamps that are on the session's clock already.
        """
        self.restarts = 0
        self.note = ""
        """What happened to the device's clock last."""
        self._delay_ns = round(delay_s * 1e9)
        self._last_ns: int | None = None
        self._forget()

    def session_ns(
        self, stamp_ns: int | None, arrival_ns: int, *, synchronised: bool = False
    ) -> int | None:
        """When the sample was measured, on the session's clock; None for one to leave out.

        That is one that comes double or after a later one, or whose stamp is off by a jump that the
        samples around it do not confirm. Without a stamp the arrival less the delay counts.
        A `synchronised` stamp is on the session's clock already, and taken as it is unless it
        makes no sense there.
        """
        if stamp_ns is None:
            self._forget()
            return self._given(arrival_ns - self._delay_ns)
        if synchronised and 0 <= arrival_ns - stamp_ns <= TRUSTED_AGE_NS:
            return self._given(stamp_ns)
        if self._last_stamp_ns is not None and not self._follows(stamp_ns, arrival_ns):
            return None
        self._last_stamp_ns = stamp_ns
        self._remember(stamp_ns, arrival_ns)
        return self._given(min(stamp_ns + self._shift_ns(stamp_ns), arrival_ns) - self._delay_ns)

    def _forget(self) -> None:
        self._last_stamp_ns: int | None = None
        self._buckets: deque[_Bucket] = deque()
        self._line: tuple[float, float, int] | None = None
        self._off = 0
        self._late_since_ns: int | None = None

    def _given(self, time_ns: int) -> int | None:
        if self._last_ns is not None and time_ns <= self._last_ns:
            return None
        self._last_ns = time_ns
        return time_ns

    def _follows(self, stamp_ns: int, arrival_ns: int) -> bool:
        """Whether the sample continues the stream; forgets the past when a jump is believed."""
        assert self._last_stamp_ns is not None
        excess_ns = arrival_ns - stamp_ns - self._shift_ns(stamp_ns)
        back_ns = self._last_stamp_ns - stamp_ns
        if excess_ns < -JUMP_NS or back_ns > JUMP_NS:
            self._off += 1
            if self._off < BELIEVED:
                return False
            self._restart("was set", stamp_ns, arrival_ns)
            return True
        if back_ns >= 0:
            return False
        self._off = 0
        if excess_ns <= JUMP_NS:
            self._late_since_ns = None
        elif self._late_since_ns is None:
            self._late_since_ns = arrival_ns
        elif arrival_ns - self._late_since_ns >= PATIENCE_NS:
            self._restart("fell back", stamp_ns, arrival_ns)
        return True

    def _restart(self, what: str, stamp_ns: int, arrival_ns: int) -> None:
        assert self._last_stamp_ns is not None
        step_ns = stamp_ns - arrival_ns + self._shift_ns(self._last_stamp_ns)
        self._forget()
        self.restarts += 1
        self.note = f"its clock {what} by {step_ns * 1e-9:+.1f} s"

    def _remember(self, stamp_ns: int, arrival_ns: int) -> None:
        number = stamp_ns // round(BUCKET_S * 1e9)
        if not self._buckets or self._buckets[-1].number != number:
            self._buckets.append(_Bucket(number))
            while number - self._buckets[0].number > WINDOW_S / BUCKET_S:
                self._buckets.popleft()
        if self._buckets[-1].add(stamp_ns, arrival_ns - stamp_ns):
            self._line = None

    def _shift_ns(self, stamp_ns: int) -> int:
        """What is added to a stamp: the line at `stamp_ns`."""
        if self._line is None:
            self._line = _line_below([bucket.lowest for bucket in self._buckets])
        slope, shift_ns, at_ns = self._line
        return round(shift_ns + slope * (stamp_ns - at_ns))


class _Bucket:
    """The two samples that came quickest in a quarter of a second."""

    __slots__ = ("_first", "_second", "number")

    def __init__(self, number: int) -> None:
        self.number = number
        self._first: tuple[int, int] | None = None
        self._second: tuple[int, int] | None = None

    @property
    def lowest(self) -> tuple[int, int]:
        """(stamp, arrival - stamp) that stands for the bucket."""
        point = self._second or self._first
        assert point is not None
        return point

    def add(self, stamp_ns: int, shift_ns: int) -> bool:
        """Whether `lowest` has changed."""
        point = (stamp_ns, shift_ns)
        if self._first is None:
            self._first = point
        elif shift_ns < self._first[1]:
            self._first, self._second = point, self._first
        elif self._second is None or shift_ns < self._second[1]:
            self._second = point
        else:
            return False
        return True


def _line_below(points: list[tuple[int, int]]) -> tuple[float, float, int]:
    """Slope, and shift [ns] at a stamp: the hull's edge under the mean stamp; `points` ascend."""
    lowest_at_ns, lowest_ns = min(points, key=lambda point: point[1])
    if points[-1][0] - points[0][0] < SLOPE_AFTER_S * 1e9:
        return 0.0, lowest_ns, lowest_at_ns
    hull: list[tuple[int, int]] = []
    for point in points:
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    first_ns = points[0][0]
    mean_ns = first_ns + sum(stamp - first_ns for stamp, _ in points) // len(points)
    right = next(i for i in range(1, len(hull)) if hull[i][0] >= mean_ns)
    (start_ns, low_ns), (end_ns, high_ns) = hull[right - 1], hull[right]
    slope = (high_ns - low_ns) / (end_ns - start_ns)
    if abs(slope) > MAX_SLOPE:
        return 0.0, lowest_ns, lowest_at_ns
    return slope, low_ns, start_ns


def _turns_down(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
