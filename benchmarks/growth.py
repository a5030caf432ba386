"""How the time of a solve grows with cameras, IMUs, bones and people.

    uv run python benchmarks/growth.py

Prints Markdown: per row the demo's first subject, frame by frame for 12 s, each frame's fastest of
three passes; `PoseSolver.solve`, warm-started, and `Estimator.update` with its window. People are
whole steps of `Pipeline` with every keypoint already sorted, on one thread and on a pool.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from solve_scene import KnownSorter, Scene, scene

from fusecap.body.skeleton import EXTENDED23
from fusecap.evaluate.imu_noise import IMUS_6
from fusecap.pipeline import Pipeline
from fusecap.setup import Setup
from fusecap.solve.options import SolverOptions

PASSES = 3


def best_ms(count: int, prepare: Callable[[], Callable[[int], object]]) -> np.ndarray:
    """Per frame the fastest of all passes; `prepare` returns a fresh `step(frame)`."""
    taken_ms = np.empty((PASSES, count))
    for row in taken_ms:
        step = prepare()
        for frame in range(count):
            started = time.perf_counter()
            step(frame)
            row[frame] = 1e3 * (time.perf_counter() - started)
    return taken_ms.min(axis=0)[1:]  # the first frame is not warm-started


def figures(taken_ms: np.ndarray) -> str:
    return f"{np.median(taken_ms):.3f} | {np.percentile(taken_ms, 99):.3f}"


def solve_row(label: str, built: Scene) -> None:
    estimator = built.estimator()
    data, starts, iterations = [], [], []
    for observation in built.observations():
        data.append(estimator._measurements(observation))
        estimate = estimator.update(observation)
        starts.append(estimate.theta)
        iterations.append(estimate.iterations)
    solver = estimator.solver
    starts = [starts[0], *starts[:-1]]
    alone = best_ms(len(data), lambda: lambda i: solver.solve(starts[i], data[i]))
    observations = built.observations()

    def prepare() -> Callable[[int], object]:
        together = built.estimator(window=SolverOptions().window)
        return lambda i: together.update(observations[i])

    window = best_ms(len(observations), prepare)
    print(
        f"| {label} | {figures(alone)} | {np.mean(iterations[1:]):.2f} | {figures(window)} |",
        flush=True,
    )


def people_row(people: int, frames: int) -> None:
    built = scene(people=people, frames=frames)
    simulation = built.simulation
    readings = [
        {name: values[frame] for name, values in simulation.imu_readings.items()}
        for frame in range(frames)
    ]

    def prepare(pool: ThreadPoolExecutor | None) -> Callable[[int], object]:
        setup = Setup(
            rig=simulation.rig,
            landmarks=simulation.landmark_set,
            skeleton=built.models[0].shape.skeleton,
            prior=built.prior,
            rate_hz=simulation.rate_hz,
            subjects=built.models,
        )
        pipeline = Pipeline(setup, sorter=KnownSorter(built), pool=pool)
        return lambda frame: pipeline.step(simulation.detections[frame], readings[frame])

    alone = best_ms(frames, lambda: prepare(None))
    with ThreadPoolExecutor() as pool:
        threads = best_ms(frames, lambda: prepare(pool))
    print(f"| {people} | {figures(alone)} | {figures(threads)} |", flush=True)


def main() -> None:
    print("| | alone: median ms | p99 | iterations | with its window: median ms | p99 |")
    print("|---|---|---|---|---|---|")
    solve_row("8 cameras, 13 IMUs, paper21", scene())
    for cameras in (1, 2, 4, 16):
        solve_row(f"{cameras} camera{'s'[: cameras > 1]}", scene(cameras=cameras))
    for bones in ((), IMUS_6):
        solve_row(f"{len(bones)} IMUs", scene(imu_bones=bones))
    solve_row("extended23", scene(skeleton=EXTENDED23))
    print("\n| people | step, one thread: median ms | p99 | pool: median ms | p99 |")
    print("|---|---|---|---|---|")
    for people in (1, 2, 4, 6):
        people_row(people, frames=360)


if __name__ == "__main__":
    main()
