"""The second pass over recorded instants: who is who stands, everybody becomes one motion."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from fusecap.batch.assignments import Assigned, Seed, seed_of
from fusecap.believable import believable_detections, believable_reading, tells
from fusecap.body.shape import BodyShape
from fusecap.pipeline import make_estimator, observation_of
from fusecap.setup import Setup
from fusecap.solve.estimator import Estimator
from fusecap.solve.whole_motion import AHEAD, PIECE, Settled, WholeMotion
from fusecap.solve.window_solver import Workspace
from fusecap.types import Detections, Estimate, ImuReading, Observation, Status


@dataclass(slots=True)
class Instant:
    """One instant, open while some motion may still change it."""

    timestamp_ns: int
    people: dict[str, tuple[Estimate, Observation]] = field(default_factory=dict)
    """Each last estimate with what it was solved from."""
    held: int = 0
    """By how many motions."""


class _Held(NamedTuple):
    instant: Instant
    track_id: int
    seed: Seed
    observation: Observation


class _Motion:
    """One subject's instants, on their way to their last poses."""

    def __init__(self, estimator: Estimator, workspace: Workspace) -> None:
        self._estimator = estimator
        self._motion = WholeMotion(estimator.solver, workspace)
        self._held: deque[_Held] = deque()

    def take(self, held: _Held) -> None:
        """The subject's next instant."""
        self._held.append(held)
        held.instant.held += 1
        self._settle(self._motion.push(held.observation, held.seed.theta))

    def end_before(self, timestamp_ns: int) -> None:
        """End a motion that an instant does not go on."""
        if self._held and not self._motion.goes_on(timestamp_ns):
            self.end()

    def end(self) -> None:
        """What is held gets its last poses."""
        self._settle(self._motion.end())

    def _settle(self, settled: list[Settled]) -> None:
        solver, name = self._estimator.solver, self._estimator.model.name
        for theta, sigmas in settled:
            held = self._held.popleft()
            position, rotation = solver.posed(theta)
            views = np.asarray((held.observation.keypoints[:, :, 2] > 0.0).any(axis=1))
            last = Estimate(
                track_id=held.track_id,
                name=name,
                timestamp_ns=held.instant.timestamp_ns,
                theta=theta,
                bone_position_in_world_m=position,
                bone_rotation_in_world=rotation,
                bone_sigma_deg=sigmas.bone_deg,
                position_sigma_m=sigmas.position_m,
                shape=solver.shape,
                status=held.seed.status,
                iterations=held.seed.iterations,
                cost=held.seed.cost,
                solve_s=held.seed.solve_s,
                views=views,
                measured=bool(views.any()) or tells(held.observation.imu),
            )
            held.instant.people[name] = (last, held.observation)
            held.instant.held -= 1


class SecondPass:
    """Solves everybody again, with one body throughout; each alone where options say so."""

    def __init__(self, setup: Setup, shapes: Mapping[str, BodyShape]) -> None:
        self._landmark_count = len(setup.landmarks.landmark_names)
        self._setup = replace(setup, options=replace(setup.options, window=1))
        self._shapes = shapes
        self._open: deque[Instant] = deque()
        self._alone: dict[str, Estimator] = {}
        """Of those whose last instant was solved here, not by the first pass."""
        self._motions: dict[str, _Motion] = {}
        if setup.options.together:
            workspace = Workspace(setup.skeleton, PIECE + AHEAD)
            self._motions = {name: _Motion(self._estimator(name), workspace) for name in shapes}

    def step(
        self,
        detections: Detections,
        readings: Mapping[str, ImuReading],
        assigned: Sequence[Assigned],
    ) -> list[Seed]:
        """One instant, and where everybody's pose begins; see `finished`."""
        detections = believable_detections(detections, len(self._setup.rig), self._landmark_count)
        instant = Instant(detections.timestamp_ns)
        seeds = []
        for motion in self._motions.values():
            motion.end_before(instant.timestamp_ns)
        for update, seed in assigned:
            name, reading = update.name, readings.get(update.name)
            if reading is not None:
                reading = believable_reading(reading, len(self._setup.model(name).sites.bone))
            observation = observation_of(update, detections, self._landmark_count, reading)
            if self._motions and seed is not None:
                self._alone.pop(name, None)
            else:
                if name not in self._alone:
                    self._alone[name] = self._estimator(name)
                estimate = self._alone[name].follow(
                    update.track_id, observation, update.landmarks_in_world_m
                )
                if estimate is None:
                    continue
                seed = seed_of(estimate)
                instant.people[name] = (estimate, observation)
            seeds.append(seed)
            if name in self._motions and seed.status is not Status.DIVERGED:
                self._motions[name].take(_Held(instant, update.track_id, seed, observation))
        self._open.append(instant)
        return seeds

    def begin(self, names: Collection[str]) -> None:
        """Whoever comes next under these names is not whom they were until now."""
        for name in names:
            self._alone.pop(name, None)
            if name in self._motions:
                self._motions[name].end()

    def finished(self) -> Iterator[Instant]:
        """Instants whose poses are their last ones, in order."""
        while self._open and not self._open[0].held:
            yield self._open.popleft()

    def rest(self) -> Iterator[Instant]:
        """All that are still open, once nothing more comes."""
        for motion in self._motions.values():
            motion.end()
        yield from self.finished()

    def _estimator(self, name: str) -> Estimator:
        estimator = make_estimator(self._setup, self._setup.model(name))
        estimator.set_shape(self._shapes[name])
        return estimator
