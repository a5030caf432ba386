"""Ceres and SciPy beside fusecap: the same cost, the same frames, one thread, one run.

    OPENBLAS_NUM_THREADS=1 taskset -c 1 uv run python benchmarks/peers/run.py [--weights paper]

Prints Markdown. Needs Ceres and CMake (Debian: apt-get install libceres-dev cmake). Every
repetition lets each solver pass over all frames, with fusecap again right before each peer. Times
are processor time, a frame's time is the median over repetitions, and a ratio compares a pass with
fusecap's beside it, so that other work on the machine counts little and counts for all alike.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import scipy
from frames import WEIGHTS, record_problems
from pose_problem import Problems, write_problems
from scipy_peer import ScipyProblem

from fusecap.solve.pose_solver import PoseSolver

HERE = Path(__file__).resolve().parent
CERES_DEFAULT_DAMPING = 1e-4
INSTALL = "on Debian: apt-get install libceres-dev cmake"
CERES = {
    "dynamic": "Ceres as the paper uses it, DynamicAutoDiff",
    "templated": "Ceres as the paper uses it, templated AutoDiff",
    "grouped": "Ceres at its best: analytic, grouped, dense",
    "reduced": "the same, landmarks reduced over cameras first",
}
ONE_THREAD = {"OMP_THREAD_LIMIT": "1", "OPENBLAS_NUM_THREADS": "1"}
"""CHOLMOD, which factors Ceres' sparse systems, asks for four threads whatever OMP_NUM_THREADS
is; on one core they wait for each other."""
_CERES_COLUMNS = 7
"""Before the pose in a row of the program's output, see ceres/main.cpp."""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """One solver once over some frames."""

    seconds: np.ndarray
    cost: np.ndarray
    iterations: np.ndarray
    theta: np.ndarray
    start_cost: np.ndarray | None = None
    converged: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Row:
    """One solver over all repetitions."""

    name: str
    frames: np.ndarray
    passes: list[Pass]
    beside: list[Pass]
    """Fusecap's passes, each right before one of `passes`; over all frames."""

    @property
    def ratios(self) -> np.ndarray:
        """Median time over fusecap's on the same frames, per repetition."""
        pairs = zip(self.passes, self.beside, strict=True)
        return np.array(
            [np.median(p.seconds) / np.median(ours.seconds[self.frames]) for p, ours in pairs]
        )

    @property
    def milliseconds(self) -> np.ndarray:
        return 1e3 * np.median([each.seconds for each in self.passes], axis=0)


def build_ceres(folder: Path, program: str = "ceres_peer") -> Path:
    """The compiled program; ends the run with instructions where something is missing."""
    if shutil.which("cmake") is None:
        raise SystemExit(f"cmake is not installed; {INSTALL}")
    folder.mkdir(parents=True, exist_ok=True)
    configure = ["cmake", "-S", str(HERE / "ceres"), "-B", str(folder)]
    for command in (configure, ["cmake", "--build", str(folder)]):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode and "CeresConfig.cmake" in done.stderr:
            raise SystemExit(f"CMake finds no Ceres; {INSTALL}")
        if done.returncode:
            raise SystemExit(f"{' '.join(command)} failed:\n{done.stdout}\n{done.stderr}")
    return folder / program


def fusecap_pass(solver: PoseSolver, problems: Problems) -> Pass:
    data = [problems.measurements(frame) for frame in range(len(problems))]
    solver.solve(problems.frames["start"][0], data[0])  # warm up
    seconds, solutions = np.zeros(len(data)), []
    for frame, start in enumerate(problems.frames["start"]):
        before = time.process_time_ns()
        solutions.append(solver.solve(start, data[frame]))
        seconds[frame] = 1e-9 * (time.process_time_ns() - before)
    return Pass(
        seconds=seconds,
        cost=np.array([solution.cost for solution in solutions]),
        iterations=np.array([solution.iterations for solution in solutions]),
        theta=np.stack([solution.theta for solution in solutions]),
    )


def ceres_pass(program: Path, problem_file: Path, variant: str, damping: float) -> Pass:
    out = problem_file.with_suffix(".out")
    command = [program, problem_file, out, variant, str(damping)]
    subprocess.run(command, check=True, env=os.environ | ONE_THREAD)
    rows = np.fromfile(out, "<f8").reshape(-1, _CERES_COLUMNS + 66)
    return Pass(
        seconds=rows[:, 4],
        cost=rows[:, 1],
        iterations=rows[:, 2],
        theta=np.ascontiguousarray(rows[:, _CERES_COLUMNS:]),
        start_cost=rows[:, 0],
        converged=float(rows[:, 3].mean()),
    )


def scipy_pass(problems: Problems, frames: np.ndarray) -> Pass:
    seconds, found = np.zeros(len(frames)), []
    start_cost = []
    for index, frame in enumerate(frames):
        problem = ScipyProblem(problems, int(frame))
        start_cost.append(0.5 * float(np.sum(problem.residuals(problem.start) ** 2)))
        before = time.process_time_ns()
        found.append(problem.solve())
        seconds[index] = 1e-9 * (time.process_time_ns() - before)
    return Pass(
        seconds=seconds,
        cost=np.array([result.cost for result in found]),
        iterations=np.array([result.njev for result in found]),
        theta=np.stack([result.x for result in found]),
        start_cost=np.array(start_cost),
        converged=float(np.mean([result.success for result in found])),
    )


def time_table(rows: list[Row]) -> str:
    lines = [
        "| solver | median ms | p99 ms | linear solves, mean | time / fusecap (range) |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        ms = row.milliseconds
        ratios = row.ratios
        lines.append(
            f"| {row.name} | {np.median(ms):.3f} | {np.percentile(ms, 99):.3f} "
            f"| {row.passes[0].iterations.mean():.2f} "
            f"| {np.median(ratios):.1f} ({ratios.min():.1f}-{ratios.max():.1f}) |"
        )
    return "\n".join(lines)


def cost_table(rows: list[Row], solver: PoseSolver, problems: Problems) -> str:
    lines = [
        "| solver | at the start | at its end | end / fusecap's: min | median | max | within 1 % |",
        "|---|---|---|---|---|---|---|",
    ]
    ours = rows[0].passes[0].cost
    for row in rows:
        first = row.passes[0]
        if first.start_cost is None:
            continue
        starts = problems.frames["start"]
        start = _difference(solver, problems, row.frames, starts[row.frames], first.start_cost)
        end = _difference(solver, problems, row.frames, first.theta, first.cost)
        ratio = first.cost / ours[row.frames]
        lines.append(
            f"| {row.name} | {start:.0e} | {end:.0e} | {ratio.min():.5f} | {np.median(ratio):.5f} "
            f"| {ratio.max():.5f} | {100 * np.mean(np.abs(ratio - 1) < 0.01):.1f} % |"
        )
    return "\n".join(lines)


def _difference(
    solver: PoseSolver, problems: Problems, frames: np.ndarray, theta: np.ndarray, cost: np.ndarray
) -> float:
    """Largest relative difference between a peer's cost and ours at the same poses."""
    ours = [
        solver.evaluate(pose, problems.measurements(int(frame)))[0]
        for frame, pose in zip(frames, theta, strict=True)
    ]
    return float(np.abs(cost / np.array(ours) - 1).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--repetitions", type=int, default=7)
    parser.add_argument("--scipy-frames", type=int, default=5)
    parser.add_argument("--weights", choices=WEIGHTS, default="default")
    parser.add_argument("--folder", type=Path, default=HERE.parents[1] / "out" / "peers")
    arguments = parser.parse_args()

    program = build_ceres(arguments.folder / "build")
    version = subprocess.run(
        [program, "--version"], check=True, capture_output=True, text=True
    ).stdout
    problems, solver, _ = record_problems(frames=arguments.frames, weights=arguments.weights)
    problem_file = arguments.folder / "problems.bin"
    write_problems(problems, problem_file)
    damping = solver.options.initial_damping

    everything = np.arange(len(problems))
    few = np.linspace(0, len(problems) - 1, arguments.scipy_frames).astype(int)
    peers = {
        **{
            name: partial(ceres_pass, program, problem_file, variant, CERES_DEFAULT_DAMPING)
            for variant, name in CERES.items()
        },
        f"{CERES['grouped']}, μ = {damping:g}": partial(
            ceres_pass, program, problem_file, "grouped", damping
        ),
        "SciPy least_squares": lambda: scipy_pass(problems, few),
    }
    rows = {name: Row(name=name, frames=everything, passes=[], beside=[]) for name in peers}
    rows["SciPy least_squares"] = Row(name="SciPy least_squares", frames=few, passes=[], beside=[])
    ours = Row(name="fusecap", frames=everything, passes=[], beside=[])
    for repetition in range(arguments.repetitions):
        for name, solve in peers.items():
            if name.startswith("SciPy") and repetition > 0:
                continue  # too slow to repeat
            rows[name].beside.append(fusecap_pass(solver, problems))
            rows[name].passes.append(solve())
            ours.passes.append(rows[name].beside[-1])
            ours.beside.append(rows[name].beside[-1])
    table = [ours, *rows.values()]

    keypoints = int(np.sum(problems.frames["keypoints"][..., 2] > 0) / len(problems))
    sizes = problems.sizes
    print(
        f"{len(problems)} frames, {sizes['cameras']} cameras, {sizes['landmarks']} keypoints "
        f"({keypoints} seen per frame), {sizes['imus']} IMUs, weights: {arguments.weights}; "
        f"Ceres {version.strip()}, SciPy {scipy.__version__}, {arguments.repetitions} repetitions\n"
    )
    print(time_table(table))
    print("\nRelative difference to fusecap's cost at equal poses, and where each solver ends:\n")
    print(cost_table(table, solver, problems))
    stopped = min(row.passes[0].converged for row in table)
    print(f"\nSmallest share of frames that a solver ended by its tolerance: {100 * stopped:.1f} %")


if __name__ == "__main__":
    main()
