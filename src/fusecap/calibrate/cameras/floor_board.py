"""The pose of one board in a calibrated rig, from all views of it together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.first_poses import planar_poses
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import REFERENCE_WIDTH_PX, Camera, Rig
from fusecap.geometry.projection_derivatives import projection_derivatives

_STARTS = 2
"""Poses from single views, the best first, from which all views are fitted."""


@dataclass(frozen=True, kw_only=True)
class BoardFit:
    """Where a board lies in the world of the cameras that see it."""

    rotation: Float[np.ndarray, "3 3"]
    """World from board, about the board's first corner."""
    translation_m: Float[np.ndarray, "3"]
    size: float
    """Of the board in the calibration's metres, over its true size."""
    rms_px: float
    """Of a 1920-pixel-wide image."""
    tilt_deg: float
    """Standard deviation, if the errors of corners are independent."""
    camera_px: dict[str, float]
    """Root mean square by camera, in its own pixels."""


def fit_board(rig: Rig, board: Board, views: Mapping[str, BoardView], *, scale: bool) -> BoardFit:
    """The pose of least squared reprojection, over all views together.

    Raises `CalibrationError` where no view gives a pose to start from.
    """
    cameras = [rig[name] for name in views]
    starts = []
    for camera, view in zip(cameras, views.values(), strict=True):
        for rotation, translation in _poses_in_world(camera, board, view):
            seen = _ordered(cameras, board, list(views.values()), rotation, translation)
            fit = _BoardDescent(cameras, board, seen, rotation, translation, scale)
            starts.append((float(np.sum(fit.residuals(fit.start) ** 2)), len(starts), fit))
    if not starts:
        raise CalibrationError(
            "the board's corners give no pose; check board.toml and the images' resolution"
        )
    ends = [fit.descend() for _, _, fit in sorted(starts)[:_STARTS]]
    best = min(ends, key=lambda end: end[-1].cost)
    rotation, translation, size, result = best
    squared = result.fun.reshape(-1, 2)
    counts = [len(view) for view in views.values()]
    parts = np.split(squared, np.cumsum(counts)[:-1])
    freedom = max(result.fun.size - result.x.size, 1)
    covariance = np.linalg.pinv(result.jac.T @ result.jac) * (2 * result.cost / freedom)
    return BoardFit(
        rotation=rotation,
        translation_m=translation,
        size=size,
        rms_px=float(np.sqrt(np.mean(np.sum(squared**2, axis=1)))),
        tilt_deg=float(np.degrees(np.sqrt(max(covariance[0, 0], covariance[1, 1])))),
        camera_px={
            camera.name: float(np.sqrt(np.mean(np.sum(part**2, axis=1)))) / camera.pixel_scale
            for camera, part in zip(cameras, parts, strict=True)
        },
    )


def _poses_in_world(
    camera: Camera, board: Board, view: BoardView
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation and translation, old world from board, that the view may mean."""
    poses = []
    for pose, _ in planar_poses(camera, board.corners_in_board_m[view.corner_ids], view.pixels):
        if np.isfinite(pose).all():
            place = camera.rotation.T @ (pose[:3, 3] - camera.translation)
            poses.append((camera.rotation.T @ pose[:3, :3], place))
    return poses


def _ordered(
    cameras: Sequence[Camera],
    board: Board,
    views: Sequence[BoardView],
    rotation: np.ndarray,
    translation: np.ndarray,
) -> list[BoardView]:
    """The views with their corners named from the end that this pose suggests."""
    if not board.ambiguous:
        return list(views)
    last = len(board.corners_in_board_m) - 1
    result = []
    for camera, view in zip(cameras, views, strict=True):
        turned = replace(view, corner_ids=(last - view.corner_ids)[::-1], pixels=view.pixels[::-1])
        away = [
            np.nanmean(
                np.abs(
                    camera.project(
                        board.corners_in_board_m[each.corner_ids] @ rotation.T + translation
                    )
                    - each.pixels
                )
            )
            for each in (view, turned)
        ]
        result.append(view if not away[1] < away[0] else turned)
    return result


class _BoardDescent:
    """Least squares about a pose.

    Its numbers are turns about the board's own axes, so that the first two are tilts, a shift in
    the world and, with `scale`, the logarithm of the board's size.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        board: Board,
        views: Sequence[BoardView],
        rotation: np.ndarray,
        translation: np.ndarray,
        scale: bool,
    ) -> None:
        self._cameras = cameras
        self._views = views
        self._corners = board.corners_in_board_m
        self._rotation, self._translation = rotation, translation
        self.start = np.zeros(7 if scale else 6)

    def descend(self) -> tuple[np.ndarray, np.ndarray, float, OptimizeResult]:
        """Rotation, translation and size; the Jacobian of the result is about its own pose."""
        near = self._least_squares(self.start)
        self._rotation, self._translation, _ = self._pose(near.x)
        again = np.concatenate([np.zeros(6), near.x[6:]])
        result = self._least_squares(again)
        return *self._pose(result.x), result

    def _least_squares(self, x: np.ndarray) -> OptimizeResult:
        jacobian: Any = self._jacobian
        return least_squares(self.residuals, x, jacobian, x_scale="jac", xtol=1e-12)

    def _pose(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        turned = self._rotation @ Rotation.from_rotvec(x[:3]).as_matrix()
        return turned, self._translation + x[3:6], float(np.exp(x[6])) if len(x) > 6 else 1.0

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Pixels of a 1920-pixel-wide image."""
        turned, place, size = self._pose(x)
        parts = []
        for camera, view in zip(self._cameras, self._views, strict=True):
            corners = size * self._corners[view.corner_ids] @ turned.T + place
            away = (camera.project(corners) - view.pixels) * camera.pixel_scale
            parts.append(np.nan_to_num(away, nan=REFERENCE_WIDTH_PX))
        return np.concatenate(parts).ravel()

    def _jacobian(self, x: np.ndarray) -> np.ndarray:
        turned, place, size = self._pose(x)
        parts = []
        for camera, view in zip(self._cameras, self._views, strict=True):
            corners = size * self._corners[view.corner_ids]
            _, _, by_point = projection_derivatives(camera, corners @ turned.T + place)
            by_turn = np.empty_like(by_point)
            for axis in range(3):
                moved = np.cross(np.eye(3)[axis], corners) @ turned.T
                by_turn[:, :, axis] = np.einsum("nij,nj->ni", by_point, moved)
            by_size = np.einsum("nij,nj->ni", by_point, corners @ turned.T)[:, :, None]
            both = np.concatenate([by_turn, by_point, by_size], axis=2)[:, :, : len(x)]
            parts.append(both.reshape(-1, len(x)) * camera.pixel_scale)
        return np.concatenate(parts)
