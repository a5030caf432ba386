"""What solving instants together could reach at best: takes with the constant errors alone.

    uv run python benchmarks/motion_limits.py

Simulated twin, its eight test sequences. *Before*: each instant alone, with the weights of then
(orientation 20, projection 0.7, deviation 0.06). *Take*: what `fusecap solve` writes. *Constant
errors alone*: the same once nothing errs that changes in time: no noise, miss or exchange of
keypoints, no wandering, yielding or lost sensor. What stays is where cameras, landmarks and sensors
truly are, which no motion model can know, and the prior. Prints position [mm], orientation [deg].
"""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np

from fusecap.evaluate import twin
from fusecap.evaluate.keypoint_noise import NO_KEYPOINT_NOISE
from fusecap.evaluate.score import score_take
from fusecap.evaluate.simulated_solve import solve_simulation
from fusecap.evaluate.simulator import Simulation
from fusecap.solve.options import SolverOptions, Weights

CONFIGURATIONS = ((8, 13), (2, 6), (3, 0), (1, 13))
"""Cameras and IMUs."""
BEFORE = SolverOptions(
    window=1, weights=Weights(orientation=20.0, projection=0.7, deviation=0.06).alone()
)
QUIET_KEYPOINTS = replace(
    NO_KEYPOINT_NOISE,
    detector_bias=twin.TWIN_KEYPOINT_NOISE.detector_bias,
    landmark_bias_m=twin.TWIN_KEYPOINT_NOISE.landmark_bias_m,
)
QUIET_IMUS = replace(
    twin.TWIN_IMU_NOISE,
    orientation_deg=0.0,
    tissue_lag_s=0.0,
    tissue_deg_per_m_s2=0.0,
    gyro_deg_s=0.0,
    accel_m_s2=0.0,
    lost_share=0.0,
)


def main() -> None:
    sequences = twin.twin_sequences()
    print("mm from the root (1 camera: global), deg: before; take; constant errors alone")
    for cameras, imus in CONFIGURATIONS:
        rows = []
        for sequence in sequences:
            noisy = twin.twin_simulation(sequence, cameras=cameras, imus=imus)
            with (
                mock.patch.object(twin, "TWIN_KEYPOINT_NOISE", QUIET_KEYPOINTS),
                mock.patch.object(twin, "TWIN_IMU_NOISE", QUIET_IMUS),
            ):
                twin._full_simulation.cache_clear()
                quiet = twin.twin_simulation(sequence, cameras=cameras, imus=imus)
            twin._full_simulation.cache_clear()
            cells = ((noisy, BEFORE), (noisy, None), (quiet, None))
            rows.append([error(simulation, options, cameras) for simulation, options in cells])
        told = "; ".join(f"{mm:.1f} mm, {deg:.1f} deg" for mm, deg in np.mean(rows, axis=0))
        print(f"{cameras} cameras, {imus} IMUs: {told}", flush=True)


def error(
    simulation: Simulation, options: SolverOptions | None, cameras: int
) -> tuple[float, float]:
    take = solve_simulation(simulation, options=options).take
    score = score_take(take, simulation.truth, gate_m=np.inf)
    place = score.position_error_mm if cameras == 1 else score.root_relative_error_mm
    return place.mean, score.orientation_error_deg.mean


if __name__ == "__main__":
    main()
