"""Where cameras stand to each other, from a board that they see together.

1. Cameras and boards are placed roughly (`first_poses`).
2. Bundle adjustment over cameras and boards, Huber's loss at three standard deviations of the
   corners' scatter; views that then miss by more than five times the median view are left out by
   name, and the adjustment is repeated.

The world is the first camera's frame; `calibrate/cameras/world_frame.py` places it in the room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.board_views import CameraShots
from fusecap.calibrate.cameras.bundle_adjustment import (
    adjust,
    outlying,
    residuals_px,
    robust_scale_px,
    stack_views,
    view_rms_px,
)
from fusecap.calibrate.cameras.first_poses import (
    Proposals,
    Views,
    check_connected,
    first_boards,
    placed_cameras,
    proposals_of,
    shared_instants,
)
from fusecap.geometry.camera import Camera
from fusecap.geometry.projection_derivatives import PARAMETERS, POSE

REFINED = slice(6, 12)
"""Numbers of a camera that refining its intrinsics frees: fx fy cx cy k1 k2."""


@dataclass(frozen=True, kw_only=True)
class RigSolution:
    """Cameras and boards in the first camera's frame."""

    cameras: tuple[Camera, ...]
    boards: dict[int, Float[np.ndarray, "4 4"]]
    """world_from_board [m] by instant."""
    left_out: tuple[tuple[int, int], ...]
    """Views (camera, instant) that contradict the rest."""
    converged: bool


def views_of(cameras: Sequence[CameraShots]) -> dict[tuple[int, int], BoardView]:
    """All shots by camera and instant."""
    return {
        (index, shot.instant): shot.view
        for index, camera in enumerate(cameras)
        for shot in camera.shots
    }


def solve(
    cameras: Sequence[Camera],
    views: Views,
    board: Board,
    *,
    refine_intrinsics: bool = False,
    proposals: Proposals | None = None,
) -> RigSolution:
    """All cameras in the frame of the first; their intrinsics are a start or, by default, fixed.

    `proposals`, where they are known, may be of more than `views`.
    """
    if proposals is None:
        proposals = proposals_of(cameras, views, board)
    check_connected([camera.name for camera in cameras], views)
    proposals = {key: poses for key, poses in proposals.items() if key in views}
    placed = placed_cameras(cameras, proposals)
    shown = shared_instants(views)
    used = {key: views[key] for key in proposals if key[1] in shown}
    boards = first_boards(placed, used, proposals, board)
    used = {key: view for key, view in used.items() if key[1] in boards}
    return adjusted(placed, used, boards, board, refine_intrinsics=refine_intrinsics)


def adjusted(
    cameras: Sequence[Camera],
    views: Views,
    boards: Mapping[int, np.ndarray],
    board: Board,
    *,
    refine_intrinsics: bool,
) -> RigSolution:
    free = np.zeros((len(cameras), PARAMETERS), dtype=bool)
    free[1:, POSE] = True
    if refine_intrinsics:
        free[:, REFINED] = True
    keys, left_out = sorted(views), []
    found, converged = tuple(cameras), False
    poses = dict(boards)
    for last in (False, True):
        instants = sorted({i for _, i in keys})
        row = {instant: index for index, instant in enumerate(instants)}
        corners = stack_views([(c, row[i], views[c, i]) for c, i in keys], board.corners_in_board_m)
        start = np.stack([poses[i] for i in instants])
        rough = adjust(found, start, corners, free=free, robust_px=2.0, max_steps=30)
        errors = np.linalg.norm(residuals_px(rough.cameras, rough.boards, corners), axis=1)
        result = adjust(
            rough.cameras, rough.boards, corners, free=free, robust_px=robust_scale_px(errors)
        )
        found, converged = result.cameras, result.converged
        poses = {i: result.boards[row[i]] for i in instants}
        if last:
            break
        view = np.repeat(np.arange(len(keys)), [len(views[key]) for key in keys])
        bad = outlying(view_rms_px(found, result.boards, corners, view))
        if not bad.any():
            break
        left_out = [key for key, is_bad in zip(keys, bad, strict=True) if is_bad]
        keys = [key for key, is_bad in zip(keys, bad, strict=True) if not is_bad]
        check_connected([c.name for c in cameras], {key: views[key] for key in keys})
    return RigSolution(cameras=found, boards=poses, left_out=tuple(left_out), converged=converged)
