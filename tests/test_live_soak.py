"""Two minutes in which everything goes wrong that can (benchmarks/live_soak.py).

Once without a clock, where what must come of it is certain, and once as a real run with threads,
sockets and files, where only what no slow machine excuses is asked for.
"""

from __future__ import annotations

import importlib.util
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_faults import Fault, with_faults

from fusecap.engine.engine import Engine, LiveStep
from fusecap.live.devices.playback_sources import PlaybackOptions, playback_sources
from fusecap.live.devices.source import SessionClock, Source, SourceLost
from fusecap.live.run import SOONEST_NS
from fusecap.setup import session_setup
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take
from fusecap.types import Event, Tick

SECONDS = 120.0
DELAY_NS = 50_000_000
PAUSE_NS = 500_000_000
"""After which a lost source is opened again."""


@pytest.fixture(scope="module")
def soak() -> Any:
    """The benchmark."""
    path = Path(__file__).resolve().parents[1] / "benchmarks" / "live_soak.py"
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def session_path(soak, tmp_path_factory) -> Path:
    return soak.simulated_session(tmp_path_factory.mktemp("soak"))


class Clock(SessionClock):
    """Time passes where somebody waits."""

    def __init__(self) -> None:
        self.ns = 0

    def now_ns(self) -> int:
        return self.ns


class Stopping(threading.Event):
    """Waiting takes no time on the wall."""

    def __init__(self, clock: Clock, until_ns: float) -> None:
        super().__init__()
        self._clock = clock
        self._until_ns = until_ns

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self._clock.ns += round(timeout * 1e9)
        return self._clock.ns >= self._until_ns


def arrivals(source: Source, clock: Clock, until_ns: float) -> list[tuple[int, Event]]:
    """All that a run takes of a source, in order of arrival; opened again when it is lost."""
    clock.ns = 0
    items: list[tuple[int, Any]] = []
    stopping = Stopping(clock, until_ns)
    while True:
        try:
            source.run(lambda item: items.append((clock.ns, item)), stopping)
            return [(ns, item) for ns, item in items if item.timestamp_ns <= ns + SOONEST_NS]
        except SourceLost:
            clock.ns += PAUSE_NS


def events_of(path: Path, faults: Sequence[Fault], seconds: float) -> list[Event]:
    """A run's events with ticks at 60 Hz, each `DELAY_NS` after its instant."""
    clock = Clock()
    played = playback_sources(load_session(path), clock, PlaybackOptions(there_and_back=True))
    arrived: list[tuple[int, Event]] = []
    for source in with_faults(played, faults, clock):
        arrived += arrivals(source, clock, 1e9 * seconds)
    for instant in range(1, round(60 * seconds)):
        stamp_ns = round(1e9 * instant / 60)
        arrived.append((stamp_ns + DELAY_NS, Tick(timestamp_ns=stamp_ns)))
    return [event for _, event in sorted(arrived, key=lambda item: item[0])]


def steps_of(path: Path, events: Sequence[Event]) -> list[LiveStep]:
    engine = Engine(session_setup(load_session(path), simulated=True))
    steps = [engine.take(event) for event in events]
    return [step for step in steps if step is not None]


@pytest.mark.slow
def test_everyone_is_back_within_two_seconds_of_each_fault_and_nobody_jumps(soak, session_path):
    everything = soak.schedule(SECONDS, seed=0)
    faults = [fault for fault in everything if fault.where != "detector"]
    assert len({(fault.kind, fault.where) for fault in faults}) >= 12
    steps = steps_of(session_path, events_of(session_path, soak.for_sources(faults), SECONDS))
    watch = soak.Watch(["anna", "ben"], SECONDS)
    for step in steps:
        watch.on_step(step, 0)
    error_m = soak.truth_error_m(watch, load_take(session_path.parent / "truth.npz"), 0)
    late = [
        r
        for r in soak.recoveries(watch, faults, error_m)
        if r.recovered_s is None or r.recovered_s > 2.0
    ]
    assert not late
    assert soak.longest_wrong_s(watch, error_m) < 2.0
    assert watch.not_finite == 0
    assert watch.worst_jump_m() < soak.JUMP_M
    assert float(np.median(error_m)) < 0.05


@pytest.mark.slow
def test_replay_of_a_run_with_faults_is_the_same_bit_for_bit(soak, session_path):
    faults = [fault for fault in soak.schedule(40.0, seed=1) if fault.where != "detector"]
    events = events_of(session_path, soak.for_sources(faults), 15.0)
    for first, second in zip(
        steps_of(session_path, events), steps_of(session_path, events), strict=True
    ):
        assert first.people.keys() == second.people.keys()
        for name, person in first.people.items():
            other = second.people[name]
            assert (person is None) == (other is None)
            if person is not None and other is not None:
                np.testing.assert_array_equal(person.theta, other.theta)
                np.testing.assert_array_equal(person.bone_quality, other.bone_quality)


@pytest.mark.slow
def test_run_survives_two_minutes_of_faults(soak):
    """How soon people are back depends on the machine; that they are in the end does not."""
    report = soak.soak(SECONDS, seed=2)
    assert report.failed(recover_s=np.inf, lasting=False) == []
    assert report.live.detector_failures > 0
    assert report.well_at_the_end
