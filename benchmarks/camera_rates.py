"""What slow cameras that nobody synchronised cost, and whether frames should be interpolated.

    uv run python benchmarks/camera_rates.py

Simulated twin, two training sequences, 4 cameras, solved at 60 Hz. Each camera exposes at an
offset of its own. *Between*: keypoints are interpolated to the instants, as everywhere in fusecap.
*Own*: a frame counts at the instant nearest to it and at no other, all others go without that
camera. *Heavier*: the same, a keypoint weighing as much as the instants to which it would have been
interpolated. Prints of the take: position from the root [mm], orientation [deg].
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusecap.body.landmarks import landmark_set_named
from fusecap.evaluate.imu_noise import IMUS_6, IMUS_13
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import CameraTiming, Person, Simulation, camera_ring, simulate
from fusecap.evaluate.twin import (
    LANDMARK_SET,
    RING_RADIUS_M,
    TWIN_IMU_NOISE,
    TWIN_KEYPOINT_NOISE,
    TWIN_RIG_NOISE,
    TwinSequence,
    twin_training_sequences,
)
from fusecap.solve.options import SolverOptions, Weights
from fusecap.types import Detections

SEQUENCES = ("T1 FS1", "T3 FS1")
RATES_HZ = (60.0, 30.0, 15.0, 10.0)
SENSORS = {"13 IMUs": IMUS_13, "6 IMUs": IMUS_6, "no IMUs": ()}
CAMERAS = 4


def main() -> None:
    sequences = [s for s in twin_training_sequences() if s.key in SEQUENCES]
    print("sensors    rate Hz   between            own               own, heavier")
    for name, bones in SENSORS.items():
        for rate_hz in RATES_HZ:
            errors = []
            for sequence in sequences:
                between = captured(sequence, bones, rate_hz)
                own = at_own_times(between)
                heavier = sequence.rate_hz / rate_hz
                errors.append([scores(between), scores(own), scores(own, heavier)])
            mean = np.mean(errors, axis=0)
            cells = "   ".join(f"{mm:5.1f} {deg:5.2f} deg" for mm, deg in mean)
            print(f"{name:8} {rate_hz:6.0f}    {cells}", flush=True)


def captured(sequence: TwinSequence, bones: tuple[str, ...], rate_hz: float) -> Simulation:
    offsets_s = np.random.default_rng(5).uniform(0.0, 1.0 / rate_hz, CAMERAS)
    return simulate(
        [
            Person(
                name=sequence.subject,
                shape=sequence.shape,
                theta=sequence.theta,
                imu_bones=bones,
            )
        ],
        camera_ring(CAMERAS, radius_m=RING_RADIUS_M),
        landmark_set_named(LANDMARK_SET),
        rate_hz=sequence.rate_hz,
        seed=1,
        keypoint_noise=TWIN_KEYPOINT_NOISE,
        imu_noise=TWIN_IMU_NOISE,
        rig_noise=TWIN_RIG_NOISE,
        timing=[CameraTiming(rate_hz=rate_hz, offset_s=float(o)) for o in offsets_s],
    )


def at_own_times(simulation: Simulation) -> Simulation:
    """Each frame at the instant nearest to it; whoever is in no frame there is not seen."""
    nobody = np.empty((0, len(simulation.landmark_set.landmark_names), 3))
    people = [[nobody] * len(simulation.views) for _ in simulation.truth.timestamps_ns]
    for camera, view in enumerate(simulation.views):
        for time_s, found in zip(view.times_s, view.people, strict=True):
            nearest = round(float(time_s) * simulation.rate_hz)
            if nearest < len(people):
                people[nearest][camera] = found
    own = replace(simulation)
    own.__dict__["detections"] = tuple(
        Detections(timestamp_ns=int(t), people=tuple(row))
        for t, row in zip(simulation.truth.timestamps_ns, people, strict=True)
    )
    return own


def scores(simulation: Simulation, heavier: float = 1.0) -> tuple[float, float]:
    weights = Weights(position=heavier * Weights().position)
    take = solve_simulation(simulation, options=SolverOptions(weights=weights)).take
    score = score_take(take, simulation.truth, gate_m=np.inf)
    return score.root_relative_error_mm.mean, score.orientation_error_deg.mean


if __name__ == "__main__":
    main()
