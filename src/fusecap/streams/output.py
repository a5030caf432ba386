"""One stream of live poses: instants become frames, and who is in them becomes its cast."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from fusecap.body.shape import BodyShape
from fusecap.streams.person_pose import PersonPose, StreamFrame
from fusecap.streams.stream import Cast, Stream

_NEWS_EVERY_NS = 1_000_000_000
"""Between two announcements that a body is now measured otherwise."""
_SAME_BODY_M = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamStatus:
    """One receiver."""

    to: str
    sent: int
    dropped: int
    refused: int
    failed: int
    remark: str


class StreamOutput:
    """Sends every instant to one stream; like the stream, it never waits."""

    def __init__(
        self,
        open_stream: Callable[[Cast], Stream],
        cast: Cast,
        now_ns: Callable[[], int],
        on_sent: Callable[[int, int, int], None],
    ) -> None:
        """Raises what opening the stream raises.

        `on_sent` hears of which instant a pose was sent, when that was handed over, and when sent.
        """
        self.poses = 0
        """Instants sent so far."""
        self._cast = dict(cast)
        self._stream = open_stream(dict(cast))
        self._now_ns = now_ns
        self._on_sent = on_sent
        self._trouble = ""
        self._told_ns = now_ns()

    def where(self) -> dict[str, str]:
        """Address per person, where persons have addresses of their own."""
        return self._stream.where()

    def status(self) -> StreamStatus:
        """How it goes."""
        counts = self._stream.counts
        return StreamStatus(
            to=str(self._stream.target),
            sent=counts.sent,
            dropped=counts.dropped,
            refused=counts.refused,
            failed=counts.failed,
            remark=self._trouble or self._stream.remark(),
        )

    def send(
        self, poses: Mapping[str, PersonPose | None], timestamp_ns: int, handed_ns: int
    ) -> None:
        """One instant, which the solver handed over at `handed_ns`; trouble stays in the status."""
        try:
            self._update_cast(poses)
            self._stream.send(
                StreamFrame(
                    time_s=1e-9 * timestamp_ns,
                    timestamp_ns=timestamp_ns,
                    people={name: poses.get(name) for name in self._cast},
                )
            )
        except Exception as error:  # one stream's trouble is its own
            self._stream.counts.failed += 1
            self._trouble = f"{type(error).__name__}: {error}"
            return
        self.poses += 1
        self._on_sent(timestamp_ns, handed_ns, self._now_ns())
        self._trouble = ""

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()

    def _update_cast(self, poses: Mapping[str, PersonPose | None]) -> None:
        """Tell the stream of people who are new or gone at once, of new bodies once a second."""
        cast = {
            name: pose.shape if pose is not None else self._cast.get(name)
            for name, pose in poses.items()
        }
        known = {name: shape for name, shape in cast.items() if shape is not None}
        if list(known) == list(self._cast):
            now_ns = self._now_ns()
            if now_ns - self._told_ns < _NEWS_EVERY_NS:
                return
            if all(_alike(shape, self._cast[name]) for name, shape in known.items()):
                return
            self._told_ns = now_ns
        self._cast = known
        self._stream.set_cast(dict(known))


def _alike(a: BodyShape, b: BodyShape) -> bool:
    return a is b or bool(np.all(np.abs(a.offsets_m - b.offsets_m) < _SAME_BODY_M))
