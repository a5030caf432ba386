"""How many times real time takes are solved: one person, one core, detection and reading left out.

    taskset -c 0 uv run python benchmarks/solve_speed.py

Three training sequences of the twin, simulated, ten seconds at 60 Hz each.
"""

from __future__ import annotations

import time

from fusecap.evaluate import twin
from fusecap.evaluate.simulated_solve import solve_simulation

CONFIGURATIONS = ((8, 13), (2, 6), (3, 0))
"""Cameras and IMUs."""


def times_real_time(sequence: twin.TwinSequence, cameras: int, imus: int) -> float:
    """Of the second solve: the first compiles and loads."""
    simulation = twin.twin_simulation(sequence, cameras=cameras, imus=imus)
    solve_simulation(simulation)
    began = time.perf_counter()
    solved = solve_simulation(simulation)
    return solved.report.duration_s / (time.perf_counter() - began)


def main() -> None:
    for cameras, imus in CONFIGURATIONS:
        speeds = [
            times_real_time(sequence, cameras, imus)
            for sequence in twin.twin_training_sequences()[:3]
        ]
        told = ", ".join(f"{speed:.1f}" for speed in speeds)
        print(f"{cameras} cameras, {imus} IMUs: {told} times real time", flush=True)


if __name__ == "__main__":
    main()
