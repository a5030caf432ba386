"""A simulated live run with everything a recording may hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from fusecap.engine.engine import Engine, LiveStep
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.recording.setup_json import setup_values
from fusecap.recording.writer import RecordingWriter
from fusecap.setup import SessionSetup
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.types import Command, CommandKind, Event
from live_events import merged, samples_of, setup_for, ticks_of

UNIX_NS = 1_700_000_000_000_000_000
Taken = tuple[Event, LiveStep | None]


def simulated_run(folder: Path, *, seconds: float = 1.0) -> tuple[SessionSetup, list[Taken]]:
    """Four cameras, two people with 13 sensors each, samples that come late and twice."""
    rng = np.random.default_rng(5)
    data = open_session(load_session(write_session(demo_scene(seconds=seconds), folder)))
    samples = samples_of(data)
    samples += [samples[i] for i in rng.integers(len(samples), size=20)]
    late_ns = {id(sample): int(rng.integers(0, 150_000_000)) for sample in samples}
    events = merged(
        samples,
        ticks_of(data),
        arrival_ns=lambda sample: sample.timestamp_ns + late_ns[id(sample)],
    )
    events.insert(len(events) // 2, Command(kind=CommandKind.REINITIALISE, subject="anna"))
    setup = setup_for(data)
    engine = Engine(setup)
    return setup, [(event, engine.take(event)) for event in events]


def record(
    file: BinaryIO,
    setup: SessionSetup,
    taken: Sequence[Taken],
    *,
    flush_every: int = 500,
    finish: bool = True,
    from_start: bool = True,
) -> None:
    """As a run would, with the samples' own times for arrivals."""
    writer = RecordingWriter(
        file,
        setup_values(setup),
        cameras=setup.rig.names,
        unix_minus_session_ns=UNIX_NS,
        from_start=from_start,
    )
    for index, (event, step) in enumerate(taken):
        arrival_ns = 0 if isinstance(event, Command) else event.timestamp_ns
        writer.event(event, arrival_ns)
        if step is not None:
            people = [person for person in step.people.values() if person is not None]
            writer.poses(people, arrival_ns)
        if index % flush_every == flush_every - 1:
            writer.flush()
    if finish:
        writer.finish()


def same_event(a: Event, b: Event) -> bool:
    """Whether two events are of one kind and agree in every bit."""
    if type(a) is not type(b):
        return False
    for name in a.__slots__:
        first, second = getattr(a, name), getattr(b, name)
        if isinstance(first, np.ndarray):
            if first.shape != second.shape or not np.array_equal(first, second, equal_nan=True):
                return False
            if (np.signbit(first) != np.signbit(second))[~np.isnan(first)].any():
                return False
        elif first != second:
            return False
    return True
