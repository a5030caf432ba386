"""Sensors in a stream of the Lab Streaming Layer; needs the extra `lsl`."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from typing import Any

from fusecap.errors import InputError, from_extra
from fusecap.live.devices.sensor_feed import SensorFeed
from fusecap.live.devices.source import Deliver, SessionClock, SourceCounts, SourceLost
from fusecap.sources.imu_streams.lsl import MAX_CHANNELS, SensorChannels, sensor_channels
from fusecap.sources.live_sensor import Refused

RESOLVE_S = 1.0
SILENCE_S = 2.0
"""Without a sample for this long the stream is looked for again."""
_PULL_S = 0.1
_CHUNK = 256


class LslImus:
    """Reads one stream; `sensors` are the names after the slash, empty for the only one."""

    def __init__(
        self, *, stream: str, sensors: Mapping[str, Sequence[SensorFeed]], clock: SessionClock
    ) -> None:
        """Raises `InputError` where the extra is missing."""
        self._lsl = _pylsl()
        self._stream = stream
        self._sensors = sensors
        self._clock = clock
        self._counts = SourceCounts()

    @property
    def name(self) -> str:
        """Of the stream."""
        return f"imus lsl:{self._stream}"

    @property
    def counts(self) -> SourceCounts:
        """What came in so far."""
        return self._counts

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """Raises `SourceLost` where the stream is not there, falls silent or has other channels."""
        lsl = self._lsl
        found = lsl.resolve_byprop("name", self._stream, 1, RESOLVE_S)
        if not found:
            raise SourceLost(
                f"{self.name}: no stream of this name; start its sender, and check that both "
                "machines are in one network"
            )
        inlet = lsl.StreamInlet(
            found[0], max_buflen=5, recover=False, processing_flags=lsl.proc_clocksync
        )
        try:
            self._read(inlet, self._plans(inlet), deliver, stopping)
        except RuntimeError as error:  # the root of all that pylsl raises
            raise SourceLost(f"{self.name}: its sender is gone ({error})") from None
        finally:
            inlet.close_stream()

    def _plans(self, inlet: Any) -> list[tuple[SensorChannels, Sequence[SensorFeed]]]:
        info = inlet.info(timeout=SILENCE_S)
        if info.channel_format() == self._lsl.cf_string:
            raise SourceLost(f"{self.name}: its channels are texts, expected numbers")
        labels, units = _described(info)
        try:
            return [
                (sensor_channels(self._stream, labels, units, sensor), feeds)
                for sensor, feeds in self._sensors.items()
            ]
        except InputError as error:
            raise SourceLost(str(error)) from None

    def _read(
        self,
        inlet: Any,
        plans: Sequence[tuple[SensorChannels, Sequence[SensorFeed]]],
        deliver: Deliver,
        stopping: threading.Event,
    ) -> None:
        heard_ns = self._clock.now_ns()
        while not stopping.is_set():
            row, stamp_s = inlet.pull_sample(timeout=_PULL_S)
            now_ns = self._clock.now_ns()
            if row is None:
                if now_ns - heard_ns > SILENCE_S * 1e9:
                    raise SourceLost(f"{self.name}: nothing for {SILENCE_S:g} s")
                continue
            heard_ns = now_ns
            session_from_lsl_ns = now_ns - round(self._lsl.local_clock() * 1e9)
            more, more_stamps_s = inlet.pull_chunk(timeout=0.0, max_samples=_CHUNK)
            for values, at_s in zip((row, *more), (stamp_s, *more_stamps_s), strict=True):
                self._take(plans, values, round(at_s * 1e9) + session_from_lsl_ns, now_ns, deliver)

    def _take(
        self,
        plans: Sequence[tuple[SensorChannels, Sequence[SensorFeed]]],
        values: Sequence[float],
        stamp_ns: int,
        arrival_ns: int,
        deliver: Deliver,
    ) -> None:
        counts = self._counts
        for channels, feeds in plans:
            try:
                sample = channels.sample(values, stamp_ns)
            except Refused as error:
                counts.malformed += 1
                counts.note = f"refused: {channels.sensor}: {error}"
                continue
            for feed in feeds:
                taken = feed.take(sample, arrival_ns, synchronised=True)
                if taken is None:
                    counts.dropped += 1
                    continue
                counts.received += 1
                deliver(taken)


def _described(info: Any) -> tuple[list[str], list[str]]:
    """Labels and units of all channels; empty texts where the stream says nothing."""
    count = min(info.channel_count(), MAX_CHANNELS + 1)
    labels, units = [], []
    channel = info.desc().child("channels").child("channel")
    for _ in range(count):
        labels.append(channel.child_value("label"))
        units.append(channel.child_value("unit"))
        channel = channel.next_sibling("channel")
    return labels, units


def _pylsl() -> Any:
    try:
        import pylsl
    except ImportError:
        raise InputError(f'live = "lsl:..." needs pylsl; {from_extra("lsl")}') from None
    except RuntimeError as error:
        raise InputError(f'live = "lsl:...": the LSL library cannot be loaded ({error})') from error
    return pylsl
