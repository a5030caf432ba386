"""What cannot be measured, through the public API: how often it ends in anything but an error.

    uv run python benchmarks/garbage.py --steps 12000

Instants of the simulated demo are spoilt, field by field, with what no sensor says: not numbers,
infinities, numbers beyond every scale, mirrored and sheared rotations, crowds, other shapes, times
that stand still or run backwards. Each goes to an `Estimator`, a `Tracker` and a `Pipeline` that
have seen good instants before; a step may raise `FusecapError` or give poses of finite numbers, in
bounded time. After every run of garbage good instants follow, and must be solved again.
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import fusecap
from fusecap.associate.subjects import Subject
from fusecap.body.skeleton import PAPER21
from fusecap.errors import FusecapError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulator import Simulation
from fusecap.geometry.triangulation import triangulate
from fusecap.solve.estimator import Estimator, SubjectModel
from fusecap.solve.pose_solver import ImuSites
from fusecap.types import Detections, Estimate, ImuReading, Observation

ODD = np.array(
    [np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e-300, -1e-30, 1e5, -1e9, 1e30, 1e160, -1e300]
)
SLOW_S = 2.0
RUN = 5
"""Spoilt instants in a row."""
RECOVERY = 4
"""Good instants after them; a bystander's place is free again by then."""


@dataclass(kw_only=True)
class Findings:
    """What became of the steps."""

    steps: int = 0
    refused: int = 0
    """`FusecapError`."""
    faults: Counter[str] = field(default_factory=Counter)
    """Anything else, by what was raised and where."""
    slowest_s: float = 0.0
    lost: int = 0
    """Runs after which good instants were not solved."""
    runs: int = 0


class Spoiler:
    """Spoils arrays and times, by one seed."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)

    def array(self, values: np.ndarray) -> Any:
        """Some or all entries odd, another shape, another type."""
        random = self.random
        values = np.array(values, dtype=np.float64)
        match random.integers(8):
            case 0 | 1 | 2:
                if values.size:
                    at = random.integers(values.size, size=random.integers(1, 4))
                    values.flat[at] = random.choice(ODD)
            case 3:
                values = random.choice(ODD, size=values.shape)
            case 4:
                values = np.full(values.shape, random.choice(ODD))
            case 5:
                values = values * random.choice([1e-9, -1.0, 1e3, 1e9, 1e150])
            case 6:
                values = random.normal(size=values.shape) * 10.0 ** random.integers(-3, 4)
            case 7:
                return self.misshapen(values)
        return values

    def misshapen(self, values: np.ndarray) -> Any:
        """What no array of this kind looks like."""
        match self.random.integers(6):
            case 0:
                return values[:-1]
            case 1:
                return values[..., :-1]
            case 2:
                return values.astype(complex) + 1j
            case 3:
                return values.astype(object)
            case 4:
                return values[None]
            case _:
                return values.astype(np.float32)

    def time_ns(self, now_ns: int) -> Any:
        """A time that is none."""
        odd = [now_ns, 0, -now_ns, now_ns - 1, now_ns + 1, 2**62, -(2**63), 2**70, 10**30]
        return odd[self.random.integers(len(odd))]

    def reading(self, reading: ImuReading) -> ImuReading:
        """One of its arrays spoilt."""
        if self.random.random() < 0.6:
            return replace(
                reading, bone_rotation_in_world=self.array(reading.bone_rotation_in_world)
            )
        return replace(reading, accel_in_world_m_s2=self.array(reading.accel_in_world_m_s2))

    def detections(self, detections: Detections) -> Detections:
        """One camera's people spoilt, or too many, or too few cameras."""
        people = list(detections.people)
        camera = int(self.random.integers(len(people)))
        match self.random.integers(10):
            case 0:
                people = people[:-1]
            case 1:
                people[camera] = np.repeat(people[camera], 1000, axis=0)
            case 2:
                people = [np.empty((0, *p.shape[1:])) for p in people]
            case _:
                people[camera] = self.array(people[camera])
        return replace(detections, people=tuple(people))


def check(estimate: Estimate | None) -> bool:
    """Whether a pose is of finite numbers; raises `AssertionError` for another."""
    if estimate is None:
        return False
    for name in ("theta", "bone_position_in_world_m", "bone_rotation_in_world"):
        assert np.isfinite(getattr(estimate, name)).all(), f"{name} is not finite"
    for name in ("bone_sigma_deg", "position_sigma_m"):
        assert not np.isnan(getattr(estimate, name)).any(), f"{name} is not a number"
    return estimate.status is not fusecap.Status.DIVERGED


class OfEstimator:
    """One person's estimator, fed by hand."""

    def __init__(self, scene: Simulation) -> None:
        self.scene, anna = scene, scene.subjects[0]
        sites = ImuSites(
            bone=tuple(PAPER21.bone(name) for name in anna.imu_bones),
            position_m=np.zeros((len(anna.imu_bones), 3)),
        )
        self.estimator = Estimator(
            SubjectModel(name=anna.name, sites=sites),
            rig=scene.rig,
            landmarks=scene.landmark_set,
            prior=fusecap.load_prior(PAPER21),
        )

    def step(self, instant: int, now_ns: int, spoiler: Spoiler | None) -> bool:
        """Whether a sound pose came of it."""
        scene = self.scene
        detections = scene.detections[instant]
        keypoints = np.full((len(scene.rig), len(scene.landmark_set.landmark_names), 3), np.nan)
        keypoints[:, :, 2] = 0.0
        for camera, whose in enumerate(scene.detected_person[instant]):
            for person in np.flatnonzero(whose == 0):
                keypoints[camera] = detections.people[camera][person]
        points, _ = triangulate(scene.rig, keypoints)
        observation = Observation(
            timestamp_ns=now_ns,
            keypoints=keypoints,
            imu=scene.imu_readings[scene.subjects[0].name][instant],
        )
        if spoiler is not None:
            match spoiler.random.integers(4):
                case 0:
                    observation = replace(observation, keypoints=spoiler.array(keypoints))
                case 1:
                    assert observation.imu is not None
                    observation = replace(observation, imu=spoiler.reading(observation.imu))
                case 2:
                    observation = replace(observation, timestamp_ns=spoiler.time_ns(now_ns))
                case _:
                    points = spoiler.array(points)
        sound = check(self.estimator.update(observation, points))
        self.estimator.settled(0.05)
        predicted = self.estimator.predict(observation.timestamp_ns + 1)
        assert predicted is None or np.isfinite(predicted).all(), "predicted is not finite"
        return sound


class OfPipeline:
    """All people of the scene, by the pipeline and its tracker."""

    def __init__(self, scene: Simulation, associate: str = "tracker") -> None:
        self.scene = scene
        self.pipeline = fusecap.Pipeline(
            fusecap.Setup(
                rig=scene.rig,
                landmarks=scene.landmark_set,
                skeleton=PAPER21,
                prior=fusecap.load_prior(PAPER21),
                rate_hz=scene.rate_hz,
                associate=associate,
                subjects=tuple(
                    SubjectModel(
                        name=person.name,
                        start_m=(float(person.theta[0, 0]), float(person.theta[0, 2])),
                        sites=ImuSites(
                            bone=tuple(PAPER21.bone(name) for name in person.imu_bones),
                            position_m=np.zeros((len(person.imu_bones), 3)),
                        ),
                    )
                    for person in scene.subjects
                ),
            )
        )

    def step(self, instant: int, now_ns: int, spoiler: Spoiler | None) -> bool:
        """Whether everyone's sound pose came of it."""
        detections = replace(self.scene.detections[instant], timestamp_ns=now_ns)
        readings = {name: some[instant] for name, some in self.scene.imu_readings.items()}
        if spoiler is not None:
            match spoiler.random.integers(4):
                case 0 | 1:
                    detections = spoiler.detections(detections)
                case 2:
                    name = str(spoiler.random.choice(list(readings)))
                    readings[name] = spoiler.reading(readings[name])
                case _:
                    detections = replace(detections, timestamp_ns=spoiler.time_ns(now_ns))
        step = self.pipeline.step(detections, readings)
        self.pipeline.expected(now_ns + 1)
        sound = [check(estimate) for estimate in step.estimates]
        return sum(sound) >= len(self.scene.subjects)


class OfTracker:
    """The tracker alone, with predictions from outside."""

    def __init__(self, scene: Simulation) -> None:
        self.scene = scene
        self.tracker = fusecap.Tracker(
            scene.rig,
            scene.landmark_set,
            subjects=[Subject(name=person.name) for person in scene.subjects],
        )
        self.ids: list[int] = []

    def step(self, instant: int, now_ns: int, spoiler: Spoiler | None) -> bool:
        """Whether all subjects are followed."""
        detections = replace(self.scene.detections[instant], timestamp_ns=now_ns)
        predicted: dict[int, Any] = {}
        landmarks = len(self.scene.landmark_set.landmark_names)
        if spoiler is not None:
            match spoiler.random.integers(3):
                case 0:
                    detections = spoiler.detections(detections)
                case 1:
                    predicted = {n: spoiler.array(np.ones((landmarks, 3))) for n in self.ids}
                case _:
                    now_ns = spoiler.time_ns(now_ns)
        updates = self.tracker.update(detections, predicted, now_ns)
        self.ids = [update.track_id for update in updates]
        for update in updates:
            assert not np.isinf(update.landmarks_in_world_m).any(), "landmarks are infinite"
        return sum(bool(update.name) for update in updates) >= len(self.scene.subjects)


FRONTS: dict[str, Callable[[Simulation], Any]] = {
    "estimator": OfEstimator,
    "tracker": OfTracker,
    "pipeline": OfPipeline,
    "paper": lambda scene: OfPipeline(scene, "paper"),
}


def attack(front: str, steps: int, seed: int) -> Findings:
    """So many spoilt steps."""
    scene = demo_scene(seconds=1.0)
    period_ns = round(1e9 / scene.rate_hz)
    spoiler, found = Spoiler(seed), Findings()
    while found.steps < steps:
        begin = FRONTS[front](scene)
        instant, now_ns, shown = 0, 0, False
        warm = int(spoiler.random.integers(0, 12))
        for planned in [None] * warm + [spoiler] * RUN + [None] * RECOVERY:
            instant, now_ns = instant + 1, now_ns + period_ns
            found.steps += planned is not None
            started = time.perf_counter()
            try:
                shown = begin.step(instant, now_ns, planned)
            except FusecapError:
                found.refused += 1
                shown = False
            except Exception as error:
                frame = traceback.extract_tb(error.__traceback__)[-1]
                where = f"{frame.filename.rpartition('/')[2]}:{frame.lineno}"
                found.faults[f"{type(error).__name__} at {where}: {str(error)[:80]}"] += 1
                shown = False
            found.slowest_s = max(found.slowest_s, time.perf_counter() - started)
        found.runs += 1
        found.lost += not shown and warm >= 8
    return found


def main() -> None:
    """Every front, the same number of steps."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=12000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    sound = True
    for front in FRONTS:
        found = attack(front, given.steps // len(FRONTS), given.seed)
        print(
            f"{front:10} {found.steps} steps: {found.refused} refused, "
            f"{sum(found.faults.values())} faults, slowest {found.slowest_s:.2f} s; "
            f"{found.lost} of {found.runs} runs lost the subjects"
        )
        for fault, count in found.faults.most_common(20):
            print(f"    {count:5} {fault}")
        sound &= not found.faults and not found.lost and found.slowest_s < SLOW_S
    sys.exit(0 if sound else 1)


if __name__ == "__main__":
    main()
