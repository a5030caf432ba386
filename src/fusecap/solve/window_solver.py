"""Motion instead of poses: the cost of one body over many instants, minimised together.

The front of `fusecap.kernels.window`. Instants are coupled three by three, so the normal equations
are solved in time linear in the number of instants. A window holds a few of them; those that leave
are folded into what they say about the two oldest that stay, so that nothing measured is forgotten,
nor held.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fusecap.body.skeleton import Skeleton
from fusecap.kernels import band, groups, uncertainty, window
from fusecap.kernels.jit import FINITE
from fusecap.kernels.lie import wrap_pose
from fusecap.solve.contact import Contact
from fusecap.solve.pose_solver import PoseSolver
from fusecap.types import GRAVITY_M_S2, Observation

LONGEST_STEP_S = 0.1
"""Longer gaps are not bridged: the motion ends and begins anew."""
EXACT_S = 1e-3
"""Within which an instant is as old as asked for: clocks round."""
_DAMPING, _LEAST_DAMPING, _MAX_DAMPING = 1e-4, 1e-8, 1e6
_KEPT_PROMISE = 0.5
"""Of two steps that were needed, nearly all have a first one farther than this from its promise."""
_UP_M_S2 = np.array([0.0, GRAVITY_M_S2, 0.0])
_RIDGE = 1e-9


class Ahead(NamedTuple):
    """Poses (n, P) of instants after those of a window, and `newest_spread` of the last."""

    theta: Float[np.ndarray, "n p"]
    turn_rad2: Float[np.ndarray, " b"]
    place_m2: Float[np.ndarray, " b"]


class Workspace:
    """Where a window of up to `size` instants is computed; windows that take turns may share it."""

    def __init__(self, skeleton: Skeleton, size: int) -> None:
        b, p, n = skeleton.bone_count, skeleton.pose_size, size
        self.trial, self.step = np.zeros((n, p)), np.zeros((n, p))
        self.posed = (np.zeros((n, b, 3)), np.zeros((n, b, 3, 3)), np.zeros((n, b, 3, 3)))
        self.gathered = (np.zeros((n, 3, b, 6, 6)), np.zeros((n, b, 6)))
        self.scratch = groups.Scratch(
            local=np.zeros((3, 3)),
            information=np.zeros((3, 3)),
            gradient=np.zeros(3),
            motion=np.zeros((b, 6, 3)),
            force=np.zeros((6, 3)),
        )
        self.motions = np.zeros((n, b, 6, 3))
        self.lever, self.square = np.zeros((3, 3, 6)), np.zeros((10, 3, 3))
        self.covariances = np.zeros((uncertainty.ROOM, p, p))
        self.chain = np.zeros((6, p))
        self.hessian, self.gradient = np.zeros((n, 3, p, p)), np.zeros((n, p))


class WindowSolver:
    """The latest instants of the subject of a `PoseSolver`; allocates little but results."""

    def __init__(
        self,
        solver: PoseSolver,
        size: int,
        workspace: Workspace | None = None,
        *,
        ahead: int = 0,
    ) -> None:
        """A window of up to `size` instants, three at least, with room for some `ahead` of it."""
        self._solver = solver
        cameras, landmarks = solver.view_shape
        sensors = len(solver.sites.bone)
        self.size = size
        self.count = 0
        size += ahead
        self._times_ns = np.zeros(size, dtype=np.int64)
        self._theta = np.zeros((size, solver.skeleton.pose_size))
        self._measured = groups.Window(
            keypoints=np.zeros((size, cameras, landmarks, 3)),
            rotation=np.zeros((size, sensors, 3, 3)),
            present=np.zeros((size, sensors)),
            force=np.zeros((size, sensors, 3)),
            contact=np.zeros((size, len(solver.model.floor.resting))),
            steps=np.zeros(size - 1),
            steadiness=solver.steadiness,
        )
        self._workspace = workspace or Workspace(solver.skeleton, size)
        self._feet_m = np.zeros((size, len(solver.model.floor.bone), 3))
        """Floor joints of each instant alone."""
        self._contact = Contact(
            solver.model.floor,
            solver.skeleton.parent_array,
            solver.sites,
            has_floor=solver.options.weights.floor > 0.0,
        )
        p = solver.skeleton.pose_size
        self._newest = np.zeros((p, p))
        """L of the newest instant, after the last step."""
        self._covariance = np.zeros((p, p))
        self._eliminated = False
        """Whether the workspace holds L of all instants at their poses."""
        self._prior: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
        """What those that left say of the two oldest: H (2, 3, P, P), g (2, P), both at (2, P)."""

    @property
    def pose_size(self) -> int:
        """P."""
        return self._theta.shape[1]

    def reset(self) -> None:
        """Forget everything; the next instant begins a motion."""
        self.count = 0
        self._prior = None
        self._eliminated = False

    def goes_on(self, timestamp_ns: int) -> bool:
        """Whether an instant follows the newest without a gap."""
        if not self.count:
            return False
        step_s = (timestamp_ns - self._times_ns[self.count - 1].item()) * 1e-9
        return 0.0 < step_s <= LONGEST_STEP_S

    def push(self, observation: Observation, theta: Float[np.ndarray, " p"]) -> None:
        """One more instant, which begins at `theta`; the oldest leaves where there is no room."""
        if not self.goes_on(observation.timestamp_ns):
            self.reset()
        if self.count == self.size:
            self.fold(1)
        row = self.count
        self._append(observation, theta)
        self._feet_m[row] = self._solver.posed(theta)[0][self._solver.model.floor.bone]

    def stand(self, first: int, near: int) -> None:
        """Tell which feet stand at the instants from `first` on, by all that came until now."""
        first = max(first, 0)
        self._measured.contact[first : self.count] = self._contact.between(
            first, self.count, near, self._measured, self._feet_m
        )

    def _append(self, observation: Observation, theta: Float[np.ndarray, " p"]) -> None:
        row, measured = self.count, self._measured
        self._times_ns[row] = observation.timestamp_ns
        self._theta[row] = theta
        measured.keypoints[row] = self._solver.weighed(observation.keypoints, theta[:3])
        measured.rotation[row] = np.nan
        measured.force[row] = np.nan
        if observation.imu is not None:
            rotation = observation.imu.bone_rotation_in_world
            felt_in_world = observation.imu.accel_in_world_m_s2 + _UP_M_S2
            measured.rotation[row] = rotation
            measured.force[row] = np.einsum("iab,ia->ib", rotation, felt_in_world)
        measured.present[row] = np.isfinite(measured.rotation[row, :, 0, 0])
        if row:
            measured.steps[row - 1] = (self._times_ns[row] - self._times_ns[row - 1]) * 1e-9
        measured.contact[row] = 0.0
        self.count += 1

    def refine(self, max_iterations: int, tolerance: float | None = None) -> float:
        """Levenberg-Marquardt from where the poses are to the cost given back, never a worse one.

        Ends before a step that promises to lower the cost by less than the share `tolerance`;
        without one, after the first that does nearly what the quadratic model promises: then the
        new instant's start was near, and those before it were solved long ago.
        """
        workspace, n = self._workspace, self.count
        theta, trial, step = self._theta[:n], workspace.trial[:n], workspace.step[:n]
        hessian, gradient = workspace.hessian[:n], workspace.gradient[:n]
        cost = self._evaluate(theta)
        damping = _DAMPING if tolerance is None else _LEAST_DAMPING
        for _ in range(max_iterations):
            if not cost < FINITE or damping > _MAX_DAMPING:
                break
            positive = band.eliminate(hessian, gradient, n, damping, _RIDGE, workspace.square[0])
            self._newest[:] = hessian[n - 1, 0]
            promised = 0.5 * float(np.vdot(gradient, gradient))
            near = positive and damping <= _DAMPING
            if near and tolerance is not None and promised <= tolerance * cost:
                self._eliminated = True
                break
            trial_cost = np.inf
            if positive:
                band.step_of(hessian, gradient, step)
                np.add(theta, step, out=trial)
                trial_cost = self._evaluate(trial)
            if not trial_cost < cost:
                damping = max(10.0 * damping, _DAMPING)
                cost = self._evaluate(theta)
                continue
            decrease = cost - trial_cost
            theta[:] = trial
            cost, damping = trial_cost, max(damping / 10.0, _LEAST_DAMPING)
            if tolerance is None and abs(decrease - promised) < _KEPT_PROMISE * promised:
                break
        return cost

    def ahead(
        self, coming: Sequence[tuple[Observation, Float[np.ndarray, " p"]]], max_iterations: int
    ) -> Ahead:
        """Instants that only sensors have reached, each with where it begins; see `Ahead`.

        They go on from the window, which stays as it is, and are as many as there is room for.
        Nobody is said to stand in them: only pictures, or more time, could tell. Poses that have
        gone astray would keep each other there: where no sensor tells of them, or staying at the
        newest costs less than what they come to, they begin there.
        """
        kept, theta = self.count, self._theta[: self.count].copy()
        try:
            for observation, start in coming:
                self._append(observation, start)
            held = self._theta[: self.count].copy()
            held[kept:] = theta[-1]
            told = bool(self._measured.present[kept : self.count].any())
            if not (told and self._evaluate(held) >= self.refine(max_iterations)):
                self._theta[: self.count] = held
                self.refine(max_iterations)
            return Ahead(self._theta[kept : self.count].copy(), *self.newest_spread())
        finally:
            self.count, self._theta[:kept] = kept, theta

    def fold(self, leaving: int) -> None:
        """The oldest leave; what they say of the two after them stays, linearised here.

        The Schur complement of all terms that touch them, eliminated one after the other.
        """
        stay = self.count - leaving
        if stay < 2:
            self.reset()
            return
        workspace, n = self._workspace, leaving + 2
        hessian, gradient = workspace.hessian[:n], workspace.gradient[:n]
        self._evaluate(self._theta[:n], owned=leaving)
        if band.eliminate(hessian, gradient, leaving, 0.0, _RIDGE, workspace.square[0]):
            self._prior = (
                hessian[leaving:].copy(),
                gradient[leaving:].copy(),
                self._theta[leaving:n].copy(),
            )
        else:
            self._prior = None
        measured = self._measured
        for array in (self._times_ns, self._theta, self._feet_m, *measured[:5]):
            array[:stay] = array[leaving : self.count]
        measured.steps[: stay - 1] = measured.steps[leaving : self.count - 1]
        self.count = stay

    def pose(self, back: int = 0) -> Float[np.ndarray, " p"]:
        """The pose `back` instants before the newest, angles at most pi."""
        theta = self._theta[self.count - 1 - back].copy()
        wrap_pose(theta)
        return theta

    def by_one_view(self, back: int = 0) -> bool:
        """Whether one camera and no sensor told of the instant `back` before the newest."""
        row, measured = self.count - 1 - back, self._measured
        views = (measured.keypoints[row, :, :, 2] > 0.0).any(axis=1)
        return bool(views.sum() == 1 and not measured.present[row].any())

    def newest_spread(self) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
        """Traces [rad², m²] of what is known of the newest instant's bones and joints.

        With the damping of the last step in it: less than `spreads` has.
        """
        workspace, square = self._workspace, self._workspace.square[0]
        uncertainty.newest(self._newest, self._covariance, workspace.covariances, square)
        return self._spread(self.count - 1)

    def spreads(self, count: int) -> tuple[Float[np.ndarray, "n b"], Float[np.ndarray, "n b"]]:
        """The same of the oldest instants, by all that the window holds."""
        workspace, square, n = self._workspace, self._workspace.square[0], self.count
        hessian, gradient = workspace.hessian[:n], workspace.gradient[:n]
        turn, place = np.full((2, n, self._solver.skeleton.bone_count), np.nan)
        if not self._eliminated:
            self._evaluate(self._theta[:n])
        if self._eliminated or band.eliminate(hessian, gradient, n, 0.0, _RIDGE, square):
            for t in range(n - 1, -1, -1):
                uncertainty.step_back(hessian, t, workspace.covariances, self._covariance, square)
                turn[t], place[t] = self._spread(t)
        return turn[:count], place[:count]

    def _spread(self, row: int) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, " b"]]:
        workspace = self._workspace
        turn, place = np.zeros((2, self._solver.skeleton.bone_count))
        uncertainty.spread(
            self._solver.model.body,
            groups.Posed(*(array[row] for array in workspace.posed)),
            self._covariance,
            workspace.chain,
            turn,
            place,
        )
        return turn, place

    def back(self, lag_s: float) -> int | None:
        """How many instants before the newest is the first at least `lag_s` old; None: no one.

        A full window that spans less answers with its oldest.
        """
        ages_s = (self._times_ns[self.count - 1] - self._times_ns[: self.count]) * 1e-9
        old = np.flatnonzero(ages_s >= lag_s - EXACT_S)
        if len(old):
            return self.count - 1 - int(old[-1])
        return self.count - 1 if self.count == self.size else None

    def _evaluate(self, theta: Float[np.ndarray, "n p"], owned: int | None = None) -> float:
        """Cost, with normal equations in the workspace, of terms that touch the first `owned`."""
        self._eliminated = False
        workspace, measured, n = self._workspace, self._measured, len(theta)
        hessian, gradient = workspace.hessian[:n], workspace.gradient[:n]
        cost = window.evaluate_window(
            theta,
            n if owned is None else owned,
            self._solver.model,
            groups.Window(
                measured.keypoints[:n],
                measured.rotation[:n],
                measured.present[:n],
                measured.force[:n],
                measured.contact[:n],
                measured.steps[: n - 1],
                measured.steadiness,
            ),
            groups.Posed(*(array[:n] for array in workspace.posed)),
            groups.Gathered(*(array[:n] for array in workspace.gathered)),
            workspace.scratch,
            workspace.motions[:n],
            workspace.lever,
            workspace.square,
            hessian,
            gradient,
        )
        if self._prior is not None:
            cost += window.add_folded(*self._prior, theta[:2], hessian[:2], gradient[:2])
        return cost
