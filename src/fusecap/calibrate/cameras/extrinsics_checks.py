"""How sure the places of cameras are: held-out instants, and calibrations of resampled ones.

**Held out.** Instants are dealt into `FOLDS` folds. Each fold is predicted by a calibration of the
others: cameras stay as they are, and only the board's six numbers are fitted to its views at that
instant (`held_out_px`). Harder: the board is fitted to all cameras but one and predicted in that
one (`predicted_px`), which also shows how far a pose from one or two cameras carries.

**Repeatability.** The same from resampled instants (bootstrap), each brought onto the calibration
by the rigid motion that fits the boards best: the spread of centres and directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.bundle_adjustment import adjust, residuals_px, stack_views
from fusecap.calibrate.cameras.extrinsics import RigSolution, adjusted, solve
from fusecap.calibrate.cameras.first_poses import (
    Proposals,
    Views,
    check_connected,
    first_boards,
    proposals_of,
    shared_instants,
)
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.projection_derivatives import PARAMETERS
from fusecap.geometry.similarity import fitted_similarity
from fusecap.geometry.triangulation import triangulate
from fusecap.progress import Progress

FOLDS = 5
RESAMPLES = 10
"""Bootstraps that measure repeatability."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """How a calibration of other instants predicts one view."""

    camera: int
    instant: int
    fitted_px: Float[np.ndarray, " n"]
    """Distance of each corner with the board's pose fitted to all views of the instant."""
    predicted_px: Float[np.ndarray, " n"] | None
    """The same with it fitted to the other cameras' views."""


@dataclass(frozen=True, kw_only=True)
class ScaleCheck:
    """Edges of squares between triangulated corners, over the stated edge."""

    mean: float
    spread: float
    """Standard deviation of one edge."""
    edges: int


@dataclass(frozen=True, kw_only=True)
class Repeatability:
    """Standard deviation over resampled calibrations, per camera."""

    centre_mm: tuple[float, ...]
    """Root mean square over the resamples of the distance to their mean."""
    rotation_deg: tuple[float, ...]
    resamples: int


def held_out(
    cameras: Sequence[Camera],
    views: Views,
    board: Board,
    *,
    refine_intrinsics: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> tuple[list[HeldOut], ScaleCheck]:
    """Every instant predicted by a calibration without it; skips folds that do not connect."""
    proposals = proposals_of(cameras, views, board)
    instants = np.array(sorted(shared_instants(views)))
    folds = min(FOLDS, len(instants))
    found: list[HeldOut] = []
    ratios: list[np.ndarray] = []
    for fold in range(folds):
        progress("held-out instants", fold, folds)
        # Neighbouring instants show nearly the same board: folds are runs, not every fifth.
        out = set(np.array_split(instants, folds)[fold].tolist())
        kept = {key: view for key, view in views.items() if key[1] not in out}
        try:
            solution = solve(
                cameras, kept, board, refine_intrinsics=refine_intrinsics, proposals=proposals
            )
        except CalibrationError:
            continue
        there = {key: view for key, view in views.items() if key[1] in out}
        found += predicted(solution.cameras, there, board, proposals)
        ratios += [
            _edge_ratios(
                solution.cameras, {c: v for (c, i), v in there.items() if i == instant}, board
            )
            for instant in sorted(out)
        ]
    progress("held-out instants", folds, folds)
    every = np.concatenate([np.zeros(0), *ratios])
    scale = ScaleCheck(
        mean=float(every.mean()) if len(every) else np.nan,
        spread=float(every.std()) if len(every) else np.nan,
        edges=len(every),
    )
    return found, scale


def repeatability(
    solution: RigSolution,
    views: Views,
    board: Board,
    *,
    refine_intrinsics: bool = False,
    resamples: int = RESAMPLES,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> Repeatability:
    """The spread of calibrations from instants drawn with replacement."""
    rng = np.random.default_rng(seed)
    instants = np.array(sorted(solution.boards))
    skipped = set(solution.left_out)
    centres, turns = [], []
    for sample in range(resamples):
        progress("resampled calibrations", sample, resamples)
        drawn = rng.choice(instants, len(instants))
        resampled, boards = {}, {}
        for copy, instant in enumerate(drawn.tolist()):
            boards[copy] = solution.boards[instant]
            resampled |= {
                (c, copy): view
                for (c, i), view in views.items()
                if i == instant and (c, i) not in skipped
            }
        try:
            check_connected([camera.name for camera in solution.cameras], resampled)
            other = adjusted(
                solution.cameras, resampled, boards, board, refine_intrinsics=refine_intrinsics
            )
        except CalibrationError:
            continue
        onto = fitted_similarity(
            np.concatenate([_board_points(other.boards[k], board) for k in other.boards]),
            np.concatenate([_board_points(boards[k], board) for k in other.boards]),
        )
        centres.append([onto.points(c.position_in_world) for c in other.cameras])
        turns.append([c.rotation @ onto.rotation.T for c in other.cameras])
    progress("resampled calibrations", resamples, resamples)
    if len(centres) < 2:
        return Repeatability(
            centre_mm=(np.nan,) * len(solution.cameras),
            rotation_deg=(np.nan,) * len(solution.cameras),
            resamples=len(centres),
        )
    position = np.array(centres)
    spread = np.linalg.norm(position - position.mean(axis=0), axis=2)
    angle = np.empty_like(spread)
    for index in range(len(solution.cameras)):
        rotations = Rotation.from_matrix(np.array([row[index] for row in turns]))
        angle[:, index] = (rotations.mean().inv() * rotations).magnitude()
    return Repeatability(
        centre_mm=tuple((1e3 * np.sqrt((spread**2).mean(axis=0))).tolist()),
        rotation_deg=tuple(np.degrees(np.sqrt((angle**2).mean(axis=0))).tolist()),
        resamples=len(centres),
    )


def predicted(
    cameras: Sequence[Camera], views: Views, board: Board, proposals: Proposals | None = None
) -> list[HeldOut]:
    """How these cameras, as they are, explain views that they were not calibrated on."""
    if proposals is None:
        proposals = proposals_of(cameras, views, board)
    shared = shared_instants(views)
    views = {key: view for key, view in views.items() if key[1] in shared and key in proposals}
    fitted = _miss_px(cameras, views, _fitted_boards(cameras, views, proposals, board), board)
    found = []
    for c in range(len(cameras)):
        mine = {key: view for key, view in views.items() if key[0] == c}
        others = {key: view for key, view in views.items() if key[0] != c}
        alone = _miss_px(cameras, mine, _fitted_boards(cameras, others, proposals, board), board)
        found += [
            HeldOut(camera=c, instant=i, fitted_px=fitted[c, i], predicted_px=alone.get((c, i)))
            for _, i in mine
            if (c, i) in fitted
        ]
    return found


def _miss_px(
    cameras: Sequence[Camera], views: Views, boards: Mapping[int, np.ndarray], board: Board
) -> dict[tuple[int, int], np.ndarray]:
    """Distance of each corner of the views whose board has a pose."""
    result = {}
    for (c, i), view in views.items():
        if i in boards:
            corners = stack_views([(c, 0, view)], board.corners_in_board_m)
            result[c, i] = np.linalg.norm(residuals_px(cameras, boards[i][None], corners), axis=1)
    return result


def _fitted_boards(
    cameras: Sequence[Camera], views: Views, proposals: Proposals, board: Board
) -> dict[int, np.ndarray]:
    """world_from_board of each instant that explains its views best; least squares."""
    boards = first_boards(cameras, views, proposals, board)
    instants = sorted(boards)
    if not instants:
        return {}
    row = {instant: index for index, instant in enumerate(instants)}
    corners = stack_views(
        [(c, row[i], view) for (c, i), view in views.items() if i in row], board.corners_in_board_m
    )
    free = np.zeros((len(cameras), PARAMETERS), dtype=bool)
    start = np.stack([boards[i] for i in instants])
    fitted = adjust(cameras, start, corners, free=free, max_steps=30)
    return {i: fitted.boards[row[i]] for i in instants}


def _edge_ratios(
    cameras: Sequence[Camera], there: Mapping[int, BoardView], board: Board
) -> np.ndarray:
    """Edges between neighbouring triangulated corners, over the stated edge."""
    corners = len(board.corners_in_board_m)
    keypoints = np.full((len(cameras), corners, 3), [np.nan, np.nan, 0.0])
    for c, view in there.items():
        keypoints[c, view.corner_ids, :2] = view.pixels
        keypoints[c, view.corner_ids, 2] = 1.0
    points, _ = triangulate(Rig(cameras=tuple(cameras)), keypoints)
    grid = points.reshape(board.rows - 1, board.columns - 1, 3)
    edges = np.concatenate(
        [np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (0, 1)]
    )
    return edges[np.isfinite(edges)] / board.square_m


def _board_points(pose: np.ndarray, board: Board) -> np.ndarray:
    return board.corners_in_board_m @ pose[:3, :3].T + pose[:3, 3]
