"""What sorting leaves for the second pass: who was given which keypoints, and a pose to begin with.

In a file once they are many, so that a take of hours needs no more memory than one of minutes; only
names and states, a few bytes each, stay at hand.
"""

from __future__ import annotations

from array import array
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fusecap.files import Spool
from fusecap.types import Estimate, Status, TrackState, TrackUpdate

_STATES = tuple(TrackState)
_NOBODY = -1


class Seed(NamedTuple):
    """A pose solved alone, from which an instant's last pose is found."""

    theta: Float[np.ndarray, " p"]
    status: Status
    iterations: int
    cost: float
    solve_s: float


def seed_of(estimate: Estimate) -> Seed:
    """What of an estimate the second pass needs."""
    return Seed(
        theta=estimate.theta,
        status=estimate.status,
        iterations=estimate.iterations,
        cost=estimate.cost,
        solve_s=estimate.solve_s,
    )


class Assigned(NamedTuple):
    """One person at one instant."""

    update: TrackUpdate
    """Under the subject's name."""
    seed: Seed | None
    """None: nobody was followed there yet."""


class Assignments:
    """Written once, instant by instant; then ids and names are settled, and instants read."""

    def __init__(self, *, cameras: int, landmarks: int, pose_size: int) -> None:
        self._spool = Spool()
        self._record = np.dtype(
            [
                ("person", np.int32, (cameras,)),
                ("landmarks_m", np.float64, (landmarks, 3)),
                ("theta", np.float64, (pose_size,)),
                ("cost", np.float64),
                ("solve_s", np.float64),
                ("iterations", np.int32),
                ("status", np.int8),
                ("state", np.int8),
            ],
            align=True,
        )
        self._first = array("q", [0])
        """Of each instant's records, and their number in the end."""
        self._track = array("q")
        self._tentative = array("b")
        self._seen = array("b")
        self._seeded = array("b")
        self._confirmed: dict[int, str] = {}
        """By track, how those that were confirmed sooner or later are called."""
        self._names: list[str] = []
        self._name = array("h")
        """Per record an index into `_names`, or `_NOBODY` where it is nobody's."""

    def __len__(self) -> int:
        return len(self._first) - 1

    def add(self, updates: Sequence[TrackUpdate], estimates: Sequence[Estimate]) -> None:
        """The next instant, as sorting and solving alone left it."""
        solved = {estimate.name: estimate for estimate in estimates}
        records = np.zeros(len(updates), dtype=self._record)
        for record, update in zip(records, updates, strict=True):
            tentative = update.state is TrackState.TENTATIVE
            if not tentative:
                self._confirmed[update.track_id] = update.name
            self._track.append(update.track_id)
            self._tentative.append(tentative)
            self._seen.append(bool((update.person >= 0).any()))
            record["person"] = update.person
            record["state"] = _STATES.index(update.state)
            record["landmarks_m"] = update.landmarks_in_world_m
            estimate = None if tentative else solved.get(update.name)
            self._seeded.append(estimate is not None)
            if estimate is not None:
                record["theta"], record["cost"] = estimate.theta, estimate.cost
                record["solve_s"] = estimate.solve_s
                record["iterations"] = estimate.iterations
                record["status"] = estimate.status.value
        self._spool.append(records.tobytes())
        self._first.append(len(self._track))

    def landmarks_m(self, instant: int) -> dict[int, Float[np.ndarray, "k 3"]]:
        """By track what was measured of everybody at an instant, NaN where nothing was."""
        rows = self._rows(instant)
        found = zip(rows, self._read(rows), strict=True)
        return {self._track[row]: record["landmarks_m"] for row, record in found}

    def renumber(self, instant: int, renumbered: Mapping[int, int]) -> None:
        """Tracks get other ids at an instant; poses that were found for others are no seeds."""
        for row in self._rows(instant):
            if self._track[row] in renumbered:
                self._track[row] = renumbered[self._track[row]]
                self._seeded[row] = False

    def unseed(self, instant: int, track_id: int) -> None:
        """What was found of a track at an instant was wrong."""
        for row in self._rows(instant):
            if self._track[row] == track_id:
                self._seeded[row] = False

    def settle(self) -> None:
        """Tracks that were confirmed sooner or later bear their subject's name from the start."""
        self._names = sorted(set(self._confirmed.values()))
        number = {name: index for index, name in enumerate(self._names)}
        by_track = {track: number[name] for track, name in self._confirmed.items()}
        self._name = array("h", (by_track.get(track, _NOBODY) for track in self._track))
        for instant in range(len(self)):
            taken: dict[int, int] = {}
            for row in self._rows(instant):
                name = self._name[row]
                if name == _NOBODY:
                    continue
                other = taken.get(name)
                if other is None or not self._tentative[row]:
                    taken[name] = row
                    if other is not None:
                        self._name[other] = _NOBODY
                else:
                    self._name[row] = _NOBODY

    @property
    def names(self) -> set[str]:
        """Of everybody who was followed."""
        return set(self._names)

    def __getitem__(self, instant: int) -> list[Assigned]:
        """Everybody who is somebody's at an instant."""
        rows = self._rows(instant)
        if all(self._name[row] == _NOBODY for row in rows):
            return []
        return [
            self._assigned(row, record)
            for row, record in zip(rows, self._read(rows), strict=True)
            if self._name[row] != _NOBODY
        ]

    def here(self, instant: int) -> dict[str, bool]:
        """By name everybody at an instant, and whether a camera saw them."""
        return {
            self._names[self._name[row]]: bool(self._seen[row])
            for row in self._rows(instant)
            if self._name[row] != _NOBODY
        }

    def keep(self, instant: int, names: Collection[str]) -> None:
        """Nobody else is at an instant."""
        for row in self._rows(instant):
            if self._name[row] != _NOBODY and self._names[self._name[row]] not in names:
                self._name[row] = _NOBODY

    def _rows(self, instant: int) -> range:
        return range(self._first[instant], self._first[instant + 1])

    def _read(self, rows: range) -> np.ndarray:
        size = self._record.itemsize
        return np.frombuffer(self._spool.read(rows.start * size, len(rows) * size), self._record)

    def _assigned(self, row: int, record: np.void) -> Assigned:
        update = TrackUpdate(
            track_id=self._track[row],
            name=self._names[self._name[row]],
            state=_STATES[record["state"]],
            person=record["person"],
            landmarks_in_world_m=record["landmarks_m"],
        )
        if not self._seeded[row]:
            return Assigned(update, None)
        seed = Seed(
            theta=record["theta"],
            status=Status(int(record["status"])),
            iterations=int(record["iterations"]),
            cost=float(record["cost"]),
            solve_s=float(record["solve_s"]),
        )
        return Assigned(update, seed)
