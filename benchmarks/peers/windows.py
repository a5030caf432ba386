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
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from fusecap.kernels import groups, window
from fusecap.solve.window_solver import WindowSolver

MAGIC = 20202.0
REACHED = 1e-4
"""A window is solved when its cost is within this share of the minimum."""
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
        times_ns = np.array([one.timestamp_ns for one in recorded.observations])
        self.measured = recorded.solver.window(times_ns, recorded.observations)
        self._solver = WindowSolver(recorded.solver)
        self._damping = recorded.solver.options.initial_damping**2
        p = recorded.solver.skeleton.pose_size
        self._normal = [(np.zeros((length, 3, p, p)), np.zeros((length, p))) for _ in range(2)]
        self._band = np.zeros((length * p, 3 * p))
        m = self.measured
        self._windows = [
            groups.Window(
                keypoints=m.keypoints[w : w + length],
                rotation=m.rotation[w : w + length],
                present=m.present[w : w + length],
                force=m.force[w : w + length],
                steps=m.steps[w : w + length - 1],
                steadiness=m.steadiness,
            )
            for w in range(len(times_ns) - length + 1)
        ]

    def __len__(self) -> int:
        return len(self._windows)

    def evaluate(self, w: int, theta: np.ndarray, into: int = 0) -> float:
        """Cost, and normal equations; the one place that knows how fusecap computes them."""
        return self._solver._evaluate(theta, self._windows[w], *self._normal[into])

    def _step(self, damping: float, at: int) -> np.ndarray:
        """Raises `LinAlgError` where the matrix is not positive."""
        hessian, gradient = self._normal[at]
        window.banded(hessian, damping, self._band)
        factor = cholesky_banded(self._band.T, overwrite_ab=True, lower=True, check_finite=False)
        step = cho_solve_banded((factor, True), -gradient.ravel(), check_finite=False)
        return step.reshape(gradient.shape)

    def step(self, w: int, theta: np.ndarray) -> np.ndarray:
        """After one Gauss-Newton step, all that a new instant needs where that is enough."""
        self.evaluate(w, theta)
        return theta + self._step(self._damping, 0)

    def solve(self, w: int, theta: np.ndarray, target: float = -np.inf) -> Solved:
        """Levenberg-Marquardt as `WindowSolver` does it, to a cost or as far as it goes."""
        damping, at, solves = self._damping, 0, 0
        cost = self.evaluate(w, theta, at)
        while cost > target and solves < _STEPS:
            solves += 1
            try:
                trial = theta + self._step(damping, at)
            except LinAlgError:
                damping *= 10.0
                continue
            trial_cost = self.evaluate(w, trial, 1 - at)
            if not trial_cost < cost:
                damping *= 10.0
                if damping > 1e6:
                    break
                continue
            theta, cost, at, damping = trial, trial_cost, 1 - at, max(damping / 10.0, 1e-8)
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
    recorded = record_problems(frames=count + length - 1, weights="smooth")
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
