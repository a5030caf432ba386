"""Ceres beside fusecap on windows of ten instants: the same cost, starts and end, one thread.

    OPENBLAS_NUM_THREADS=1 taskset -c 1 uv run python benchmarks/peers/run_windows.py

Prints Markdown. Needs what run.py needs, and measures as it does. Every solver goes from the same
start to a cost that is within 1e-4 of the minimum, and no further. `--blas libopenblas.so.0` lets
Ceres' sparse solver use that instead of what its distributor linked (Debian: apt-get install
libopenblas0-pthread). `--momentum PYTHON`, of an environment that has pymomentum-core, also times a
step of its sequence solvers, see momentum_driver.py.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pose_problem import write_problems
from run import CERES_DEFAULT_DAMPING, HERE, ONE_THREAD, build_ceres
from windows import REACHED, WindowProblems, record_windows, write_windows

PEERS = {
    "Ceres as the paper uses it, DynamicAutoDiff": ("paper", "sparse"),
    "Ceres at its best: analytic, a block per limb, sparse": ("limbs", "sparse"),
}
ALTERNATIVES = {
    "Ceres, a block per joint, sparse": ("joints", "sparse"),
    "Ceres, a block per pose, sparse": ("poses", "sparse"),
    "Ceres, a block per pose, every third eliminated, dense": ("poses", "schur"),
    "Ceres, a block per limb, dense": ("limbs", "dense"),
}
"""Slower ways, tried once."""
SAME_COST = 1e-9
_COLUMNS = 8
"""Before the poses in a row of the program's output, see ceres/windows_main.cpp."""


@dataclass(frozen=True, kw_only=True)
class Pass:
    """One solver once over all windows."""

    seconds: np.ndarray
    solves: np.ndarray
    cost: np.ndarray
    building: float = 0.0
    """Median seconds, not within `seconds`."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One solver over all repetitions; `beside` are fusecap's passes right before."""

    passes: list[Pass]
    beside: list[Pass]


def fusecap_pass(problems: WindowProblems) -> Pass:
    windows, found, seconds = problems.windows, [], []
    for w, start in enumerate(problems.start):
        before = time.process_time_ns()
        found.append(windows.solve(w, start, problems.target[w]))
        seconds.append(1e-9 * (time.process_time_ns() - before))
    return Pass(
        seconds=np.array(seconds),
        solves=np.array([one.solves for one in found]),
        cost=np.array([one.cost for one in found]),
    )


def one_step_pass(problems: WindowProblems) -> Pass:
    windows, found, seconds = problems.windows, [], []
    for w, start in enumerate(problems.start):
        before = time.process_time_ns()
        found.append(windows.step(w, start))
        seconds.append(1e-9 * (time.process_time_ns() - before))
    return Pass(
        seconds=np.array(seconds),
        solves=np.ones(len(found)),
        cost=np.array([windows.evaluate(w, theta) for w, theta in enumerate(found)]),
    )


def ceres_pass(
    problems: WindowProblems, command: list[str | Path], out: Path, preload: str | None
) -> Pass:
    """Raises where its cost is not ours at the same poses, or not low enough."""
    libraries = {} if preload is None else {"LD_PRELOAD": preload}
    subprocess.run(command, check=True, env=os.environ | ONE_THREAD | libraries)
    rows = np.fromfile(out, "<f8").reshape(len(problems.start), -1)
    theta = np.ascontiguousarray(rows[:, _COLUMNS:]).reshape(problems.start.shape)
    for poses, cost in ((problems.start, rows[:, 0]), (theta, rows[:, 1])):
        ours = np.array([problems.windows.evaluate(w, one) for w, one in enumerate(poses)])
        difference = np.abs(cost / ours - 1).max()
        assert difference < SAME_COST, f"another cost, by {difference:.0e}: {command}"
    assert rows[:, 3].all(), f"{np.sum(rows[:, 3] == 0)} windows not solved: {command}"
    return Pass(
        seconds=rows[:, 4],
        solves=rows[:, 2],
        cost=rows[:, 1],
        building=float(np.median(rows[:, 6])),
    )


def table(rows: dict[str, Row], minimum: np.ndarray) -> str:
    lines = [
        "| solver | median ms | p99 ms | linear solves, mean | above the minimum: median, p99 "
        "| time / fusecap (range) | building, ms |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, row in rows.items():
        ms = 1e3 * np.median([one.seconds for one in row.passes], axis=0)
        ratios = [
            np.median(one.seconds) / np.median(ours.seconds)
            for one, ours in zip(row.passes, row.beside, strict=True)
        ]
        left = row.passes[0].cost / minimum - 1
        building = row.passes[0].building
        lines.append(
            f"| {name} | {np.median(ms):.2f} | {np.percentile(ms, 99):.2f} "
            f"| {row.passes[0].solves.mean():.2f} "
            f"| {np.median(left):.0e}, {np.percentile(left, 99):.0e} "
            f"| {np.median(ratios):.2f} ({min(ratios):.2f}-{max(ratios):.2f}) "
            f"| {1e3 * building:.1f} |"
        )
    return "\n".join(lines)


def momentum_table(problems: WindowProblems, python: str, file: Path) -> str:
    frames = problems.problems.frames
    np.savez(
        file,
        **problems.problems.shared,
        keypoints=frames["keypoints"],
        imu_rotation=frames["imu_rotation"],
        start=problems.start,
    )
    ours = one_step_pass(problems).seconds
    command = [python, str(HERE / "momentum_driver.py"), str(file)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    told = json.loads(done.stdout.splitlines()[-1])
    rows = {"fusecap": ours} | {
        f"momentum {told['version']}, {name}": np.array(seconds)
        for name, seconds in told["seconds"].items()
    }
    lines = ["| a step of a window | median ms | p99 ms | time / fusecap |", "|---|---|---|---|"]
    for name, seconds in rows.items():
        lines.append(
            f"| {name} | {1e3 * np.median(seconds):.2f} | {1e3 * np.percentile(seconds, 99):.2f} "
            f"| {np.median(seconds) / np.median(ours):.2f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--windows", type=int, default=200)
    parser.add_argument("--length", type=int, default=10)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--blas", help="a library for Ceres to use besides the linked one")
    parser.add_argument("--momentum", help="the Python of an environment with pymomentum-core")
    parser.add_argument("--folder", type=Path, default=HERE.parents[1] / "out" / "peers")
    arguments = parser.parse_args()

    program = build_ceres(arguments.folder / "build", "ceres_window_peer")
    problems = record_windows(count=arguments.windows, length=arguments.length)
    files = [arguments.folder / name for name in ("frames.bin", "windows.bin", "windows.out")]
    write_problems(problems.problems, files[0])
    write_windows(problems, files[1])

    def ceres(variant: str, linear: str, preload: str | None = None) -> Callable[[], Pass]:
        command = [program, *files, variant, linear, str(CERES_DEFAULT_DAMPING)]
        return lambda: ceres_pass(problems, command, files[2], preload)

    peers = {"fusecap, one step": lambda: one_step_pass(problems)}
    for name, how in PEERS.items():
        peers[name] = ceres(*how)
        if arguments.blas:
            peers[f"{name}, {Path(arguments.blas).name}"] = ceres(*how, arguments.blas)
    peers |= {name: ceres(*how) for name, how in ALTERNATIVES.items()}
    fusecap_pass(problems)  # warm up
    rows = {"fusecap": Row(passes=[], beside=[])}
    rows |= {name: Row(passes=[], beside=[]) for name in peers}
    for repetition in range(arguments.repetitions):
        for name, solve in peers.items():
            if name in ALTERNATIVES and repetition > 0:
                continue
            ours = fusecap_pass(problems)
            for row, one in ((rows["fusecap"], ours), (rows[name], solve())):
                row.passes.append(one)
                row.beside.append(ours)
    print(
        f"{len(problems.start)} windows of {arguments.length} instants, to within {REACHED:g} of "
        f"the minimum; {arguments.repetitions} repetitions\n"
    )
    print(table(rows, problems.minimum))
    if arguments.momentum:
        print(f"\n{momentum_table(problems, arguments.momentum, arguments.folder / 'windows.npz')}")


if __name__ == "__main__":
    main()
