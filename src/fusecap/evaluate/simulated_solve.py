"""A simulated scene through the whole pipeline."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fusecap.associate.options import TrackerOptions
from fusecap.batch.solve import Solved, solve_instants
from fusecap.body.prior import PosePrior, load_prior
from fusecap.evaluate.simulator import Simulation
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.options import SolverOptions
from fusecap.solve.pose_solver import ImuSites
from fusecap.types import Detections, ImuReading


def solve_simulation(
    simulation: Simulation,
    *,
    options: SolverOptions | None = None,
    prior: PosePrior | None = None,
    associate: str = "tracker",
    progress: Progress | None = None,
) -> Solved:
    """Solve knowing the heights and start positions of the subjects, as a session states them."""
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
    setup = Setup(
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
    return solve_instants(setup, _Instants(simulation), progress=progress, simulated=True)


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
