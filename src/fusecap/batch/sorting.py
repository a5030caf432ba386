"""The first pass over recorded instants: who is who, and a pose each to begin with.

Sorts and solves every instant, each alone, and learns the bodies of people nobody measured.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from fusecap.associate.sensor_vote import FITS, SensorVote
from fusecap.batch.assignments import Assignments
from fusecap.believable import tells
from fusecap.body.shape import BodyShape
from fusecap.interrupts import Interruption
from fusecap.pipeline import Pipeline, Step, worn_sensors
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.types import Detections, ImuReading

SEEDING_WINDOW = 4
"""Instants solved together where few cameras see somebody: where none does, one alone would stay
where it is, and a long window would not find out that people walk."""


SURE = 60.0
"""Of what sensors fit worse, summed over instants: for a second or two nobody was exchanged."""


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
    begun: Mapping[int, Collection[str]]
    """By instant, who must be found there anew: until then somebody else was followed."""
    found_anew: Mapping[str, int]
    """How often somebody's pose did not fit and was found anew."""
    notes: tuple[str, ...]


def sort_instants(
    setup: Setup,
    instants: Instants,
    assigned: Assignments,
    progress: Progress | None,
    stop: Interruption,
) -> Sorted:
    """Fill `assigned`; Ctrl-C ends it at the instant it had reached."""
    window = min(setup.options.window, SEEDING_WINDOW)
    options = replace(setup.options, window=window, seeding=True)
    pipeline = Pipeline(replace(setup, options=options))
    notes: list[str] = []
    moved: list[tuple[int, Step]] = []
    found_anew: dict[str, list[float]] = {}
    for instant in range(len(instants)):
        if stop.asked:
            break
        step = pipeline.step(instants.detections(instant), instants.readings(instant))
        assigned.add([*step.updates, *step.bystanders], step.estimates)
        notes += [f"{instant / setup.rate_hz:.2f} s: {note}" for note in step.notes]
        moved += [(instant, step)] if step.renumbered or step.returned or step.found_anew else []
        for name in step.found_anew:
            found_anew.setdefault(name, []).append(instant / setup.rate_hz)
        if progress:
            progress("sorting", instant + 1, len(instants))
    vote = SensorVote(setup.landmarks, worn_sensors(setup))
    begun: dict[int, set[str]] = {}
    for instant, step in moved:
        names = {u.track_id: u.name for u in step.updates if u.name}
        for track_id, name in names.items():
            if name in step.found_anew:
                since = _first_instant(instants, instant, step.found_anew[name])
                for row in range(since, instant):
                    assigned.unseed(row, track_id)
        for former, (number, since_ns) in step.returned.items():
            for row in range(_first_instant(instants, instant, since_ns), instant):
                assigned.renumber(row, {former: number, number: former})
        if not step.renumbered:
            continue
        wearers = {i: names[i] for i in step.renumbered.values() if i in names}
        since_ns = step.renumbered_since_ns
        if since_ns is None:
            since = _sensors_began(assigned, instant, step.renumbered, wearers, instants, vote)
        else:
            since = _first_instant(instants, instant, since_ns)
        for row in range(since, instant):
            assigned.renumber(row, step.renumbered)
        begun.setdefault(since, set()).update(wearers.values())
    assigned.settle()
    _drop_tails(assigned, instants)
    return Sorted(
        shapes={name: pipeline.estimator(name).shape for name in assigned.names},
        begun=begun,
        found_anew={name: len(times_s) for name, times_s in found_anew.items()},
        notes=(*notes, *(_posed_anew(name, times_s) for name, times_s in found_anew.items())),
    )


def _posed_anew(name: str, times_s: list[float]) -> str:
    more = f" and {len(times_s) - 1} times more" if len(times_s) > 1 else ""
    return (
        f"{name}: the pose did not fit what was seen and was found anew, at {times_s[0]:.2f} s"
        f"{more}; look at the take there"
    )


def _first_instant(instants: Instants, before: int, since_ns: int) -> int:
    """The first one at or after a time, of those until `before`."""
    while before and instants.detections(before - 1).timestamp_ns >= since_ns:
        before -= 1
    return before


def _sensors_began(
    assigned: Assignments,
    instant: int,
    renumbered: Mapping[int, int],
    wearers: Mapping[int, str],
    instants: Instants,
    vote: SensorVote,
) -> int:
    """When they began to be others, of whom sensors said so at an instant.

    That is when the new ids, until then, fit the sensors better by most. `wearers` has names by
    the new ids. Of two of whom one had no track then it counts whether the other one fits.
    """
    gain = most = 0.0
    since = instant
    for row in range(instant - 1, -1, -1):
        readings, points = instants.readings(row), assigned.landmarks_m(row)
        if most - gain > SURE or not points.keys() & {*renumbered, *renumbered.values()}:
            break
        for former, number in renumbered.items():
            name = wearers.get(number, "")
            if name in readings:
                first = _unlike(vote, points.get(number), name, readings[name])
                better = first - _unlike(vote, points.get(former), name, readings[name])
                gain += better if np.isfinite(better) else 0.0
        if gain >= most:
            most, since = gain, row
    return since


def _unlike(
    vote: SensorVote, landmarks_m: np.ndarray | None, name: str, reading: ImuReading
) -> float:
    """How badly somebody's sensors fit a skeleton; nobody at all fits as one who just does not."""
    if landmarks_m is None:
        return FITS
    away = vote.away(landmarks_m[None], name, reading)
    return np.nan if away is None else float(away[0])


def _drop_tails(assigned: Assignments, instants: Instants) -> None:
    """Nobody is followed after the last instant in which a camera or a sensor told of them.

    Between two such instants motion bridges a gap; after the last nothing says where they are.
    """
    going_on: set[str] = set()
    for instant in range(len(assigned) - 1, -1, -1):
        here, readings = assigned.here(instant), instants.readings(instant)
        going_on &= set(here)
        going_on |= {name for name, seen in here.items() if seen or tells(readings.get(name))}
        assigned.keep(instant, going_on)
