"""One subject on one core: 8 cameras, 25 keypoints, 13 IMUs, warm start, real motion.

    uv run pytest benchmarks/test_solve_speed.py --benchmark-only

A round is one solve. The kernel and `PoseSolver` start at the pose of the frame before, which a
first pass has stored; the `Estimator` finds it itself. The frames run through three times, and
extra_info gives median and p99 of each frame's fastest round, of all rounds, and of the processor
time of all rounds: the three agree where nothing else runs. Nothing here fails on a slow machine.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

from solve_scene import Scene, scene

from fusecap.kernels import solve as kernels
from fusecap.solve.pose_solver import Measurements
from fusecap.types import Observation

PASSES = 3


class Frames(NamedTuple):
    """A scene's solves: frame by frame the data, and the pose of the frame before."""

    scene: Scene
    observations: list[Observation]
    data: list[Measurements]
    starts: list[np.ndarray]
    iterations: float


@pytest.fixture(scope="module")
def frames() -> Frames:
    built = scene()
    observations = built.observations()
    estimator = built.estimator()
    data, starts, iterations = [], [], []
    for observation in observations:
        data.append(estimator._measurements(observation))
        estimate = estimator.update(observation)
        starts.append(estimate.theta)
        iterations.append(estimate.iterations)
    # The first frame has no frame before it.
    return Frames(built, observations[1:], data[1:], starts[:-1], float(np.mean(iterations[1:])))


def record(benchmark, frames: Frames, solve: Callable[[int], object], restart=lambda: None) -> None:
    """Time `solve(frame)` frame by frame; `restart` comes before each pass, untimed."""
    count = len(frames.data)
    taken_ms, thread_ms = [], []

    def setup():
        frame = len(taken_ms) % count
        if frame == 0:
            restart()
        return (frame,), {}

    def one(frame):
        thread, started = time.thread_time(), time.perf_counter()
        solve(frame)
        taken_ms.append(1e3 * (time.perf_counter() - started))
        thread_ms.append(1e3 * (time.thread_time() - thread))

    benchmark.pedantic(one, setup=setup, rounds=PASSES * count, iterations=1)
    for name, figures in (
        ("best", np.reshape(taken_ms, (PASSES, count)).min(axis=0)),
        ("all", np.array(taken_ms)),
        ("thread", np.array(thread_ms)),
    ):
        benchmark.extra_info[f"{name}_median_ms"] = round(float(np.median(figures)), 3)
        benchmark.extra_info[f"{name}_p99_ms"] = round(float(np.percentile(figures, 99)), 3)
    benchmark.extra_info["iterations_mean"] = round(frames.iterations, 2)
    print(f"\n{benchmark.name}: {benchmark.extra_info}")


def test_kernel(benchmark, frames):
    """`fusecap.kernels.solve.solve` as Python calls it, its arguments gathered (3 us of it)."""
    solver = frames.scene.estimator().solver
    options = solver.options
    theta = np.empty_like(frames.starts[0])

    def solve(frame):
        theta[:] = frames.starts[frame]
        status, _, _ = kernels.solve(
            theta,
            options.max_iterations,
            options.function_tolerance,
            options.initial_damping,
            solver._inputs(frames.data[frame]),
            solver._hessian,
            solver._gradient,
            solver._lower,
            *solver._vectors,
        )
        assert status == kernels.CONVERGED

    record(benchmark, frames, solve)


def test_pose_solver(benchmark, frames):
    solver = frames.scene.estimator().solver
    record(benchmark, frames, lambda i: solver.solve(frames.starts[i], frames.data[i]))


@pytest.mark.parametrize("window", [1, 5, 8, 10, 12, 20], ids="window of {}".format)
def test_estimator(benchmark, frames, window):
    """What a caller waits for: the solve, its error bars, and what is kept for the next frame."""
    estimator = frames.scene.estimator(window=window)

    def restart():
        nonlocal estimator
        estimator = frames.scene.estimator(window=window)

    record(benchmark, frames, lambda i: estimator.update(frames.observations[i]), restart)
