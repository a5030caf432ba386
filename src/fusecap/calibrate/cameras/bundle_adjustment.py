"""Cameras and board poses that explain all corners at once.

Least squares over the fifteen numbers of each camera (`projection_derivatives`; which of them are
free is the caller's) and six of each board pose, world_from_board, tangent of the rotation on the
left. A corner's residual is its distance in pixels; Huber's loss beyond `robust_px`, so that a
blurred or misread corner pulls like a line, not like a parabola. Levenberg-Marquardt with the board
poses eliminated (Schur complement): each corner touches one camera and one board, so the normal
equations are block diagonal but for camera-board blocks. 4 cameras and 60 boards: 36 to 60 unknowns
remain, a few milliseconds a step.

The world is whatever the caller holds: one camera's pose, or all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import BoardView
from fusecap.geometry.camera import Camera
from fusecap.geometry.projection_derivatives import PARAMETERS, moved, projection_derivatives

MAX_STEPS = 100
CONVERGED = 1e-9
"""Relative decrease of the cost below which steps end."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2D vector whose coordinates are normal with sigma 1."""
ROBUST_SIGMAS = 3.0
"""Huber's loss turns at this many standard deviations of a corner's error, per axis."""
MIN_ROBUST_PX = 0.3
OUTLIER = 5.0
"""A view that misses by more than this many times the median view is left out."""
OUTLIER_PX = 2.0
"""But never one that misses by less."""

_STUCK = 1e9
"""Damping at which no step lowers the cost: the least cost is reached but for rounding."""
_MIN_DEPTH_M = 1e-3
"""A step that brings a corner nearer to its camera than this is refused."""


@dataclass(frozen=True, kw_only=True)
class Corners:
    """All corners of all views; one row each, m rows."""

    camera: Int[np.ndarray, " m"]
    board: Int[np.ndarray, " m"]
    """Which board pose; boards of one instant share one."""
    points_in_board_m: Float[np.ndarray, "m 3"]
    pixels: Float[np.ndarray, "m 2"]

    def __len__(self) -> int:
        return len(self.camera)

    def where(self, mask: Bool[np.ndarray, " m"]) -> Corners:
        """Some of them."""
        return Corners(
            camera=self.camera[mask],
            board=self.board[mask],
            points_in_board_m=self.points_in_board_m[mask],
            pixels=self.pixels[mask],
        )


def stack_views(
    views: Sequence[tuple[int, int, BoardView]], corners_in_board_m: Float[np.ndarray, "k 3"]
) -> Corners:
    """`Corners` of views given as camera, board, view."""
    counts = [len(view) for _, _, view in views]
    return Corners(
        camera=np.repeat(np.array([c for c, _, _ in views], dtype=np.int64), counts),
        board=np.repeat(np.array([b for _, b, _ in views], dtype=np.int64), counts),
        points_in_board_m=np.concatenate(
            [np.zeros((0, 3))] + [corners_in_board_m[view.corner_ids] for _, _, view in views]
        ),
        pixels=np.concatenate([np.zeros((0, 2))] + [view.pixels for _, _, view in views]),
    )


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """What a bundle adjustment found."""

    cameras: tuple[Camera, ...]
    boards: Float[np.ndarray, "b 4 4"]
    """world_from_board [m]."""
    covariance: Float[np.ndarray, "f f"]
    """Of the free camera numbers, in their order, at unit pixel noise."""
    steps: int
    converged: bool


def residuals_px(
    cameras: Sequence[Camera], boards: Float[np.ndarray, "b 4 4"], corners: Corners
) -> Float[np.ndarray, "m 2"]:
    """Projected minus seen; NaN behind a camera or beyond where its distortion is one-to-one."""
    world = _in_world(boards, corners)
    result = np.empty((len(corners), 2))
    for index, camera in enumerate(cameras):
        rows = corners.camera == index
        result[rows] = camera.project(world[rows]) - corners.pixels[rows]
    return result


def robust_scale_px(errors: Float[np.ndarray, " n"]) -> float:
    """Where Huber's loss turns, from corners' distances."""
    return max(MIN_ROBUST_PX, ROBUST_SIGMAS * float(np.nanmedian(errors)) / RAYLEIGH_MEDIAN)


def view_rms_px(
    cameras: Sequence[Camera],
    boards: Float[np.ndarray, "b 4 4"],
    corners: Corners,
    view: Int[np.ndarray, " m"],
) -> Float[np.ndarray, " v"]:
    """Root mean square distance per view; `view` numbers each corner's."""
    squared = np.nan_to_num((residuals_px(cameras, boards, corners) ** 2).sum(axis=1), nan=1e8)
    return np.sqrt(np.bincount(view, squared) / np.bincount(view))


def outlying(rms_px: Float[np.ndarray, " v"]) -> Bool[np.ndarray, " v"]:
    """Views that contradict the rest."""
    return rms_px > max(OUTLIER_PX, OUTLIER * float(np.median(rms_px)))


def adjust(
    cameras: Sequence[Camera],
    boards: Float[np.ndarray, "b 4 4"],
    corners: Corners,
    *,
    free: Bool[np.ndarray, "c 15"],
    robust_px: float = np.inf,
    max_steps: int = MAX_STEPS,
) -> Adjusted:
    """The least cost from this start on; every board has corners.

    Numbers that are not free stay exactly as they are.
    """
    cameras, boards = tuple(cameras), boards.copy()
    damping, converged, steps = 1e-4, False, 0
    current = _linearise(cameras, boards, corners, free, robust_px)
    while steps < max_steps and not converged:
        steps += 1
        step_cameras, step_boards = _solve(current, damping)
        if not _plausible(cameras, step_cameras):
            damping *= 10
            converged = damping > _STUCK
            continue
        tried_cameras = tuple(
            moved(camera, step) for camera, step in zip(cameras, step_cameras, strict=True)
        )
        tried_boards = _moved_boards(boards, step_boards)
        tried = _linearise(tried_cameras, tried_boards, corners, free, robust_px)
        if not tried.cost < current.cost:
            damping *= 10
            converged = damping > _STUCK
            continue
        converged = current.cost - tried.cost <= CONVERGED * current.cost
        cameras, boards, current = tried_cameras, tried_boards, tried
        damping = max(damping / 10, 1e-12)
    return Adjusted(
        cameras=cameras,
        boards=boards,
        covariance=np.linalg.pinv(_reduced(current, 0.0)[0], hermitian=True),
        steps=steps,
        converged=converged and bool(np.isfinite(current.cost)),
    )


@dataclass(frozen=True, kw_only=True)
class _Normal:
    """Normal equations at one point; f free camera numbers."""

    cost: float
    camera_block: Float[np.ndarray, "f f"]
    camera_gradient: Float[np.ndarray, " f"]
    board_blocks: Float[np.ndarray, "b 6 6"]
    board_gradients: Float[np.ndarray, "b 6"]
    mixed: Float[np.ndarray, "b f 6"]
    free: Bool[np.ndarray, "c 15"]


def _linearise(
    cameras: Sequence[Camera],
    boards: np.ndarray,
    corners: Corners,
    free: np.ndarray,
    robust_px: float,
) -> _Normal:
    count, width = len(boards), int(free.sum())
    world = _in_world(boards, corners)
    first = np.concatenate([[0], np.cumsum(free.sum(axis=1))])
    camera_block, camera_gradient = np.zeros((width, width)), np.zeros(width)
    board_blocks, board_gradients = np.zeros((count, 6, 6)), np.zeros((count, 6))
    mixed = np.zeros((count, width, 6))
    cost = 0.0
    for index, camera in enumerate(cameras):
        rows = np.flatnonzero(corners.camera == index)
        points, board = world[rows], corners.board[rows]
        depth = points @ camera.rotation[2] + camera.translation[2]
        if (depth < _MIN_DEPTH_M).any():
            cost = np.inf
            continue
        pixels, by_camera, by_point = projection_derivatives(camera, points)
        residual = pixels - corners.pixels[rows]
        size = np.linalg.norm(residual, axis=1)
        inner = np.minimum(size, robust_px)
        cost += float((inner * (2 * size - inner)).sum())
        root = np.sqrt(np.minimum(1.0, robust_px / np.maximum(size, 1e-12)))[:, None]
        residual = residual * root
        by_camera = (by_camera * root[..., None])[:, :, free[index]]
        by_board = np.empty((len(rows), 2, 6))
        by_board[:, :, 3:] = by_point * root[..., None]
        arm = points - boards[board, :3, 3]
        # Turning by w moves a point by w x arm, so the pixel by by_point . (w x arm).
        by_board[:, :, :3] = np.cross(arm[:, None], by_board[:, :, 3:])
        part = slice(first[index], first[index + 1])
        camera_block[part, part] = np.einsum("mia,mib->ab", by_camera, by_camera)
        camera_gradient[part] = np.einsum("mia,mi->a", by_camera, residual)
        np.add.at(board_blocks, board, np.einsum("mia,mib->mab", by_board, by_board))
        np.add.at(board_gradients, board, np.einsum("mia,mi->ma", by_board, residual))
        seen = np.zeros((count, part.stop - part.start, 6))
        np.add.at(seen, board, np.einsum("mia,mib->mab", by_camera, by_board))
        mixed[:, part] = seen
    return _Normal(
        cost=cost,
        camera_block=camera_block,
        camera_gradient=camera_gradient,
        board_blocks=board_blocks,
        board_gradients=board_gradients,
        mixed=mixed,
        free=free,
    )


def _reduced(normal: _Normal, damping: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The cameras' normal equations after the boards are eliminated, and the boards' inverses."""
    blocks = normal.board_blocks.copy()
    diagonal = np.einsum("bii->bi", blocks)
    diagonal += damping * diagonal + 1e-12 * diagonal.max(initial=1.0)
    inverse = np.linalg.inv(blocks)
    gain = normal.mixed @ inverse
    left = normal.camera_block - np.einsum("bfi,bgi->fg", gain, normal.mixed)
    left[np.diag_indices_from(left)] += damping * normal.camera_block.diagonal()
    right = normal.camera_gradient - np.einsum("bfi,bi->f", gain, normal.board_gradients)
    return left, right, inverse


def _solve(normal: _Normal, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the cameras (c, 15) and the boards (b, 6)."""
    left, right, inverse = _reduced(normal, damping)
    steps = np.zeros((len(normal.free), PARAMETERS))
    if len(right):
        # Numbers differ by orders of magnitude (metres, pixels, k3): solve in equal units.
        scale = 1.0 / np.sqrt(np.maximum(normal.camera_block.diagonal(), 1e-300))
        free_step = (
            -scale * np.linalg.lstsq(left * scale * scale[:, None], right * scale, rcond=1e-15)[0]
        )
        steps[normal.free] = free_step
        pull = normal.board_gradients + np.einsum("bfi,f->bi", normal.mixed, free_step)
    else:
        pull = normal.board_gradients
    return steps, -np.einsum("bij,bj->bi", inverse, pull)


def _plausible(cameras: Sequence[Camera], steps: np.ndarray) -> bool:
    """Whether all focal lengths stay positive."""
    return all(
        camera.matrix[0, 0] + step[6] > 1.0 and camera.matrix[1, 1] + step[7] > 1.0
        for camera, step in zip(cameras, steps, strict=True)
    ) and bool(np.isfinite(steps).all())


def _moved_boards(boards: np.ndarray, steps: np.ndarray) -> np.ndarray:
    result = boards.copy()
    result[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ boards[:, :3, :3]
    result[:, :3, 3] += steps[:, 3:]
    return result


def _in_world(boards: np.ndarray, corners: Corners) -> np.ndarray:
    poses = boards[corners.board]
    turned = np.einsum("mij,mj->mi", poses[:, :3, :3], corners.points_in_board_m)
    return turned + poses[:, :3, 3]
