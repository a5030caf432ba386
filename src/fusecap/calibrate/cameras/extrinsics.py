"""Where cameras stand to each other, from a board that they see together.

1. Every view alone gives two poses of a plane (IPPE: they mirror each other where perspective is
   weak). For two cameras each shared instant proposes relative poses; the one that most instants
   agree with wins.
2. The pairs that share most instants connect all cameras (maximum spanning tree).
3. Each instant's board takes the pose, of all its views' proposals, that explains its views best.
4. Bundle adjustment over cameras and boards, Huber's loss at three standard deviations of the
   corners' scatter; views that then miss by more than five times the median view are left out by
   name, and the adjustment is repeated.

The world is the first camera's frame; `calibrate/cameras/world_frame.py` places it in the room.

**Held out.** Instants are dealt into `FOLDS` folds. Each fold is predicted by a calibration of the
others: cameras stay as they are, and only the board's six numbers are fitted to its views at that
instant (`held_out_px`). Harder: the board is fitted to all cameras but one and predicted in that
one (`predicted_px`), which also shows how far a pose from one or two cameras carries.

**Repeatability.** The same from resampled instants (bootstrap), each brought onto the calibration
by the rigid motion that fits the boards best: the spread of centres and directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.board_views import CameraShots
from fusecap.calibrate.cameras.bundle_adjustment import (
    adjust,
    residuals_px,
    stack_views,
)
from fusecap.calibrate.cameras.planar_pose import planar_poses
from fusecap.calibrate.cameras.robust import outlying, robust_scale_px, view_rms_px
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.projection_derivatives import PARAMETERS, POSE
from fusecap.geometry.similarity import fitted_similarity
from fusecap.geometry.triangulation import triangulate
from fusecap.progress import Progress

MIN_SHARED = 3
"""Instants at which two cameras see the board together, for the pair to count as connected."""
REFINED = slice(6, 12)
"""Numbers of a camera that refining its intrinsics frees: fx fy cx cy k1 k2."""
FOLDS = 5
RESAMPLES = 10
"""Bootstraps that measure repeatability."""

Views = Mapping[tuple[int, int], BoardView]
"""By camera and instant."""
Proposals = Mapping[tuple[int, int], list[np.ndarray]]
"""cam_from_board, one or two per view."""

_AGREE_RAD, _AGREE_SHARE = 0.1, 0.1
"""Two proposals of a relative pose agree within this angle and this share of the distance."""
_MAX_PROPOSALS = 120


@dataclass(frozen=True, kw_only=True)
class Solution:
    """Cameras and boards in the first camera's frame."""

    cameras: tuple[Camera, ...]
    boards: dict[int, Float[np.ndarray, "4 4"]]
    """world_from_board [m] by instant."""
    left_out: tuple[tuple[int, int], ...]
    """Views (camera, instant) that contradict the rest."""
    converged: bool


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


def views_of(cameras: Sequence[CameraShots]) -> dict[tuple[int, int], BoardView]:
    """All shots by camera and instant."""
    return {
        (index, shot.instant): shot.view
        for index, camera in enumerate(cameras)
        for shot in camera.shots
    }


def check_connected(names: Sequence[str], views: Views) -> None:
    """Raises `CalibrationError` naming the cameras that share no board with the others."""
    shared = _shared(len(names), views)
    linked = _reachable(shared >= MIN_SHARED)
    if len(linked) == len(names):
        return
    apart = [name for index, name in enumerate(names) if index not in linked]
    together = [name for index, name in enumerate(names) if index in linked]
    counts = "; ".join(
        f"'{names[a]}' and '{names[b]}' share {shared[a, b]}"
        for a in range(len(names))
        for b in range(a + 1, len(names))
        if (a in linked) != (b in linked)
    )
    raise CalibrationError(
        f"{_list(apart)} and {_list(together)} see the board together at fewer than {MIN_SHARED} "
        f"instants ({counts}): hold the board where both see it, or, if they did, check that "
        "frames are in step (timestamps)"
    )


def solve(
    cameras: Sequence[Camera],
    views: Views,
    board: Board,
    *,
    refine_intrinsics: bool = False,
) -> Solution:
    """All cameras in the frame of the first; their intrinsics are a start or, by default, fixed."""
    proposals = _proposals(cameras, views, board)
    return _solved(cameras, views, board, proposals, refine_intrinsics=refine_intrinsics)


def _solved(
    cameras: Sequence[Camera],
    views: Views,
    board: Board,
    proposals: Proposals,
    *,
    refine_intrinsics: bool,
) -> Solution:
    check_connected([camera.name for camera in cameras], views)
    proposals = {key: poses for key, poses in proposals.items() if key in views}
    placed = _placed(cameras, proposals)
    shown = _shared_instants(views)
    used = {key: views[key] for key in proposals if key[1] in shown}
    boards = _first_boards(placed, used, proposals, board)
    used = {key: view for key, view in used.items() if key[1] in boards}
    return _adjusted(placed, used, boards, board, refine_intrinsics=refine_intrinsics)


def held_out(
    cameras: Sequence[Camera],
    views: Views,
    board: Board,
    *,
    refine_intrinsics: bool = False,
    progress: Progress = lambda what, done, total: None,
) -> tuple[list[HeldOut], ScaleCheck]:
    """Every instant predicted by a calibration without it; skips folds that do not connect."""
    proposals = _proposals(cameras, views, board)
    instants = np.array(sorted(_shared_instants(views)))
    folds = min(FOLDS, len(instants))
    found: list[HeldOut] = []
    ratios: list[np.ndarray] = []
    for fold in range(folds):
        progress("held-out instants", fold, folds)
        # Neighbouring instants show nearly the same board: folds are runs, not every fifth.
        out = set(np.array_split(instants, folds)[fold].tolist())
        kept = {key: view for key, view in views.items() if key[1] not in out}
        try:
            solution = _solved(cameras, kept, board, proposals, refine_intrinsics=refine_intrinsics)
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
    solution: Solution,
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
            other = _adjusted(
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


def _adjusted(
    cameras: Sequence[Camera],
    views: Views,
    boards: Mapping[int, np.ndarray],
    board: Board,
    *,
    refine_intrinsics: bool,
) -> Solution:
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
    return Solution(cameras=found, boards=poses, left_out=tuple(left_out), converged=converged)


def _proposals(cameras: Sequence[Camera], views: Views, board: Board) -> Proposals:
    """Of the views that have a pose."""
    found = {key: _poses(cameras[key[0]], view, board) for key, view in views.items()}
    return {key: poses for key, poses in found.items() if poses}


def _poses(camera: Camera, view: BoardView, board: Board) -> list[np.ndarray]:
    """cam_from_board, one or two; the second only where it explains the view nearly as well."""
    points = board.corners_in_board_m[view.corner_ids]
    found = planar_poses(camera, points, view.pixels)
    near = [error < 3 * found[0][1] + 1.0 / camera.matrix[0, 0] for _, error in found]
    return [
        pose
        for index, (pose, _) in enumerate(found)
        if np.isfinite(pose).all()
        and (points @ pose[2, :3] + pose[2, 3] > 0).all()
        and (index == 0 or near[index])
    ]


def _placed(
    cameras: Sequence[Camera],
    proposals: Proposals,
) -> tuple[Camera, ...]:
    """Cameras along the spanning tree from the first."""
    shared: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    for a in range(len(cameras)):
        for b in range(a + 1, len(cameras)):
            instants = sorted(i for c, i in proposals if c == a and (b, i) in proposals)
            step = -(-len(instants) // _MAX_PROPOSALS) if instants else 1
            found = [
                at_b @ np.linalg.inv(at_a)
                for i in instants[::step]
                for at_a in proposals[a, i]
                for at_b in proposals[b, i]
            ]
            if len(instants) >= MIN_SHARED:
                share, pose = _most_agreed(np.array(found))
                shared[a, b] = (share * len(instants[::step]) * step, pose)
                shared[b, a] = (shared[a, b][0], np.linalg.inv(pose))
    world_to: dict[int, np.ndarray] = {0: np.eye(4)}
    while len(world_to) < len(cameras):
        edges = [
            (weight, a, b)
            for (a, b), (weight, _) in shared.items()
            if a in world_to and b not in world_to
        ]
        if not edges:
            names = [c.name for i, c in enumerate(cameras) if i not in world_to]
            raise CalibrationError(
                f"{_list(names)}: no board view that these cameras share with the others gives a "
                "pose; hold the board closer to both"
            )
        _, a, b = max(edges)
        world_to[b] = shared[a, b][1] @ world_to[a]
    return tuple(
        replace(camera, rotation=world_to[i][:3, :3], translation=world_to[i][:3, 3])
        for i, camera in enumerate(cameras)
    )


def _most_agreed(poses: Float[np.ndarray, "n 4 4"]) -> tuple[float, Float[np.ndarray, "4 4"]]:
    """The pose that most others agree with, averaged with those, and their share."""
    rotations = poses[:, :3, :3]
    cosine = (np.einsum("aij,bij->ab", rotations, rotations) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    shift = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    size = max(float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1))), 1e-3)
    apart = angle / _AGREE_RAD + shift / (_AGREE_SHARE * size)
    near = np.exp(-apart)
    best = int(np.argmax(near.sum(axis=1)))
    chosen = apart[best] < 2.0
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_matrix(rotations[chosen]).mean().as_matrix()
    pose[:3, 3] = np.median(poses[chosen, :3, 3], axis=0)
    return float(chosen.mean()), pose


def _first_boards(
    cameras: Sequence[Camera],
    views: Views,
    proposals: Proposals,
    board: Board,
) -> dict[int, np.ndarray]:
    """Per instant the proposal of least robust error in all its views."""
    boards: dict[int, np.ndarray] = {}
    by_instant: dict[int, list[int]] = {}
    for c, i in views:
        by_instant.setdefault(i, []).append(c)
    for instant, seen in by_instant.items():
        corners = stack_views([(c, 0, views[c, instant]) for c in seen], board.corners_in_board_m)
        best = np.inf
        for c in seen:
            for pose in proposals[c, instant]:
                world = np.linalg.inv(_cam_from_world(cameras[c])) @ pose
                miss = np.linalg.norm(residuals_px(cameras, world[None], corners), axis=1)
                cost = float(np.minimum(np.nan_to_num(miss, nan=1e3), 200.0).sum())
                behind = np.isnan(miss).any()
                if not behind and cost < best:
                    best, boards[instant] = cost, world
    return boards


def predicted(
    cameras: Sequence[Camera], views: Views, board: Board, proposals: Proposals | None = None
) -> list[HeldOut]:
    """How these cameras, as they are, explain views that they were not calibrated on."""
    if proposals is None:
        proposals = _proposals(cameras, views, board)
    shared = _shared_instants(views)
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
    boards = _first_boards(cameras, views, proposals, board)
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


def _shared(count: int, views: Views) -> np.ndarray:
    """(c, c): instants at which two cameras see the board."""
    seen = np.zeros((count, count), dtype=int)
    by_instant: dict[int, list[int]] = {}
    for c, i in views:
        by_instant.setdefault(i, []).append(c)
    for cameras in by_instant.values():
        seen[np.ix_(cameras, cameras)] += 1
    np.fill_diagonal(seen, 0)
    return seen


def _shared_instants(views: Views) -> set[int]:
    """At which at least two cameras see the board."""
    instants, counts = np.unique([i for _, i in views], return_counts=True)
    return set(instants[counts >= 2].tolist())


def _reachable(linked: np.ndarray) -> set[int]:
    """Everything connected with the first."""
    reached, front = {0}, [0]
    while front:
        for other in np.flatnonzero(linked[front.pop()]).tolist():
            if other not in reached:
                reached.add(other)
                front.append(other)
    return reached


def _board_points(pose: np.ndarray, board: Board) -> np.ndarray:
    return board.corners_in_board_m @ pose[:3, :3].T + pose[:3, 3]


def _cam_from_world(camera: Camera) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    return pose


def _list(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
