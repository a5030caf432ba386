"""Recorded or simulated sessions as the events of a live run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from fusecap.engine.engine import Engine, LiveStep
from fusecap.setup import SessionSetup
from fusecap.sources.session_data import SessionData
from fusecap.sources.session_sensors import open_imus
from fusecap.types import CameraSample, Event, ImuSample, Tick

Sample = CameraSample | ImuSample


def samples_of(data: SessionData) -> list[Sample]:
    """All samples in the order of their times."""
    samples: list[Sample] = [
        CameraSample(camera=camera, timestamp_ns=round(float(time_s) * 1e9), people=people)
        for camera, track in enumerate(data.keypoints)
        for time_s, people in zip(track.times_s, track.people, strict=True)
    ]
    for subject in data.session.subjects:
        for imu, track in zip(subject.imus, open_imus(subject), strict=True):
            samples += [
                ImuSample(
                    subject=subject.name,
                    bone=imu.bone,
                    timestamp_ns=round(float(time_s) * 1e9),
                    orientation_wxyz=orientation,
                    accel_m_s2=accel,
                )
                for time_s, orientation, accel in zip(
                    track.times_s, track.orientation_wxyz, track.accel_m_s2, strict=True
                )
            ]
    return sorted(samples, key=lambda sample: sample.timestamp_ns)


def ticks_of(data: SessionData) -> list[Tick]:
    """The instants of the offline solve."""
    return [Tick(timestamp_ns=int(t)) for t in data.timestamps_ns]


def merged(
    samples: Iterable[Sample],
    ticks: Iterable[Tick],
    *,
    delay_s: float = 0.1,
    arrival_ns: Callable[[Sample], int] = lambda sample: sample.timestamp_ns,
) -> list[Event]:
    """Samples as they arrive, each tick `delay_s` after its instant."""
    due = [(arrival_ns(sample), 0, sample) for sample in samples]
    due += [(tick.timestamp_ns + round(delay_s * 1e9), 1, tick) for tick in ticks]
    return [event for *_, event in sorted(due, key=lambda item: item[:2])]


def setup_for(data: SessionData) -> SessionSetup:
    assert data.landmarks is not None
    return SessionSetup(
        session=data.session, rig=data.rig, landmarks=data.landmarks, simulated=True
    )


def steps_of(engine: Engine, events: Iterable[Event]) -> Iterator[LiveStep]:
    for event in events:
        step = engine.take(event)
        if step is not None:
            yield step


def same_bits(a: LiveStep, b: LiveStep) -> bool:
    """Whether two steps agree in every pose they send."""
    if a.timestamp_ns != b.timestamp_ns or list(a.people) != list(b.people):
        return False
    for name, first in a.people.items():
        second = b.people[name]
        if first is None or second is None:
            if first is not second:
                return False
            continue
        if not (
            np.array_equal(first.theta, second.theta)
            and np.array_equal(first.bone_position_in_world_m, second.bone_position_in_world_m)
            and np.array_equal(first.bone_rotation_in_world, second.bone_rotation_in_world)
            and np.array_equal(first.bone_quality, second.bone_quality)
        ):
            return False
    return True
