"""N consecutive instants as one problem: the file that peers read, and what fusecap does with it.

A window of instants t - N + 1 to t is what a live solver would minimise when t arrives. It starts
where that solver would: the minimum of the window before, less its first pose, and for t the pose
that was solved alone. Nothing is known of what lies before a window.

The file is a sequence of float64, beside that of `pose_problem`: a number that says what it is, N,
the number of windows, the weights of the terms between instants, steadiness, specific forces and
steps of all frames, then per window the cost to reach and the start.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from frames import Recorded, record_problems
from pose_problem import Problems

from fusecap.kernels import band, groups
from fusecap.solve.window_solver import WindowSolver

MAGIC = 20202.0
REACHED = 1e-4
"""A window is solved when its cost is within this share of the minimum."""
DAMPING = 1e-4
_STEPS = 50


@dataclass(frozen=True, kw_only=True)
class Solved:
    """Where a window ended."""

    theta: np.ndarray
    cost: float
    solves: int
    """Linear ones."""


class Windows:
    """All windows of N instants of a recording, for fusecap's solver."""

    def __init__(self, recorded: Recorded, length: int) -> None:
        self.recorded, self.length = recorded, length
        pose = np.zeros(recorded.solver.skeleton.pose_size)
        whole = WindowSolver(recorded.solver, len(recorded.observations))
        for observation in recorded.observations:
            whole.push(observation, pose)
        self.measured = whole._measured
        self._solver = WindowSolver(recorded.solver, length)
        self._windows = [
            groups.Window(
                *(array[w : w + length] for array in self.measured[:5]),
                self.measured.steps[w : w + length - 1],
                self.measured.steadiness,
            )
            for w in range(whole.count - length + 1)
        ]

    def __len__(self) -> int:
        return len(self._windows)

    def evaluate(self, w: int, theta: np.ndarray) -> float:
        """Cost, and normal equations; the one place that knows how fusecap computes them."""
        self._solver._measured = self._windows[w]
        return self._solver._evaluate(theta)

    def _step(self, damping: float) -> np.ndarray | None:
        """None where the matrix is not positive."""
        workspace, n = self._solver._workspace, self.length
        positive = band.eliminate(
            workspace.hessian, workspace.gradient, n, damping, 1e-9, workspace.square[0]
        )
        if not positive:
            return None
        band.step_of(workspace.hessian, workspace.gradient, workspace.step)
        return workspace.step

    def step(self, w: int, theta: np.ndarray) -> np.ndarray:
        """After one Gauss-Newton step, mostly all that a new instant needs."""
        self.evaluate(w, theta)
        return theta + self._step(DAMPING)

    def solve(self, w: int, theta: np.ndarray, target: float = -np.inf) -> Solved:
        """Levenberg-Marquardt as `WindowSolver` does it, to a cost or as far as it goes."""
        damping, solves = DAMPING, 0
        cost = self.evaluate(w, theta)
        while cost > target and solves < _STEPS and damping <= 1e6:
            solves += 1
            step = self._step(damping)
            trial = theta if step is None else theta + step
            trial_cost = self.evaluate(w, trial)
            if not trial_cost < cost:
                damping *= 10.0
                self.evaluate(w, theta)
                continue
            theta, cost, damping = trial, trial_cost, max(damping / 10.0, 1e-8)
        return Solved(theta=theta, cost=cost, solves=solves)


@dataclass(frozen=True, kw_only=True)
class WindowProblems:
    """What every solver is given: per window a start (W, N, P) and the cost to reach (W,)."""

    windows: Windows
    start: np.ndarray
    minimum: np.ndarray
    target: np.ndarray

    @property
    def problems(self) -> Problems:
        return self.windows.recorded.problems


def record_windows(*, count: int, length: int) -> WindowProblems:
    recorded = record_problems(frames=count + length - 1, weights="window")
    windows = Windows(recorded, length)
    alone = np.stack(
        [
            recorded.solver.solve(start, recorded.problems.measurements(frame)).theta
            for frame, start in enumerate(recorded.problems.frames["start"])
        ]
    )
    starts, minima = [], []
    converged = windows.solve(0, np.ascontiguousarray(alone[:length])).theta
    for w in range(len(windows)):
        kept = alone[: length - 1] if w == 0 else converged[1:]
        starts.append(np.concatenate([kept, alone[w + length - 1 : w + length]]))
        solved = windows.solve(w, starts[-1])
        converged = solved.theta
        minima.append(solved.cost)
    minimum = np.array(minima)
    return WindowProblems(
        windows=windows,
        start=np.stack(starts),
        minimum=minimum,
        target=minimum * (1 + REACHED),
    )


def write_windows(problems: WindowProblems, path: Path) -> None:
    measured = problems.windows.measured
    weights = problems.windows.recorded.solver.options.weights
    count, length = problems.start.shape[:2]
    head = [MAGIC, length, count, weights.motion, weights.increment, weights.specific_force]
    rows = np.concatenate([problems.target[:, None], problems.start.reshape(count, -1)], axis=1)
    parts = [np.array(head), measured.steadiness, measured.force, measured.steps, rows]
    np.concatenate([part.ravel() for part in parts]).astype("<f8").tofile(path)
