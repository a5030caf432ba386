"""How long things take, in bounded memory: histograms with bins that grow by 6 %.

    exposure ─▶ arrival ─▶ detection ─▶ sample ─▶ solve ─▶ pose ─▶ packet

A quantile is off by half a bin, 3 %, at most.
"""

from __future__ import annotations

import math
import threading
from collections import deque

from fusecap.live.status import StageLatency
from fusecap.types import CameraSample, ImuSample

CAMERA = "camera: exposure to arrival"
SENSOR = "sensor: sample to arrival"
WAIT_FOR_DETECTOR = "arrival to detection"
DETECTION = "detection"
LAST_SAMPLE_TO_SOLVE = "last sample to solve"
SOLVE = "solve"
SEND = "encode and send"
EXPOSURE_TO_POSE = "exposure to pose"
EXPOSURE_TO_PACKET = "exposure to packet"
LAST_SAMPLE_TO_PACKET = "last sample to packet"
STAGES = (
    CAMERA,
    SENSOR,
    WAIT_FOR_DETECTOR,
    DETECTION,
    LAST_SAMPLE_TO_SOLVE,
    SOLVE,
    SEND,
    EXPOSURE_TO_POSE,
    EXPOSURE_TO_PACKET,
    LAST_SAMPLE_TO_PACKET,
)
_LEAST_S = 1e-5
_BINS_PER_DECADE = 40
_BINS = 7 * _BINS_PER_DECADE
"""10 us to 100 s."""
_REMEMBERED_INSTANTS = 256
_STALE_NS = 500_000_000


class Histogram:
    """Counts of durations."""

    def __init__(self) -> None:
        self._bins = [0] * _BINS

    def add(self, seconds: float) -> None:
        """Anything below 10 us, a negative time included, counts as that."""
        index = 0
        if seconds > _LEAST_S:
            index = min(int(_BINS_PER_DECADE * math.log10(seconds / _LEAST_S)), _BINS - 1)
        self._bins[index] += 1

    @property
    def count(self) -> int:
        """Of durations."""
        return sum(self._bins)

    def plus(self, other: Histogram) -> Histogram:
        """Both together."""
        both = Histogram()
        both._bins = [a + b for a, b in zip(self._bins, other._bins, strict=True)]
        return both

    def quantile_s(self, share: float) -> float:
        """The middle of the bin it falls into; 0 where nothing was counted."""
        wanted = share * self.count
        seen = 0
        for index, count in enumerate(self._bins):
            seen += count
            if count and seen >= wanted:
                return _LEAST_S * 10.0 ** ((index + 0.5) / _BINS_PER_DECADE)
        return 0.0


class LatencyBook:
    """Every stage's durations, over the last seconds and over all; used by many threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._all = {stage: Histogram() for stage in STAGES}
        self._recent = {stage: Histogram() for stage in STAGES}
        self._before = {stage: Histogram() for stage in STAGES}
        self._last_arrival_ns: dict[int, int] = {}

    def add(self, stage: str, duration_ns: int) -> None:
        """One more duration of a stage."""
        with self._lock:
            self._add(stage, duration_ns)

    def solved(self, timestamp_ns: int, last_arrival_ns: int | None) -> None:
        """An instant was solved from samples of which the last came then."""
        with self._lock:
            if last_arrival_ns is not None:
                self._last_arrival_ns[timestamp_ns] = last_arrival_ns
            while len(self._last_arrival_ns) > _REMEMBERED_INSTANTS:
                del self._last_arrival_ns[next(iter(self._last_arrival_ns))]

    def sent(self, timestamp_ns: int, taken_ns: int, sent_ns: int) -> None:
        """The pose of an instant was taken by a stream, and handed to the system."""
        with self._lock:
            self._add(SEND, sent_ns - taken_ns)
            self._add(EXPOSURE_TO_PACKET, sent_ns - timestamp_ns)
            last_arrival_ns = self._last_arrival_ns.get(timestamp_ns)
            if last_arrival_ns is not None:
                self._add(LAST_SAMPLE_TO_PACKET, sent_ns - last_arrival_ns)

    def roll(self) -> None:
        """Forget the older half of the window; called every few seconds."""
        with self._lock:
            self._before = self._recent
            self._recent = {stage: Histogram() for stage in STAGES}

    def window(self) -> tuple[StageLatency, ...]:
        """Since the roll before the last; stages that happened."""
        with self._lock:
            both = {stage: self._recent[stage].plus(self._before[stage]) for stage in STAGES}
        return _summary(both)

    def total(self) -> tuple[StageLatency, ...]:
        """Since the start."""
        with self._lock:
            copies = {stage: self._all[stage].plus(Histogram()) for stage in STAGES}
        return _summary(copies)

    def _add(self, stage: str, duration_ns: int) -> None:
        self._all[stage].add(1e-9 * duration_ns)
        self._recent[stage].add(1e-9 * duration_ns)


def _summary(histograms: dict[str, Histogram]) -> tuple[StageLatency, ...]:
    return tuple(
        StageLatency(
            stage=stage,
            p50_ms=1e3 * histogram.quantile_s(0.5),
            p95_ms=1e3 * histogram.quantile_s(0.95),
            p99_ms=1e3 * histogram.quantile_s(0.99),
            count=histogram.count,
        )
        for stage, histogram in histograms.items()
        if histogram.count
    )


class Arrivals:
    """When the samples came that an instant is interpolated from; used by one thread."""

    def __init__(self) -> None:
        self._samples: dict[int | tuple[str, str], deque[tuple[int, int]]] = {}

    def note(self, sample: CameraSample | ImuSample, arrival_ns: int) -> None:
        """A sample has been taken."""
        key = sample.camera if isinstance(sample, CameraSample) else (sample.subject, sample.bone)
        samples = self._samples.setdefault(key, deque(maxlen=64))
        samples.append((sample.timestamp_ns, arrival_ns))

    def instant(self, timestamp_ns: int) -> tuple[int | None, set[int]]:
        """When the last sample it needs came, and which cameras have samples on both sides of it.

        None where no source is fresh, or a fresh one has nothing from the instant or later: then
        the instant has waited in vain. Instants only go forward.
        """
        last: int | None = None
        in_vain = False
        both_sides = set()
        for key, samples in self._samples.items():
            while len(samples) > 1 and samples[1][0] <= timestamp_ns:
                samples.popleft()
            after = samples[1] if samples[0][0] < timestamp_ns and len(samples) > 1 else samples[0]
            if after[0] < timestamp_ns - _STALE_NS:
                continue
            in_vain = in_vain or after[0] < timestamp_ns
            last = after[1] if last is None else max(last, after[1])
            before_ns = samples[0][0]
            around = timestamp_ns - _STALE_NS <= before_ns <= timestamp_ns <= after[0]
            if isinstance(key, int) and around:
                both_sides.add(key)
        return None if in_vain else last, both_sides
