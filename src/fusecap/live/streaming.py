"""A live run's poses on their way to its streams."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.engine.engine import LiveStep
from fusecap.live.devices.source import SessionClock
from fusecap.live.latency import LatencyBook
from fusecap.live.status import LiveStatus
from fusecap.setup import SessionSetup
from fusecap.streams.output import StreamStatus
from fusecap.streams.person_pose import pose_of_estimate
from fusecap.streams.process import StreamProcess
from fusecap.streams.stream import Cast
from fusecap.streams.target import Target
from fusecap.types import CameraImage, Event


def first_cast(setup: SessionSetup) -> Cast:
    """The session's people with the bodies known so far, before anyone is found."""
    skeleton = setup.session.skeleton
    return {
        subject.name: BodyShape.from_height(
            skeleton, subject.height_m or REFERENCE_HEIGHT_M
        ).with_lengths(subject.bone_lengths_m)
        for subject in setup.session.subjects
    }


class Streaming:
    """A `Listener` that sends every instant to the process of the streams."""

    def __init__(
        self,
        targets: Sequence[Target],
        setup: SessionSetup,
        rate_hz: float,
        clock: SessionClock,
        latency: LatencyBook,
        report: Callable[[str], None],
    ) -> None:
        """`report` hears of trouble. Raises `InputError` where a stream cannot be opened."""
        self._process = StreamProcess(
            targets, first_cast(setup), rate_hz, clock.now_ns, latency.sent, report
        )

    @property
    def addresses(self) -> tuple[dict[str, str], ...]:
        """Of each stream, where it is sent to: per person, or to everyone."""
        return tuple(
            addresses or {"everyone": status.to}
            for addresses, status in zip(
                self._process.addresses, self._process.statuses(), strict=True
            )
        )

    @property
    def down(self) -> bool:
        """Nothing is sent now: the process has ended, and none has taken its place yet."""
        return self._process.gone

    @property
    def poses(self) -> float:
        """Instants sent so far, the mean of the streams."""
        return sum(self._process.poses) / len(self._process.poses)

    def stream_statuses(self) -> tuple[StreamStatus, ...]:
        """How each stream goes."""
        return self._process.statuses()

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """Streams send poses only."""

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """Leave the instant's poses for the streams."""
        poses = {name: one and pose_of_estimate(one) for name, one in step.people.items()}
        self._process.send(poses, step.timestamp_ns, now_ns)

    def on_image(self, image: CameraImage) -> None:
        """Streams send poses only."""

    def on_status(self, status: LiveStatus) -> None:
        """Streams send poses only."""

    def close(self) -> None:
        """Send what waits, and end the process."""
        self._process.close()
