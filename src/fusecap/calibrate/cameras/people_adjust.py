"""Bundle adjustment over people: cameras, landmarks in the world and limb lengths at once.

    sum  w rho_c(|u - u_hat(camera, X)| / sigma_px)           every keypoint of every view
       + sum  rho_c((|X_i - X_j| - L_limb) / sigma_limb)      every limb at every instant
       + sum  |camera - camera_start|^2 / sigma_start^2       what the start is trusted with

rho_c is Cauchy's loss, c = `TURN`. Unknown are six numbers per camera (more where `Free` says so),
the landmarks X of every person-instant, and one length per person and limb. sigma_px is measured
from the residuals and shrinks as cameras fall into place, so that a keypoint 30 px off counts at
the start and is an outlier at the end.

Limbs tie the landmarks of one person at one instant together and to nobody else. So the normal
equations are eliminated (Schur) one person-instant at a time, 3 K x 3 K, and what is left is as
small as cameras and limbs are many. Levenberg and Marquardt's damping serves the seven directions
of a moved, turned or scaled world, which no residual sees.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.bundle_adjustment import RAYLEIGH_MEDIAN
from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.projection_derivatives import PARAMETERS, moved, projection_derivatives

TURN = 2.385
"""Of Cauchy's loss, in sigmas: 95 % efficient where errors are normal."""
SIGMA_LIMB_M = 0.025
"""Scatter of a limb's length between two keypoints that each scatter by some 2 cm."""
MIN_SIGMA_PX = 3.0
"""Of a 1920-pixel-wide image: no detector scatters less, so keypoints that agree better than that
are not allowed to outvote the others."""
MAX_STEPS = 30
STEPS_ON_THE_WAY = 4
"""While sigma_px still shrinks."""
SETTLED = 1e-4
"""Share of the cost, or of a hundredth of what noise alone would cost, by which a step must lower
it; an adjustment ends with the first that does not."""


@dataclass(frozen=True, kw_only=True)
class Free:
    """What may move beside the camera poses, and what the start is trusted with (sigmas).

    Sigmas are those of a rough calibration: so weak that any direction which people show is theirs.
    """

    focal: bool = False
    centre: bool = False
    distortion: bool = False
    rotation_rad: float = np.radians(5.0)
    position_m: float = 0.3
    focal_share: float = 0.03
    """Of the focal length; fx and fy move together."""
    centre_share: float = 0.02
    """Of the image's larger side."""
    k1: float = 0.05
    k2: float = 0.05

    @property
    def intrinsics(self) -> int:
        """Numbers per camera beyond the six of its pose."""
        return self.focal + 2 * self.centre + 2 * self.distortion

    def basis(self, camera: Camera) -> tuple[Float[np.ndarray, "15 m"], Float[np.ndarray, " m"]]:
        """Steps of the camera's fifteen numbers per free number, and the latter's sigmas.

        The three of the position are of the centre of projection, along the camera's axes, so that
        turning a camera does not carry it around the origin.
        """
        columns, sigma = [], []
        t = camera.translation
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        for axis in range(3):
            column = np.zeros(PARAMETERS)
            column[axis] = 1.0
            column[3:6] = -cross[:, axis]
            columns.append(column)
            sigma.append(self.rotation_rad)
        for axis in range(3):
            column = np.zeros(PARAMETERS)
            column[3 + axis] = -1.0
            columns.append(column)
            sigma.append(self.position_m)
        rest: list[tuple[dict[int, float], float]] = []
        if self.focal:
            focal = {6: float(camera.matrix[0, 0]), 7: float(camera.matrix[1, 1])}
            rest.append((focal, self.focal_share))
        if self.centre:
            spread = self.centre_share * max(camera.size_px)
            rest += [({8: 1.0}, spread), ({9: 1.0}, spread)]
        if self.distortion:
            rest += [({10: 1.0}, self.k1), ({11: 1.0}, self.k2)]
        for entries, spread in rest:
            column = np.zeros(PARAMETERS)
            column[list(entries)] = list(entries.values())
            columns.append(column)
            sigma.append(spread)
        return np.stack(columns, axis=1), np.array(sigma)


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """N person-instants seen by C cameras, K landmarks each, P people, L limbs."""

    keypoints: Float[np.ndarray, "n c k 3"]
    """x, y [px], confidence; 0 where missing or not to be used."""
    person: Int[np.ndarray, " n"]
    limbs: Int[np.ndarray, "l 2"]
    """Pairs of landmarks a fixed distance apart."""
    weight: Float[np.ndarray, " n"]
    """How often a person-instant counts."""

    @property
    def people(self) -> int:
        """P; one more than the highest index."""
        return int(self.person.max()) + 1 if len(self.person) else 0


@dataclass(frozen=True, kw_only=True)
class State:
    """What is adjusted."""

    rig: Rig
    points: Float[np.ndarray, "n k 3"]
    """Landmarks in the world [m]; NaN where they are left out."""
    lengths_m: Float[np.ndarray, "p l"]


@dataclass(frozen=True, kw_only=True)
class AdjustedByPeople:
    """The end of an adjustment."""

    state: State
    sigma_px: float
    """Of one coordinate of a keypoint, in a 1920-pixel-wide image."""
    information: Float[np.ndarray, "g g"]
    """Of the cameras' free numbers with landmarks and lengths eliminated, in units of sigma_px."""
    cost: float
    steps: int


@dataclass(kw_only=True)
class Linear:
    """Normal equations H x = -g at a state: cameras and lengths (global), landmarks (local)."""

    cost: float
    h_global: Float[np.ndarray, "q q"]
    g_global: Float[np.ndarray, " q"]
    h_local: Float[np.ndarray, "n k3 k3"]
    g_local: Float[np.ndarray, "n k3"]
    h_cross: Float[np.ndarray, "n q k3"] = field(repr=False)
    """Rows of an own person's limbs and of all cameras; the others are zero."""


def lengths_of(points: Float[np.ndarray, "n k 3"], evidence: Evidence) -> Float[np.ndarray, "p l"]:
    """Median length [m] of every limb of every person; NaN where it was never measured."""
    ends = points[:, evidence.limbs]
    length = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1)
    result = np.full((evidence.people, len(evidence.limbs)), np.nan)
    for person in range(evidence.people):
        own = length[evidence.person == person]
        measured = np.isfinite(own).any(axis=0)
        result[person, measured] = np.nanmedian(own[:, measured], axis=0)
    return result


def residuals_px(
    rig: Rig, keypoints: Float[np.ndarray, "n c k 3"], points: Float[np.ndarray, "n k 3"]
) -> Float[np.ndarray, "n c k"]:
    """Distance of each used keypoint from its landmark's image, in the camera's own pixels."""
    result = np.full(keypoints.shape[:3], np.nan)
    for c, camera in enumerate(rig.cameras):
        pixels = camera.project(points.reshape(-1, 3)).reshape(*points.shape[:2], 2)
        away = np.linalg.norm(pixels - keypoints[:, c, :, :2], axis=-1)
        result[:, c] = np.where(keypoints[:, c, :, 2] > 0, away, np.nan)
    return result


def cost_of(state: State, start: Rig, evidence: Evidence, free: Free, sigma_px: float) -> float:
    """The sum at the top."""
    scaled = residuals_px(state.rig, evidence.keypoints, state.points)
    scaled *= np.array([camera.pixel_scale for camera in state.rig.cameras])[:, None] / sigma_px
    known = np.isfinite(state.points[:, None, :, 0]) & (evidence.keypoints[..., 2] > 0)
    weight = np.where(known, evidence.keypoints[..., 2], 0.0) * evidence.weight[:, None, None]
    # Behind a camera: as bad as a residual can be imagined, and no way down.
    loss = _loss(np.where(known & np.isnan(scaled), 1e3, np.nan_to_num(scaled)) ** 2)
    total = float((weight * loss).sum())
    residual, _, _ = _limb_residuals(state, evidence)
    total += float((evidence.weight[:, None] * _loss(residual**2)).sum())
    for camera, begin in zip(state.rig.cameras, start.cameras, strict=True):
        offset, sigma = _offset(camera, begin, free)
        total += 0.5 * float(((offset / sigma) ** 2).sum())
    return total


def linearise(state: State, start: Rig, evidence: Evidence, free: Free, sigma_px: float) -> Linear:
    """Gauss-Newton's normal equations, each residual weighted by its robust loss."""
    instants, cameras, landmarks, _ = evidence.keypoints.shape
    own = 6 + free.intrinsics
    limbs = len(evidence.limbs)
    size = cameras * own + evidence.people * limbs
    linear = Linear(
        cost=cost_of(state, start, evidence, free, sigma_px),
        h_global=np.zeros((size, size)),
        g_global=np.zeros(size),
        h_local=np.zeros((instants, 3 * landmarks, 3 * landmarks)),
        g_local=np.zeros((instants, 3 * landmarks)),
        h_cross=np.zeros((instants, size, 3 * landmarks)),
    )
    blocks = linear.h_local.reshape(instants, landmarks, 3, landmarks, 3)
    known = np.isfinite(state.points[:, :, 0])
    points = np.where(known[:, :, None], state.points, 0.0)
    every = np.arange(landmarks)
    for c, (camera, begin) in enumerate(zip(state.rig.cameras, start.cameras, strict=True)):
        rows = slice(c * own, (c + 1) * own)
        basis, _ = free.basis(camera)
        seen = known & (evidence.keypoints[:, c, :, 2] > 0)
        depth = points @ camera.rotation[2] + camera.translation[2]
        seen &= depth > 1e-6
        at, landmark = np.nonzero(seen)
        pixels, d_camera, d_point = projection_derivatives(camera, points[at, landmark])
        scale = camera.pixel_scale / sigma_px
        residual = (pixels - evidence.keypoints[at, c, landmark, :2]) * scale
        j_camera, j_point = (d_camera @ basis) * scale, d_point * scale
        weight = evidence.keypoints[at, c, landmark, 2] * evidence.weight[at]
        weight = weight * _slope(np.sum(residual**2, axis=1))
        w_camera, w_point = weight[:, None, None] * j_camera, weight[:, None, None] * j_point
        linear.h_global[rows, rows] += np.einsum("mri,mrj->ij", w_camera, j_camera)
        linear.g_global[rows] += np.einsum("mri,mr->i", w_camera, residual)
        to_points = np.zeros((instants, landmarks, own, 3))
        to_points[at, landmark] = np.einsum("mri,mrj->mij", w_camera, j_point)
        linear.h_cross[:, rows] = to_points.transpose(0, 2, 1, 3).reshape(instants, own, -1)
        point_blocks = np.zeros((instants, landmarks, 3, 3))
        point_blocks[at, landmark] = np.einsum("mri,mrj->mij", w_point, j_point)
        blocks[:, every, :, every, :] += point_blocks.transpose(1, 0, 2, 3)
        gradient = np.zeros((instants, landmarks, 3))
        gradient[at, landmark] = np.einsum("mri,mr->mi", w_point, residual)
        linear.g_local += gradient.reshape(instants, -1)
        offset, sigma = _offset(camera, begin, free)
        linear.h_global[rows, rows] += np.diag(1.0 / sigma**2)
        linear.g_global[rows] += offset / sigma**2
    residual, direction, measured = _limb_residuals(state, evidence)
    weight = evidence.weight[:, None] * np.where(measured, _slope(residual**2), 0.0)
    first = cameras * own
    rows = np.arange(instants)
    gradient = linear.g_local.reshape(instants, landmarks, 3)
    for limb, (i, j) in enumerate(evidence.limbs):
        along = direction[:, limb] / SIGMA_LIMB_M
        w = weight[:, limb]
        square = w[:, None, None] * along[:, :, None] * along[:, None, :]
        blocks[:, i, :, i, :] += square
        blocks[:, j, :, j, :] += square
        blocks[:, i, :, j, :] -= square
        blocks[:, j, :, i, :] -= square
        pull = (w * residual[:, limb])[:, None] * along
        gradient[:, i] += pull
        gradient[:, j] -= pull
        length = first + evidence.person * limbs + limb
        np.add.at(linear.h_global, (length, length), w / SIGMA_LIMB_M**2)
        np.add.at(linear.g_global, length, -w * residual[:, limb] / SIGMA_LIMB_M)
        cross = linear.h_cross.reshape(instants, size, landmarks, 3)
        cross[rows, length, i] -= w[:, None] * along / SIGMA_LIMB_M
        cross[rows, length, j] += w[:, None] * along / SIGMA_LIMB_M
    return linear


def stepped(state: State, evidence: Evidence, free: Free, step: np.ndarray, local: np.ndarray):
    """The state after a step of the global and the local numbers."""
    own = 6 + free.intrinsics
    cameras = []
    for c, camera in enumerate(state.rig.cameras):
        basis, _ = free.basis(camera)
        cameras.append(_moved_about_centre(camera, basis, step[c * own : (c + 1) * own]))
    lengths = step[len(cameras) * own :].reshape(state.lengths_m.shape)
    return State(
        rig=Rig(cameras=tuple(cameras)),
        points=state.points + local.reshape(state.points.shape),
        lengths_m=state.lengths_m + lengths,
    )


def adjust(
    state: State,
    start: Rig,
    evidence: Evidence,
    free: Free,
    *,
    sigma_px: float,
) -> AdjustedByPeople:
    """Adjust until the cost rests and sigma_px is the residuals'; `start` is what is trusted.

    `sigma_px` is where to begin: the residuals that the state has, in a 1920-pixel-wide image.
    """
    steps = 0
    while True:
        state, _, taken = _descend(state, start, evidence, free, sigma_px, STEPS_ON_THE_WAY)
        steps += taken
        measured = _sigma_px(state, evidence)
        if measured > 0.9 * sigma_px:
            break
        sigma_px = max(measured, 0.4 * sigma_px)
    state, linear, taken = _descend(state, start, evidence, free, sigma_px, MAX_STEPS)
    steps += taken
    count = len(start) * (6 + free.intrinsics)
    reduced, _, _ = _eliminated(linear, evidence, len(start) * (6 + free.intrinsics), 0.0)
    return AdjustedByPeople(
        state=state,
        sigma_px=sigma_px,
        information=_without_lengths(reduced, count),
        cost=linear.cost,
        steps=steps,
    )


def _descend(
    state: State,
    start: Rig,
    evidence: Evidence,
    free: Free,
    sigma_px: float,
    most: int,
) -> tuple[State, Linear, int]:
    damping, cameras = 1e-4, len(start) * (6 + free.intrinsics)
    linear = linearise(state, start, evidence, free, sigma_px)
    least = 0.01 * float((evidence.keypoints[..., 2] > 0).sum())
    for number in range(1, most + 1):
        while True:
            step, local = _solve(linear, evidence, cameras, damping)
            trial = stepped(state, evidence, free, step, local)
            cost = cost_of(trial, start, evidence, free, sigma_px)
            if cost <= linear.cost or damping > 1e8:
                break
            damping *= 8
        if cost > linear.cost:
            return state, linear, number
        gained = linear.cost - cost
        state, damping = trial, max(damping / 8, 1e-9)
        linear = linearise(state, start, evidence, free, sigma_px)
        if gained <= SETTLED * max(linear.cost, least):
            return state, linear, number
    return state, linear, most


def _solve(
    linear: Linear, evidence: Evidence, cameras: int, damping: float
) -> tuple[np.ndarray, np.ndarray]:
    """The damped step of the global and the local numbers, by Schur's complement."""
    reduced, gradient, (eliminated, own_rows) = _eliminated(linear, evidence, cameras, damping)
    diagonal = np.diag(linear.h_global).copy()
    reduced[np.diag_indices(len(reduced))] += damping * diagonal + np.where(diagonal == 0, 1, 0)
    step = -np.linalg.solve(reduced, gradient)
    local = -eliminated[:, :, -1] - np.einsum("nkr,nr->nk", eliminated[:, :, :-1], step[own_rows])
    return step, local


def _eliminated(
    linear: Linear, evidence: Evidence, cameras: int, damping: float
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Reduced matrix and gradient, and per person-instant H^-1 [cross', g] with its global rows."""
    instants = len(linear.g_local)
    limbs = len(evidence.limbs)
    own_rows = np.concatenate(
        [
            np.broadcast_to(np.arange(cameras), (instants, cameras)),
            cameras + evidence.person[:, None] * limbs + np.arange(limbs),
        ],
        axis=1,
    )
    local = linear.h_local.copy()
    diagonal = np.einsum("nii->ni", local)
    diagonal += damping * diagonal + np.where(diagonal <= 0, 1.0, 0.0)
    cross = np.take_along_axis(linear.h_cross, own_rows[:, :, None], axis=1)
    right = np.concatenate([cross.transpose(0, 2, 1), linear.g_local[:, :, None]], axis=2)
    eliminated = np.linalg.solve(local, right)
    products = cross @ eliminated
    reduced, gradient = linear.h_global.copy(), linear.g_global.copy()
    for person in range(evidence.people):
        own = evidence.person == person
        if own.any():
            total = products[own].sum(axis=0)
            rows = own_rows[own][0]
            reduced[np.ix_(rows, rows)] -= total[:, :-1]
            gradient[rows] -= total[:, -1]
    return reduced, gradient, (eliminated, own_rows)


def _without_lengths(reduced: np.ndarray, count: int) -> np.ndarray:
    """The cameras' information once the lengths are eliminated too."""
    lengths = reduced[count:, count:].copy()
    empty = np.diag(lengths) <= 0
    lengths[empty, empty] = 1.0
    return reduced[:count, :count] - reduced[:count, count:] @ np.linalg.solve(
        lengths, reduced[count:, :count]
    )


def _sigma_px(state: State, evidence: Evidence) -> float:
    """Of one coordinate, from the median residual, less what the landmarks took up."""
    residual = residuals_px(state.rig, evidence.keypoints, state.points)
    residual *= np.array([camera.pixel_scale for camera in state.rig.cameras])[:, None]
    used = residual[np.isfinite(residual)]
    if not len(used):
        return MIN_SIGMA_PX
    measured = 2 * len(used)
    left = max(measured - 3 * int(np.isfinite(state.points[:, :, 0]).sum()), 0.1 * measured)
    sigma = float(np.median(used)) / RAYLEIGH_MEDIAN * float(np.sqrt(measured / left))
    return max(sigma, MIN_SIGMA_PX)


def _limb_residuals(
    state: State, evidence: Evidence
) -> tuple[Float[np.ndarray, "n l"], Float[np.ndarray, "n l 3"], Bool[np.ndarray, "n l"]]:
    """In sigmas, zero where not measured; directions from the second end to the first."""
    ends = state.points[:, evidence.limbs]
    link = ends[:, :, 0] - ends[:, :, 1]
    length = np.linalg.norm(link, axis=-1)
    residual = (length - state.lengths_m[evidence.person]) / SIGMA_LIMB_M
    measured = np.isfinite(residual) & (length > 1e-6)
    direction = np.where(measured[..., None], link / np.where(measured, length, 1.0)[..., None], 0)
    return np.where(measured, residual, 0.0), direction, measured


def _moved_about_centre(camera: Camera, basis: np.ndarray, step: np.ndarray) -> Camera:
    """Turn about the centre of projection, then shift it; exact where the basis is linear."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    shift = camera.rotation.T @ step[3:6]
    intrinsics = basis[:, 6:] @ step[6:]
    turned = moved(camera, np.concatenate([step[:3], np.zeros(3), intrinsics[6:]]))
    translation = turn @ camera.translation - turn @ camera.rotation @ shift
    return moved(
        turned, np.concatenate([np.zeros(3), translation - camera.translation, np.zeros(9)])
    )


def _offset(
    camera: Camera, start: Camera, free: Free
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """How far the free numbers are from their start, and the sigmas of that."""
    basis, sigma = free.basis(start)
    turn = Rotation.from_matrix(camera.rotation @ start.rotation.T).as_rotvec()
    shift = start.rotation @ (camera.position_in_world - start.position_in_world)
    numbers = np.concatenate(
        [
            [
                camera.matrix[0, 0] - start.matrix[0, 0],
                camera.matrix[1, 1] - start.matrix[1, 1],
                camera.matrix[0, 2] - start.matrix[0, 2],
                camera.matrix[1, 2] - start.matrix[1, 2],
            ],
            camera.distortion - start.distortion,
        ]
    )
    columns = basis[6:, 6:]
    intrinsics = np.linalg.lstsq(columns, numbers, rcond=None)[0] if columns.size else np.zeros(0)
    return np.concatenate([turn, shift, intrinsics]), sigma


def _loss(squared: np.ndarray) -> np.ndarray:
    return 0.5 * TURN**2 * np.log1p(squared / TURN**2)


def _slope(squared: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + squared / TURN**2)
