"""The motion nearest to all measurements of a take, while it streams by.

A window so long that its older part no longer changes: `PIECE` instants get their last pose
together, with `AHEAD` after them known, and are folded. Cost grows with a take's length, memory
does not. Without cameras what comes later moves the root by centimetres even then: it goes over to
its new place for as long as instants had been solved before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fusecap.solve.pose_solver import PoseSolver
from fusecap.solve.uncertainty import Sigmas, sigmas, turn_shares
from fusecap.solve.window_solver import WindowSolver, Workspace
from fusecap.types import Observation

PIECE = 120
AHEAD = 30
"""Half a second at 60 Hz; poses then differ by under a millimetre from those of all instants
solved at once (tests)."""
_LATER = 2.0
"""What came later halves the variances that the normal equations give, but hardly the errors: they
are like those before."""
_MAX_STEPS, _TOLERANCE = 10, 1e-3
NEAR = 4
"""Instants before and after one, that tell noise of a foot from a step."""


class Settled(NamedTuple):
    """The last pose of an instant, angles at most pi, and its error bars."""

    theta: Float[np.ndarray, " p"]
    sigmas: Sigmas


class WholeMotion:
    """One subject's poses, held until what comes later says nothing more about them."""

    def __init__(self, solver: PoseSolver, workspace: Workspace | None = None) -> None:
        """Motions that take turns may share a `workspace` for `PIECE + AHEAD` instants."""
        self._window = WindowSolver(solver, PIECE + AHEAD, workspace)
        self._turn_shares = turn_shares(solver.skeleton)
        self._seam_m = np.zeros((0, 3))
        """Where the root was at instants that were already solved when those before them left."""
        self._told = 0
        """Instants that were asked which feet stand; what came now tells of the last of them."""

    def goes_on(self, timestamp_ns: int) -> bool:
        """Whether an instant follows without a gap; after one the motion must end."""
        return self._window.goes_on(timestamp_ns)

    def push(self, observation: Observation, theta: Float[np.ndarray, " p"]) -> list[Settled]:
        """The next instant, solved alone to `theta`; the oldest not given yet, often none."""
        full = self._window.count == self._window.size
        given = self._settle(PIECE if full else 0)
        self._window.push(observation, theta)
        return given

    def end(self) -> list[Settled]:
        """All instants not given yet; what comes next begins a motion of its own."""
        return self._settle(self._window.count)

    def _settle(self, count: int) -> list[Settled]:
        window = self._window
        if not count:
            return []
        window.stand(self._told - 2 * NEAR, NEAR)
        if window.count > 2:
            window.refine(_MAX_STEPS, _TOLERANCE)
        spreads = (_LATER * spread for spread in window.spreads(count))
        settled = []
        for row, (turn, place) in enumerate(zip(*spreads, strict=True)):
            back = window.count - 1 - row
            bars = sigmas(turn, place, self._turn_shares, one_view=window.by_one_view(back))
            theta = window.pose(back)
            if row < len(self._seam_m):
                new = (row + 1) / (len(self._seam_m) + 1)
                theta[:3] += (1.0 - new * new * (3.0 - 2.0 * new)) * (self._seam_m[row] - theta[:3])
            settled.append(Settled(theta, bars))
        window.fold(count)
        left = range(window.count - 1, -1, -1)
        self._seam_m = np.array([window.pose(back)[:3] for back in left]).reshape(-1, 3)
        self._told = window.count
        return settled
