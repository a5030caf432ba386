"""The clocks of cameras to a fraction of a frame.

All offsets together minimise the Sampson distances of all pairs,

    r = y' E x / sqrt(|Ex|^2 + |E'y|^2),   x, y at the times that the offsets give them

by Gauss-Newton with a robust loss. dr/d(offset) is the keypoint's velocity across the other view's
line: a hand that moves 2 m/s, 4 m from the camera, crosses 0.6 px per millisecond, so with 5 px of
noise about 100 independent keypoints give 1 ms.

The standard error counts what is alike as one measurement: keypoint errors within a second, and
the constant error of a keypoint in a pair of views (loose calibration, a detector's bias).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from fusecap.calibrate.sync.curves import blocks_of, clustered_covariance
from fusecap.calibrate.sync.signals import View
from fusecap.geometry.camera import Rig
from fusecap.geometry.epipolar import essential_matrix
from fusecap.progress import Progress

Pair = tuple[int, int]

SCALE_PX = 12.0
"""Of the robust loss of distances from the lines."""
MIN_SHARED = 5
"""Keypoints that two views of a person must share."""
MIN_DRIFT_S = 60.0
"""Drift is only estimated where a camera shares at least this with the others."""
_FINE_INSTANTS = 900
_FINE_STEP_S = 0.05
_STEPS, _LAST_STEPS = 5, 2
_MIN_MATCHES = 200
_PROBE_S = 0.01
_MIN_PX = 0.5
_POSE_SIGMA_RAD, _POSE_SIGMA_M = 0.01, 0.03
"""How far a camera may stand from where the calibration has it."""
_ALIKE = 20
"""Neighbouring distances that err alike, when they are weighed against the calibration."""


def essential_of(
    rig: Rig, pair: Pair, poses: Float[np.ndarray, "c 6"] | None = None
) -> Float[np.ndarray, "3 3"]:
    """`poses` turn [rad] and move [m] the cameras."""
    turned, placed = [], []
    for camera in pair:
        known = rig.cameras[camera]
        turn, move = (np.zeros(3), np.zeros(3)) if poses is None else np.split(poses[camera], 2)
        rotation = Rotation.from_rotvec(turn).as_matrix() @ known.rotation
        turned.append(rotation)
        placed.append(known.position_in_world + move)
    return essential_matrix((turned[0], turned[1]), (placed[0], placed[1]))


def _direction(velocity: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.concatenate([velocity, np.zeros((len(velocity), 1))], axis=1)


def homogeneous(point: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
    return np.concatenate([point, np.ones((*point.shape[:-1], 1))], axis=-1)


@dataclass(frozen=True, kw_only=True)
class _Matches:
    """N keypoints that both cameras of a pair saw of one person, homogeneous, and velocities."""

    x: Float[np.ndarray, "n 3"]
    y: Float[np.ndarray, "n 3"]
    velocities: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]
    trends: tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]
    first_s: Float[np.ndarray, " n"]
    second_s: Float[np.ndarray, " n"]
    """Own times of the two cameras."""
    session_s: Float[np.ndarray, " n"]
    landmark: Int[np.ndarray, " n"]
    focal_px: float


@dataclass(frozen=True, kw_only=True)
class Refined:
    """Clocks t = own + offset + drift (own - middle) of C cameras, and their covariance."""

    offset_s: Float[np.ndarray, " c"]
    drift: Float[np.ndarray, " c"]
    error_s: Float[np.ndarray, " c"]
    drift_error: Float[np.ndarray, " c"]
    middle_s: Float[np.ndarray, " c"]
    residual_px: tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]
    """Each camera's median distance from the lines of the others, on the times as they were and as
    found, cameras standing where they were found both times; NaN where views share too little."""


class _Equations:
    """Unknowns: offsets of the free cameras, drifts of those seen for long, and all poses.

    Solves sum z r = 0, z being dr/d(unknown) with the keypoints' longer-time velocities: noise that
    moves a keypoint and the velocity it has from that noise do not meet in a product.
    """

    def __init__(
        self, rig: Rig, views: Sequence[View], offset_s: Float[np.ndarray, " c"], reference: int
    ) -> None:
        self.rig, self.views = rig, views
        count = len(views)
        used = [c for c in range(count) if np.isfinite(offset_s[c])]
        free = [c for c in used if c != reference]
        drifting = [c for c in free if _shared_s(views, offset_s, c, used) >= MIN_DRIFT_S]
        self.pairs = [(i, j) for n, i in enumerate(used) for j in used[n + 1 :]]
        self.middle_s = np.array([(v.times_s[0] + v.times_s[-1]) / 2 for v in views])
        self.offset_column = {c: n for n, c in enumerate(free)}
        self.drift_column = {c: len(free) + n for n, c in enumerate(drifting)}
        self.clocks = len(free) + len(drifting)
        self.pose_column = {c: self.clocks + 6 * n for n, c in enumerate(used)}
        self.size = self.clocks + 6 * len(used)
        self.offset_s, self.drift = offset_s.copy(), np.zeros(count)
        self.poses = np.zeros((count, 6))
        self.scale_px = float("nan")

    def move(self, change: Float[np.ndarray, " p"]) -> None:
        """Adds a step to all unknowns."""
        for camera, column in self.offset_column.items():
            self.offset_s[camera] += change[column]
        for camera, column in self.drift_column.items():
            self.drift[camera] += change[column]
        for camera, column in self.pose_column.items():
            self.poses[camera] += change[column : column + 6]

    def evaluate(self, of: int | None = None) -> _System | None:
        """The equations where the unknowns are; None where views share too little.

        Only of the pairs with one camera, if named.
        """
        pairs = [pair for pair in self.pairs if of is None or of in pair]
        matches = [self._match(pair) for pair in pairs]
        distances = [
            _sampson_px(essential_of(self.rig, pair, self.poses), some)
            for pair, some in zip(pairs, matches, strict=True)
        ]
        everything = np.abs(np.concatenate(distances)) if distances else np.empty(0)
        if len(everything) < _MIN_MATCHES or not self.offset_column:
            return None
        median_px = max(float(np.median(everything)), _MIN_PX)
        if not np.isfinite(self.scale_px):
            self.scale_px = max(3.0, 2.5 * median_px)
        prior = np.zeros(self.size)
        unknown = np.zeros(self.size)
        for camera, column in self.pose_column.items():
            sigma = np.repeat([_POSE_SIGMA_RAD, _POSE_SIGMA_M], 3)
            prior[column : column + 6] = _ALIKE * (1.48 * median_px) ** 2 / sigma**2
            unknown[column : column + 6] = self.poses[camera]
        slope, right = np.diag(prior), prior * unknown
        gradients, at_s, clusters = [], [], []
        for number, (pair, some, r) in enumerate(zip(pairs, matches, distances, strict=True)):
            columns, by, weighing = self._derivatives(pair, some)
            weight = 1.0 / (1.0 + (r / self.scale_px) ** 2) ** 2
            slope[np.ix_(columns, columns)] += weighing.T @ (weight[:, None] * by)
            right[columns] += weighing.T @ (weight * r)
            gradient = np.zeros((len(r), self.size))
            gradient[:, columns] = (weight * r)[:, None] * weighing
            gradients.append(gradient)
            at_s.append(some.session_s)
            clusters.append(some.landmark + 1000 * number)
        return _System(
            slope=slope,
            right=right,
            gradient=np.concatenate(gradients),
            block=blocks_of(np.concatenate(at_s)),
            cluster=np.concatenate(clusters),
        )

    def _derivatives(
        self, pair: Pair, some: _Matches
    ) -> tuple[list[int], Float[np.ndarray, "n q"], Float[np.ndarray, "n q"]]:
        """The unknowns that matter to a pair, dr/d(unknown), and the same with the trends."""
        essential = essential_of(self.rig, pair, self.poses)
        norm = _norm(essential, some)
        # Where a keypoint is near its line the norm's change does not matter.
        product = (some.y[:, :, None] * some.x[:, None, :]).reshape(-1, 9)
        product *= (some.focal_px / norm)[:, None]
        columns, by, weighing = [], [], []
        for side, camera in enumerate(pair):
            for axis in range(6):
                moved = self.poses.copy()
                moved[camera, axis] += 1e-5
                change = (essential_of(self.rig, pair, moved) - essential).ravel() / 1e-5
                columns.append(self.pose_column[camera] + axis)
                by.append(product @ change)
                weighing.append(by[-1])
            if camera not in self.offset_column:
                continue
            own_s = (some.first_s, some.second_s)[side] - self.middle_s[camera]
            clock = _by_clock(essential, some, side, some.velocities[side])
            trend = _by_clock(essential, some, side, some.trends[side])
            columns.append(self.offset_column[camera])
            by.append(clock)
            weighing.append(trend)
            if camera in self.drift_column:
                columns.append(self.drift_column[camera])
                by.append(clock * own_s)
                weighing.append(trend * own_s)
        return columns, np.stack(by, axis=1), np.stack(weighing, axis=1)

    def _match(self, pair: Pair) -> _Matches:
        return _matches(
            self.rig, self.views, pair, self.offset_s, self.drift, self.middle_s, self.poses
        )

    def distances_px(self) -> Float[np.ndarray, " c"]:
        """Each camera's median distance in its pairs, where the unknowns are."""
        by_camera: list[list[Float[np.ndarray, " n"]]] = [[] for _ in self.views]
        for pair in self.pairs:
            r = _sampson_px(essential_of(self.rig, pair, self.poses), self._match(pair))
            for camera in pair:
                by_camera[camera].append(np.abs(r))
        pooled = [np.concatenate(some) if some else np.empty(0) for some in by_camera]
        return np.array([np.median(r) if len(r) else np.nan for r in pooled])

    def true_slope(self, here: _System) -> Float[np.ndarray, "p p"]:
        """`here.slope` with its columns of clocks by finite differences.

        Noise is also in the velocities; their products say more than the data know.
        """
        slope = here.slope.copy()
        reach_s = 0.5 * float(np.max(self.middle_s - [v.times_s[0] for v in self.views]))
        probes = [(c, n, _PROBE_S) for c, n in self.offset_column.items()]
        probes += [(c, n, _PROBE_S / reach_s) for c, n in self.drift_column.items()]
        for camera, column, size in probes:
            step = np.zeros(self.size)
            step[column] = size
            sides = []
            for sign in (1.0, -1.0):
                self.move(sign * step)
                there = self.evaluate(camera)
                self.move(-sign * step)
                sides.append(here.right if there is None else there.right)
            slope[:, column] = (sides[0] - sides[1]) / (2 * size)
        return slope


@dataclass(frozen=True, kw_only=True)
class _System:
    """Equations of P unknowns from N measurements."""

    slope: Float[np.ndarray, "p p"]
    right: Float[np.ndarray, " p"]
    gradient: Float[np.ndarray, "n p"]
    block: Int[np.ndarray, " n"]
    cluster: Int[np.ndarray, " n"]


def refine(
    rig: Rig,
    views: Sequence[View],
    offset_s: Float[np.ndarray, " c"],
    reference: int,
    *,
    progress: Progress | None = None,
) -> Refined:
    """All finite offsets together; the reference keeps its own."""
    equations = _Equations(rig, views, offset_s, reference)
    covariance = np.full((equations.size, equations.size), np.nan)
    slope: Float[np.ndarray, "p p"] | None = None
    for step in range(_STEPS + _LAST_STEPS):
        if progress:
            progress("refining cameras", step, _STEPS + _LAST_STEPS)
        here = equations.evaluate()
        if here is None:
            break
        if step == _STEPS:
            slope = equations.true_slope(here)
            covariance = clustered_covariance(here.gradient, slope, here.block, here.cluster)
        change = -np.linalg.solve(here.slope if slope is None else slope, here.right)
        free = len(equations.offset_column)
        change[:free] = np.clip(change[:free], -0.05, 0.05)
        equations.move(change)
    if progress:
        progress("refining cameras", _STEPS + _LAST_STEPS, _STEPS + _LAST_STEPS)
    error, drift_error = np.full(len(views), np.nan), np.full(len(views), np.nan)
    error[reference] = 0.0
    for camera, column in equations.offset_column.items():
        error[camera] = _root(covariance[column, column])
    for camera, column in equations.drift_column.items():
        drift_error[camera] = _root(covariance[column, column])
    found_s, drift, after_px = equations.offset_s, equations.drift, equations.distances_px()
    equations.offset_s = np.where(np.isfinite(found_s), 0.0, np.nan)
    equations.drift = np.zeros(len(views))
    return Refined(
        offset_s=found_s,
        drift=np.where(np.isfinite(drift_error), drift, np.nan),
        error_s=error,
        drift_error=drift_error,
        middle_s=equations.middle_s,
        residual_px=(equations.distances_px(), after_px),
    )


def _root(variance: float) -> float:
    return float(np.sqrt(variance)) if variance >= 0 else float("nan")


def _shared_s(
    views: Sequence[View], offset_s: Float[np.ndarray, " c"], camera: int, used: Sequence[int]
) -> float:
    """The longest stretch that a camera shares with another."""
    start, end = views[camera].times_s[[0, -1]] + offset_s[camera]
    shared = [0.0]
    for other in used:
        if other != camera:
            low, high = views[other].times_s[[0, -1]] + offset_s[other]
            shared.append(float(min(end, high) - max(start, low)))
    return max(shared)


def _matches(
    rig: Rig,
    views: Sequence[View],
    pair: Pair,
    offset_s: Float[np.ndarray, " c"],
    drift: Float[np.ndarray, " c"],
    middle_s: Float[np.ndarray, " c"],
    poses: Float[np.ndarray, "c 6"],
) -> _Matches:
    """People that two cameras see, each with the other view's that fits best, if mutual."""
    start = max(float(views[c].times_s[0] + offset_s[c]) for c in pair)
    end = min(float(views[c].times_s[-1] + offset_s[c]) for c in pair)
    step_s = max((end - start) / _FINE_INSTANTS, _FINE_STEP_S)
    at_s = np.arange(start, end, step_s) if end > start else np.empty(0)
    own_s = [middle_s[c] + (at_s - offset_s[c] - middle_s[c]) / (1 + drift[c]) for c in pair]
    focal_px = sum(views[c].focal_px for c in pair) / 2
    (x, vx, zx), (y, vy, zy) = (views[c].at(s) for c, s in zip(pair, own_s, strict=True))
    x, y = homogeneous(x), homogeneous(y)
    essential = essential_of(rig, pair, poses)
    line, back = x @ essential.T, y @ essential  # t p k 3, t q k 3
    product = np.einsum("tpki,tqki->tpqk", line, y)
    norm = np.sum(line[..., :2] ** 2, -1)[:, :, None] + np.sum(back[..., :2] ** 2, -1)[:, None]
    squared = focal_px**2 * product**2 / np.maximum(norm, 1e-12)
    loss = squared / (squared + SCALE_PX**2)
    shared = np.isfinite(loss)
    number = shared.sum(-1)
    cost = np.where(shared, loss, 0.0).sum(-1) / np.maximum(number, 1)
    cost = np.where(number < MIN_SHARED, np.inf, cost)
    mutual = np.isfinite(cost)
    mutual &= cost <= cost.min(axis=2, keepdims=True, initial=np.inf)
    mutual &= cost <= cost.min(axis=1, keepdims=True, initial=np.inf)
    t, p, q = np.nonzero(mutual)
    kept = shared[t, p, q] & np.isfinite(vx[t, p, :, 0] + vy[t, q, :, 0])
    row, landmark = np.nonzero(kept)
    t, p, q = t[row], p[row], q[row]
    return _Matches(
        x=x[t, p, landmark],
        y=y[t, q, landmark],
        velocities=(_direction(vx[t, p, landmark]), _direction(vy[t, q, landmark])),
        trends=(_direction(zx[t, p, landmark]), _direction(zy[t, q, landmark])),
        first_s=own_s[0][t],
        second_s=own_s[1][t],
        session_s=at_s[t],
        landmark=landmark,
        focal_px=focal_px,
    )


def _norm(essential: Float[np.ndarray, "3 3"], some: _Matches) -> Float[np.ndarray, " n"]:
    line, back = some.x @ essential.T, some.y @ essential
    return np.sqrt(np.sum(line[:, :2] ** 2, 1) + np.sum(back[:, :2] ** 2, 1) + 1e-12)


def _sampson_px(essential: Float[np.ndarray, "3 3"], some: _Matches) -> Float[np.ndarray, " n"]:
    product = np.sum((some.x @ essential.T) * some.y, axis=1)
    return some.focal_px * product / _norm(essential, some)


def _by_clock(
    essential: Float[np.ndarray, "3 3"],
    some: _Matches,
    side: int,
    velocity: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " n"]:
    """Derivative of the distance by the offset of the first (0) or second (1) camera [px/s].

    A later clock shows an earlier image.
    """
    x, y = (velocity, some.y) if side == 0 else (some.x, velocity)
    product = np.sum((x @ essential.T) * y, axis=1)
    return -some.focal_px * product / _norm(essential, some)
