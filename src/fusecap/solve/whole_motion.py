"""The motion nearest to all measurements of a take, while it streams by.

A window so long that its older part no longer changes: `PIECE` instants get their last pose
together, with `AHEAD` after them known, and are folded. Cost grows with a take's length, memory
does not.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.solve.pose_solver import PoseSolver
from fusecap.solve.window_solver import WindowSolver, Workspace
from fusecap.types import Observation

PIECE = 120
AHEAD = 30
"""Half a second at 60 Hz; poses then differ by under a millimetre from those of all instants
solved at once (tests)."""
_MAX_STEPS, _TOLERANCE = 10, 1e-3


class WholeMotion:
    """One subject's poses, held until what comes later says nothing more about them."""

    def __init__(self, solver: PoseSolver, workspace: Workspace | None = None) -> None:
        """Motions that take turns may share a `workspace` for `PIECE + AHEAD` instants."""
        self._window = WindowSolver(solver, PIECE + AHEAD, workspace)

    def goes_on(self, timestamp_ns: int) -> bool:
        """Whether an instant follows without a gap; after one the motion must end."""
        return self._window.goes_on(timestamp_ns)

    def push(
        self, observation: Observation, theta: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "n p"]:
        """The next instant, solved alone to `theta`; the oldest poses not given yet, often none."""
        full = self._window.count == self._window.size
        given = self._settle(PIECE if full else 0)
        self._window.push(observation, theta)
        return given

    def end(self) -> Float[np.ndarray, "n p"]:
        """All poses not given yet; what comes next begins a motion of its own."""
        return self._settle(self._window.count)

    def _settle(self, count: int) -> Float[np.ndarray, "n p"]:
        window = self._window
        if not count:
            return np.empty((0, window.pose_size))
        if window.count > 2:
            window.refine(_MAX_STEPS, _TOLERANCE)
        poses = np.array([window.pose(window.count - 1 - row) for row in range(count)])
        window.fold(count)
        return poses
