"""One stream of a live run: instants become frames, and who is in them becomes its cast."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.live.devices.source import SessionClock
from fusecap.live.health import Meter
from fusecap.live.latency import LatencyBook
from fusecap.live.status import StreamStatus
from fusecap.setup import SessionSetup
from fusecap.streams.person_pose import PersonPose, StreamFrame
from fusecap.streams.streams import Cast, Stream

_NEWS_EVERY_NS = 1_000_000_000
"""Between two announcements that a body is now measured otherwise."""
_SAME_BODY_M = 0.002


def first_cast(setup: SessionSetup) -> Cast:
    """The session's people with the bodies known so far, before anyone is found."""
    skeleton = setup.session.skeleton
    return {
        subject.name: BodyShape.from_height(
            skeleton, subject.height_m or REFERENCE_HEIGHT_M
        ).with_lengths(subject.bone_lengths_m)
        for subject in setup.session.subjects
    }


class StreamOutput:
    """Sends every instant to one stream; like the stream, it never waits."""

    def __init__(
        self,
        open_stream: Callable[[Cast], Stream],
        cast: Cast,
        clock: SessionClock,
        latency: LatencyBook,
    ) -> None:
        """Raises what opening the stream raises."""
        self._cast = dict(cast)
        self._stream = open_stream(dict(cast))
        self._clock = clock
        self._latency = latency
        self._meter = Meter()
        self._trouble = ""
        self._told_ns = clock.now_ns()

    @property
    def poses(self) -> int:
        """Instants sent so far."""
        return self._meter.total

    @property
    def poses_per_s(self) -> float:
        """Instants sent, over the last seconds."""
        return self._meter.rate_hz(self._clock.now_ns())

    def where(self) -> dict[str, str]:
        """Address per person, where persons have addresses of their own."""
        return self._stream.where()

    def stream_status(self) -> StreamStatus:
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
        now_ns = self._clock.now_ns()
        self._meter.add(now_ns)
        self._latency.sent(timestamp_ns, handed_ns, now_ns)
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
            now_ns = self._clock.now_ns()
            if now_ns - self._told_ns < _NEWS_EVERY_NS:
                return
            if all(_alike(shape, self._cast[name]) for name, shape in known.items()):
                return
            self._told_ns = now_ns
        self._cast = known
        self._stream.set_cast(dict(known))


def _alike(a: BodyShape, b: BodyShape) -> bool:
    return a is b or bool(np.all(np.abs(a.offsets_m - b.offsets_m) < _SAME_BODY_M))
