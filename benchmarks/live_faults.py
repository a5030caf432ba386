"""What goes wrong with live inputs, on purpose: sources and detectors that fail on a schedule.

A fault acts on one source (or all) from `start_s` for `length_s` of the run, seeded, so that a run
with faults can be repeated. Real devices do all of this by themselves.
"""

from __future__ import annotations

import enum
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.detector import Detector
from fusecap.live.devices.source import (
    Deliver,
    Delivery,
    SessionClock,
    Source,
    SourceCounts,
    SourceLost,
)
from fusecap.types import CameraSample, ImuSample


class FaultKind(enum.Enum):
    """What happens, and what `Fault.amount` means."""

    STALL = "stall"
    """Nothing arrives, and nothing is made up for afterwards."""
    DEATH = "death"
    """`SourceLost`, also when opened again."""
    LOSS = "loss"
    """Items are left out; amount: share."""
    DOUBLE = "double"
    """Items come twice; amount: share."""
    DISORDER = "disorder"
    """Items come after their successor; amount: share."""
    CLOCK_JUMP = "clock jump"
    """Timestamps are off; amount: by how much [s], negative into the past."""
    NOT_A_NUMBER = "not a number"
    """Measured values are NaN; amount: share."""
    RAISE = "raise"
    """Of a detector: it raises; amount: share."""
    SLOW = "slow"
    """Of a detector: it takes longer; amount: by how much [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One thing that goes wrong for a while."""

    kind: FaultKind
    where: str = ""
    """A source's name, "subject/bone" for one sensor of a source with several, "detector"; empty:
    all."""
    start_s: float = 0.0
    """Since the run began."""
    length_s: float = float("inf")
    amount: float = 1.0

    @property
    def end_s(self) -> float:
        """When all is well again."""
        return self.start_s + self.length_s

    def acts(self, now_s: float, *names: str) -> bool:
        """Whether it acts now on something of these names."""
        return self.start_s <= now_s < self.end_s and (not self.where or self.where in names)


class FaultySource:
    """A source that delivers what another does, with faults."""

    def __init__(
        self, source: Source, faults: Sequence[Fault], clock: SessionClock, seed: int = 0
    ) -> None:
        self._source = source
        self._faults = tuple(faults)
        self._clock = clock
        self._rng = np.random.default_rng(seed)

    @property
    def name(self) -> str:
        """Of the source itself."""
        return self._source.name

    @property
    def counts(self) -> SourceCounts:
        """Of the source itself: faults happen on the way."""
        return self._source.counts

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """As the source does, until a fault ends it with `SourceLost`."""
        self._die(self._acting(self.name))
        late: list[Delivery] = []

        def pass_on(item: Delivery) -> None:
            acting = self._acting(self.name, _sensor(item))
            self._die(acting)
            held, late[:] = late.copy(), []
            items = [item]
            for fault in acting:
                items = [out for one in items for out in self._changed(one, fault, late)]
            for one in (*items, *held):
                deliver(one)

        self._source.run(pass_on, stopping)

    def _acting(self, *names: str) -> list[Fault]:
        now_s = self._clock.now_ns() * 1e-9
        return [fault for fault in self._faults if fault.acts(now_s, *names)]

    def _die(self, acting: Sequence[Fault]) -> None:
        if any(fault.kind is FaultKind.DEATH for fault in acting):
            raise SourceLost(f"{self.name}: gone, as a fault demands; it will come back")

    def _changed(self, item: Delivery, fault: Fault, late: list[Delivery]) -> list[Delivery]:
        if fault.kind is FaultKind.STALL:
            return []
        if fault.kind is FaultKind.CLOCK_JUMP:
            stamp_ns = item.timestamp_ns + round(fault.amount * 1e9)
            return [replace(item, timestamp_ns=stamp_ns)]
        if self._rng.random() >= fault.amount:
            return [item]
        if fault.kind is FaultKind.LOSS:
            return []
        if fault.kind is FaultKind.DOUBLE:
            return [item, item]
        if fault.kind is FaultKind.DISORDER:
            late.append(item)
            return []
        if fault.kind is FaultKind.NOT_A_NUMBER:
            return [_unmeasured(item)]
        return [item]


def _sensor(item: Delivery) -> str:
    return f"{item.subject}/{item.bone}" if isinstance(item, ImuSample) else ""


def _unmeasured(item: Delivery) -> Delivery:
    if isinstance(item, ImuSample):
        return replace(item, orientation_wxyz=np.full(4, np.nan), accel_m_s2=np.full(3, np.nan))
    if isinstance(item, CameraSample):
        return replace(item, people=np.full_like(item.people, np.nan))
    return item


class FaultyDetector:
    """A detector that now and then raises, or takes long."""

    def __init__(
        self,
        detector: Detector,
        faults: Sequence[Fault],
        clock: SessionClock,
        seed: int = 0,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._detector = detector
        self._faults = tuple(faults)
        self._clock = clock
        self._rng = np.random.default_rng(seed)
        self._sleep = sleep

    @property
    def landmarks(self) -> LandmarkSet:
        """What the keypoints are."""
        return self._detector.landmarks

    @property
    def identity(self) -> str:
        """That of the detector itself."""
        return self._detector.identity

    def detect(
        self,
        images: Sequence[UInt8[np.ndarray, "h w 3"] | None],
        predicted: Sequence[Float[np.ndarray, "m k 3"]],
    ) -> tuple[Float[np.ndarray, "n k 3"], ...]:
        """As the detector does; raises `RuntimeError`, as a network's runtime would."""
        now_s = self._clock.now_ns() * 1e-9
        for fault in self._faults:
            if not fault.acts(now_s, "detector"):
                continue
            if fault.kind is FaultKind.SLOW:
                self._sleep(fault.amount)
            elif fault.kind is FaultKind.RAISE and self._rng.random() < fault.amount:
                raise RuntimeError("the network failed, as a fault demands")
        return self._detector.detect(images, predicted)

    def reset(self) -> None:
        """Forget earlier instants."""
        self._detector.reset()


def with_faults(
    sources: Sequence[Source], faults: Sequence[Fault], clock: SessionClock, seed: int = 0
) -> list[Source]:
    """The sources, each with those of the faults that may touch it."""
    return [
        FaultySource(source, faults, clock, seed=seed + index)
        for index, source in enumerate(sources)
    ]
