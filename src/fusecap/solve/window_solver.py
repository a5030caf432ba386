"""Motion instead of poses: the cost of one body over many instants, minimised together.

The front of `fusecap.kernels.window`. Instants are coupled three by three, so the normal equations
are a band that LAPACK factors in time linear in the number of instants. Long takes are solved in
pieces that overlap: each holds the last two poses of the piece before it, and looks `AHEAD`
instants beyond what it keeps, so what a solver holds does not grow and nothing jumps between
pieces.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from fusecap.kernels import groups, window
from fusecap.kernels.jit import FINITE
from fusecap.kernels.lie import wrap_pose
from fusecap.solve.pose_solver import PoseSolver
from fusecap.types import Observation

PIECE = 120
AHEAD = 30
"""Half a second at 60 Hz; pieces then differ from the whole by under a millimetre (tests)."""
LONGEST_STEP_S = 0.1
"""Longer gaps are not bridged: the motion ends and begins anew."""
_HELD_INFORMATION = 1e12


class WindowSolver:
    """Minimises over consecutive poses of the subject of a `PoseSolver`."""

    def __init__(self, solver: PoseSolver) -> None:
        self._solver = solver
        b, p, n = solver.skeleton.bone_count, solver.skeleton.pose_size, PIECE + AHEAD + 2
        self._posed = (np.zeros((n, b, 3)), np.zeros((n, b, 3, 3)), np.zeros((n, b, 3, 3)))
        self._gathered = (np.zeros((n, 3, b, 6, 6)), np.zeros((n, b, 6)))
        self._scratch = groups.Scratch(
            local=np.zeros((3, 3)),
            information=np.zeros((3, 3)),
            gradient=np.zeros(3),
            motion=np.zeros((b, 6, 3)),
            force=np.zeros((6, 3)),
        )
        self._motions = np.zeros((n, b, 6, 3))
        self._lever, self._square = np.zeros((3, 3, 6)), np.zeros((10, 3, 3))
        self._normal = [(np.zeros((n, 3, p, p)), np.zeros((n, p))) for _ in range(2)]
        self._band = np.zeros((n * p, 3 * p))

    def smooth(
        self,
        theta: Float[np.ndarray, "t p"],
        observations: Sequence[Observation],
    ) -> Float[np.ndarray, "t p"]:
        """The motion nearest to all measurements, from poses solved one by one.

        Each stretch without a gap of more than `LONGEST_STEP_S` is a motion of its own; one of one
        or two poses has no neighbours to learn from and stays. Never worse in cost than `theta`.
        """
        times_ns = np.array([one.timestamp_ns for one in observations], dtype=np.int64)
        cuts = np.flatnonzero(np.diff(times_ns) > LONGEST_STEP_S * 1e9) + 1
        smoothed = np.array(theta, dtype=np.float64)
        for first, end in pairwise([0, *cuts.tolist(), len(times_ns)]):
            if end - first > 2:
                self._smooth_stretch(
                    smoothed[first:end], times_ns[first:end], observations[first:end]
                )
        for pose in smoothed:
            wrap_pose(pose)
        return smoothed

    def _smooth_stretch(
        self,
        theta: Float[np.ndarray, "t p"],
        times_ns: Int[np.ndarray, " t"],
        observations: Sequence[Observation],
    ) -> None:
        kept = 0
        while kept < len(theta):
            first = max(kept - 2, 0)
            end = min(kept + PIECE + AHEAD, len(theta))
            last = end if end == len(theta) else kept + PIECE
            piece = slice(first, end)
            solved = self._minimise(
                np.ascontiguousarray(theta[piece]),
                times_ns[piece],
                observations[first:end],
                held=kept - first,
            )
            theta[kept:last] = solved[kept - first : last - first]
            kept = last

    def _minimise(
        self,
        theta: Float[np.ndarray, "n p"],
        times_ns: Int[np.ndarray, " n"],
        observations: Sequence[Observation],
        *,
        held: int,
    ) -> Float[np.ndarray, "n p"]:
        """Levenberg-Marquardt over one piece, whose first `held` poses stay."""
        options = self._solver.options
        measured = self._solver.window(times_ns, observations)
        n, p = theta.shape
        band = self._band[: n * p]
        (hessian, gradient), (other_hessian, other_gradient) = (
            (h[:n], g[:n]) for h, g in self._normal
        )
        cost = self._evaluate(theta, measured, hessian, gradient)
        damping = options.initial_damping**2
        for _ in range(options.max_iterations):
            if not cost < FINITE or damping > 1e6:
                break
            window.banded(hessian, damping, band)
            band[: held * p, 0] += _HELD_INFORMATION
            try:
                factor = cholesky_banded(band.T, overwrite_ab=True, lower=True, check_finite=False)
            except LinAlgError:
                damping *= 10.0
                continue
            step = cho_solve_banded((factor, True), -gradient.ravel(), check_finite=False)
            step = step.reshape(n, p)
            step[:held] = 0.0
            trial = theta + step
            trial_cost = self._evaluate(trial, measured, other_hessian, other_gradient)
            if not trial_cost < cost:
                damping *= 10.0
                continue
            converged = cost - trial_cost <= 0.1 * options.function_tolerance * cost
            theta, cost, damping = trial, trial_cost, max(damping / 10.0, 1e-8)
            hessian, other_hessian = other_hessian, hessian
            gradient, other_gradient = other_gradient, gradient
            if converged:
                break
        return theta

    def _evaluate(
        self,
        theta: Float[np.ndarray, "n p"],
        measured: groups.Window,
        hessian_out: np.ndarray,
        gradient_out: np.ndarray,
    ) -> float:
        n = len(theta)
        return window.evaluate_window(
            theta,
            self._solver.model,
            measured,
            groups.Posed(*(array[:n] for array in self._posed)),
            groups.Gathered(*(array[:n] for array in self._gathered)),
            self._scratch,
            self._motions[:n],
            self._lever,
            self._square,
            hessian_out,
            gradient_out,
        )
