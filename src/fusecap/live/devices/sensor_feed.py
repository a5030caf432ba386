"""One live sensor: its samples in the session's words and on the session's clock."""

from __future__ import annotations

from fusecap.live.devices.clock_map import ClockMap
from fusecap.sources.live_sensor import SensorSample
from fusecap.types import ImuSample


class SensorFeed:
    """Knows which bone carries a sensor, and follows that sensor's clock."""

    def __init__(self, *, subject: str, bone: str, offset_s: float = 0.0) -> None:
        """`offset_s` is added to its times."""
        self.subject = subject
        self.bone = bone
        self.clock = ClockMap()
        self._offset_ns = round(offset_s * 1e9)
        self._before: tuple[int | None, int | None] = (None, None)

    def take(
        self, sample: SensorSample, arrival_ns: int, *, synchronised: bool = False
    ) -> ImuSample | None:
        """None for a sample that comes late or double.

        A stamp that stands still while the sender counts on (MVN when it does not record) is none.
        """
        counter, stamp_ns = self._before
        self._before = sample.counter, sample.stamp_ns
        still = sample.stamp_ns == stamp_ns and sample.counter is not None
        if still and sample.counter == counter:
            return None
        time_ns = self.clock.session_ns(
            None if still else sample.stamp_ns, arrival_ns, synchronised=synchronised
        )
        if time_ns is None:
            return None
        return ImuSample(
            subject=self.subject,
            bone=self.bone,
            timestamp_ns=time_ns + self._offset_ns,
            orientation_wxyz=sample.orientation_wxyz,
            accel_m_s2=sample.accel_m_s2,
        )
