"""A simulated scene through the whole pipeline."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np

from fusecap.associate.options import TrackerOptions
from fusecap.batch.solve import Solved, solve_instants
from fusecap.body.prior import PosePrior, load_prior
from fusecap.evaluate.simulator import Simulation
from fusecap.pipeline import Pipeline
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions
from fusecap.solve.pose_solver import ImuSites
from fusecap.take import Take, provenance
from fusecap.take_builder import TakeBuilder
from fusecap.types import Detections, Estimate, ImuReading


def solve_simulation(
    simulation: Simulation,
    *,
    options: SolverOptions | None = None,
    prior: PosePrior | None = None,
    associate: str = "tracker",
    progress: Progress | None = None,
) -> Solved:
    """Solve knowing the heights and start positions of the subjects, as a session states them."""
    setup = setup_of_simulation(simulation, options=options, prior=prior, associate=associate)
    return solve_instants(setup, _Instants(simulation), progress=progress, simulated=True)


def live_takes(
    simulation: Simulation,
    *,
    lag_s: float,
    options: SolverOptions | None = None,
    associate: str = "tracker",
    progress: Progress | None = None,
) -> tuple[Take, Take]:
    """What a live run has: every pose as it comes, and as it is `lag_s` later.

    The last instants of the second have not settled and are missing.
    """
    setup = setup_of_simulation(simulation, options=options, associate=associate)
    pipeline, instants = Pipeline(setup), _Instants(simulation)
    times_ns: list[int] = []
    newest: dict[int, dict[str, Estimate]] = {}
    settled: dict[int, dict[str, Estimate]] = {}
    for instant in range(len(instants)):
        step = pipeline.step(instants.detections(instant), instants.readings(instant))
        times_ns.append(simulation.detections[instant].timestamp_ns)
        newest[times_ns[-1]] = {estimate.name: estimate for estimate in step.estimates}
        for late in pipeline.settled(lag_s):
            settled.setdefault(late.timestamp_ns, {})[late.name] = late
        if progress:
            progress("solving as live", instant + 1, len(instants))
    return _take(setup, times_ns, newest), _take(setup, times_ns, settled)


def ahead_takes(
    simulation: Simulation,
    *,
    late_s: float,
    options: SolverOptions | None = None,
    progress: Progress | None = None,
) -> tuple[Take, Take]:
    """What is known at each instant when pictures come `late_s` after it, and sensors at once.

    The last pose that pictures reached, under the time at which it is seen; and the pose ahead.
    """
    instants = _Instants(simulation)
    late = round(late_s * simulation.rate_hz)
    options = replace(options or SolverOptions(), ahead=late)
    setup = setup_of_simulation(simulation, options=options)
    pipeline = Pipeline(setup)
    times_ns = [detections.timestamp_ns for detections in simulation.detections]
    seen: dict[int, dict[str, Estimate]] = {}
    ahead: dict[int, dict[str, Estimate]] = {}
    for instant, now_ns in enumerate(times_ns[late:]):
        step = pipeline.step(instants.detections(instant), instants.readings(instant))
        found = pipeline.ahead(now_ns, instants.readings(instant + late))
        seen[now_ns] = {e.name: replace(e, timestamp_ns=now_ns) for e in step.estimates}
        ahead[now_ns] = {estimate.name: estimate for estimate in found}
        if progress:
            progress("looking ahead", instant + 1, len(times_ns) - late)
    return _take(setup, times_ns, seen), _take(setup, times_ns, ahead)


def _take(
    setup: Setup, times_ns: list[int], estimates: Mapping[int, Mapping[str, Estimate]]
) -> Take:
    builder = TakeBuilder(
        skeleton=setup.skeleton,
        rate_hz=setup.rate_hz,
        subject_names=[model.name for model in setup.subjects],
        provenance=provenance(options={"solver": asdict(setup.options)}, simulated=True),
    )
    for timestamp_ns in times_ns:
        builder.add(timestamp_ns, estimates.get(timestamp_ns, {}).values())
    return builder.build()


def setup_of_simulation(
    simulation: Simulation,
    *,
    options: SolverOptions | None = None,
    prior: PosePrior | None = None,
    associate: str = "tracker",
) -> Setup:
    """Heights and start positions of the subjects known."""
    people = simulation.subjects
    skeleton = people[0].shape.skeleton
    models = []
    for person in people:
        imus = simulation.imus.get(person.name)
        models.append(
            SubjectModel(
                name=person.name,
                shape=person.shape,
                sites=ImuSites.none()
                if imus is None
                else ImuSites(
                    bone=tuple(skeleton.bone(name) for name in imus.bones),
                    position_m=np.ascontiguousarray(imus.position_in_bone_m, dtype=np.float64),
                ),
                start_m=(float(person.theta[0, 0]), float(person.theta[0, 2])),
            )
        )
    return Setup(
        rig=simulation.rig,
        landmarks=simulation.landmark_set,
        skeleton=skeleton,
        rate_hz=simulation.rate_hz,
        subjects=tuple(models),
        associate=associate,
        tracker=TrackerOptions(volume_m=simulation.volume_m),
        prior=prior or load_prior(skeleton),
        options=options or SolverOptions(),
    )


class _Instants:
    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._readings = simulation.imu_readings

    def __len__(self) -> int:
        return len(self._simulation.detections)

    def detections(self, instant: int) -> Detections:
        return self._simulation.detections[instant]

    def readings(self, instant: int) -> Mapping[str, ImuReading]:
        return {name: readings[instant] for name, readings in self._readings.items()}
