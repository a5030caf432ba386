"""The first pass over recorded instants: who is who, and a pose each to begin with.

Sorts and solves every instant, each alone, and learns the bodies of people nobody measured.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from fusecap.associate.sensor_vote import SensorVote
from fusecap.batch.assignments import Assignments
from fusecap.body.shape import BodyShape
from fusecap.pipeline import Pipeline, worn_sensors
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.types import Detections, ImuReading

SEEDING_WINDOW = 4
"""Instants solved together where no camera sees somebody: one alone would stay where it is, and a
long window would not find out that people walk."""


@runtime_checkable
class Instants(Protocol):
    """Recorded measurements on the solve's instants."""

    def __len__(self) -> int: ...

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera."""
        ...

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        """By subject name, what its sensors say."""
        ...


@dataclass(frozen=True, kw_only=True)
class Sorted:
    """What the first pass leaves, `Assignments` aside."""

    shapes: dict[str, BodyShape]
    """Of everybody who was followed."""
    interrupted: bool
    notes: tuple[str, ...]


def sort_instants(
    setup: Setup, instants: Instants, assigned: Assignments, progress: Progress | None
) -> Sorted:
    """Fill `assigned`; Ctrl-C ends it at the instant it had reached."""
    window = min(setup.options.window, SEEDING_WINDOW)
    options = replace(setup.options, window=window, seeding=True)
    pipeline = Pipeline(replace(setup, options=options))
    notes: list[str] = []
    moved: list[tuple[int, Mapping[str, str]]] = []
    interrupted = False
    try:
        for instant in range(len(instants)):
            step = pipeline.step(instants.detections(instant), instants.readings(instant))
            assigned.add(step.updates, step.estimates)
            notes += [f"{instant / setup.rate_hz:.2f} s: {note}" for note in step.notes]
            moved += [(instant, step.paired_anew)] if step.paired_anew else []
            if progress:
                progress("sorting", instant + 1, len(instants))
    except KeyboardInterrupt:
        interrupted = True
    assigned.settle()
    vote = SensorVote(setup.landmarks, worn_sensors(setup))
    for instant, former in moved:
        _rename_before(assigned, instant, former, instants, vote)
    _drop_tails(assigned, instants)
    return Sorted(
        shapes={name: pipeline.estimator(name).shape for name in assigned.names},
        interrupted=interrupted,
        notes=tuple(notes),
    )


def _rename_before(
    assigned: Assignments,
    instant: int,
    former: Mapping[str, str],
    instants: Instants,
    vote: SensorVote,
) -> None:
    """Who turned out at an instant to be somebody else was so before: back to when it began.

    That is the instant from which the new names, until then, fit the sensors better by most.
    Nothing changes where one of them was a bystander, of whom no instant was kept.
    """
    if not all(former.values()):
        return
    gain = most = 0.0
    since = instant
    for row in range(instant - 1, -1, -1):
        readings = instants.readings(row)
        points = {one.update.name: one.update.landmarks_in_world_m for one in assigned[row]}
        for name, before in former.items():
            if name in readings and name in points and before in points:
                both = np.stack([points[name], points[before]])
                away = vote.away(both, name, readings[name])
                if away is not None and np.isfinite(away).all():
                    gain += float(away[0] - away[1])
        if gain >= most:
            most, since = gain, row
    now = {before: name for name, before in former.items()}
    for row in range(since, instant):
        assigned.rename(row, now)


def _drop_tails(assigned: Assignments, instants: Instants) -> None:
    """Nobody is followed after the last instant in which a camera or a sensor told of them.

    Between two such instants motion bridges a gap; after the last nothing says where they are.
    """
    going_on: set[str] = set()
    for instant in range(len(assigned) - 1, -1, -1):
        here, readings = assigned.here(instant), instants.readings(instant)
        going_on &= set(here)
        going_on |= {name for name, seen in here.items() if seen or _tells(readings.get(name))}
        assigned.keep(instant, going_on)


def _tells(reading: ImuReading | None) -> bool:
    return reading is not None and bool(np.isfinite(reading.bone_rotation_in_world).any())
