"""Where cameras and boards stand roughly, from views of a board one by one.

Every view alone gives two poses of a plane (IPPE: they mirror each other where perspective is
weak). For two cameras each shared instant proposes relative poses; the one that most instants agree
with wins, and the pairs that share most instants connect all cameras (maximum spanning tree). Each
instant's board takes the pose, of all its views' proposals, that explains its views best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.bundle_adjustment import residuals_px, stack_views
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera

MIN_SHARED = 3
"""Instants at which two cameras see the board together, for the pair to count as connected."""
Views = Mapping[tuple[int, int], BoardView]
"""By camera and instant."""
Proposals = Mapping[tuple[int, int], list[np.ndarray]]
"""cam_from_board, one or two per view."""

_AGREE_RAD, _AGREE_SHARE = 0.1, 0.1
"""Two proposals of a relative pose agree within this angle and this share of the distance."""
_MAX_PROPOSALS = 120


def planar_poses(
    camera: Camera, points_in_board_m: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"]
) -> list[tuple[Float[np.ndarray, "4 4"], float]]:
    """Both poses cam_from_board that a plane in one view may have, the better one first.

    With each its reprojection error in units of the focal length. They mirror each other where
    perspective is weak (Collins and Bartoli, IJCV 109, 2014). Empty where pixels lie beyond what
    the lens model can undistort.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        xy = camera.undistort(pixels)
    if not np.isfinite(xy).all():
        return []
    # IPPE wants the plane's points about its origin; the shift is undone below.
    middle = points_in_board_m.mean(axis=0)
    _, turns, shifts, errors = cv2.solvePnPGeneric(
        points_in_board_m - middle, xy[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )[:4]
    poses = []
    for turn, shift, error in zip(turns, shifts, np.ravel(np.asarray(errors)), strict=True):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.asarray(turn).ravel()).as_matrix()
        pose[:3, 3] = np.asarray(shift).ravel() - pose[:3, :3] @ middle
        poses.append((pose, float(error)))
    return poses


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
    found = [sum(camera == index for camera, _ in views) for index in range(len(names))]
    told = ", ".join(f"{count} of '{name}'" for name, count in zip(names, found, strict=True))
    remedy = "hold the board where both see it, or, if they did, check that frames are in step"
    if min(found) < MIN_SHARED:
        remedy = "where it was hardly found, come closer or print larger squares; " + remedy
    raise CalibrationError(
        f"{_list(apart)} and {_list(together)} see the board together at fewer than {MIN_SHARED} "
        f"instants ({counts}); it was found in {told} images: {remedy} (timestamps)"
    )


def proposals_of(cameras: Sequence[Camera], views: Views, board: Board) -> Proposals:
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


def placed_cameras(
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


def first_boards(
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


def shared_instants(views: Views) -> set[int]:
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


def _cam_from_world(camera: Camera) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
    return pose


def _list(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)
