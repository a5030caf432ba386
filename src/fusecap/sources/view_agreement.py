"""Whether cameras agree with each other, judged by the people they see.

A keypoint in one view confines the same keypoint in another to a line. How far it lies from that
line, the median over people and keypoints, is what two calibrated, synchronised cameras disagree
by: a few pixels of detector noise when all is well. Nobody needs to be identified: in every pair
of views the people are assigned to each other so that the total distance is least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import linear_sum_assignment

from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.epipolar import essential_matrix
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.people_store import changed
from fusecap.sources.synchronizer import people_at

MIN_CONFIDENCE = 0.3
MIN_SHARED_KEYPOINTS = 6
NEIGHBOURS = 4
"""On either side of a camera in a ring of many: pairs then grow with cameras, not their square."""


def without_distortion(
    rig: Rig, tracks: Sequence[KeypointTrack]
) -> tuple[Rig, list[KeypointTrack]]:
    """The same views through ideal lenses; all functions here are fast on these."""
    cameras = [replace(camera, distortion=np.zeros(5)) for camera in rig.cameras]
    ideal = []
    for camera, track in zip(rig.cameras, tracks, strict=True):
        flat = changed(track.people, partial(_through_ideal_lens, camera))
        ideal.append(replace(track, people=flat))
    return Rig(cameras=tuple(cameras)), ideal


def _through_ideal_lens(camera: Camera, people: np.ndarray) -> np.ndarray:
    flat = camera.undistort(people[:, :, :2].reshape(-1, 2))
    pixels = flat * [camera.matrix[0, 0], camera.matrix[1, 1]] + camera.matrix[:2, 2]
    return np.concatenate([pixels.reshape(*people.shape[:2], 2), people[:, :, 2:]], 2)


def pair_distances_px(
    first: Camera, second: Camera, people_a: np.ndarray, people_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices into both views' people, and each pair's median distance to the epipolar lines [px].

    Pairs that share fewer than `MIN_SHARED_KEYPOINTS` keypoints are left out.
    """
    none = np.empty(0, dtype=np.int64)
    if len(people_a) == 0 or len(people_b) == 0:
        return none, none, np.empty(0)
    a, b = _rays(first, people_a), _rays(second, people_b)
    essential = essential_matrix(
        (first.rotation, second.rotation), (first.position_in_world, second.position_in_world)
    )
    lines_in_b, lines_in_a = a @ essential.T, b @ essential
    with np.errstate(divide="ignore", invalid="ignore"):
        product = np.abs(np.einsum("nki,mki->nmk", lines_in_b, b))
        in_b = product / np.linalg.norm(lines_in_b[:, :, :2], axis=2)[:, None] * second.matrix[0, 0]
        in_a = product / np.linalg.norm(lines_in_a[:, :, :2], axis=2)[None] * first.matrix[0, 0]
    distance = (in_a + in_b) / 2
    shared = np.isfinite(distance).sum(2)
    enough = shared >= MIN_SHARED_KEYPOINTS
    middle = np.maximum(shared - 1, 0) // 2
    median = np.take_along_axis(np.sort(distance, axis=2), middle[:, :, None], axis=2)[:, :, 0]
    cost = np.where(enough, median, 1e6)
    rows, columns = linear_sum_assignment(cost)
    kept = enough[rows, columns]
    rows, columns = rows[kept], columns[kept]
    return rows, columns, cost[rows, columns]


def _rays(camera: Camera, people: np.ndarray) -> np.ndarray:
    """(n, K, 3) points at depth 1 in the camera; NaN where not seen well."""
    flat = camera.undistort(people[:, :, :2].reshape(-1, 2)).reshape(*people.shape[:2], 2)
    flat = np.where(people[:, :, 2:] >= MIN_CONFIDENCE, flat, np.nan)
    return np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=2)


def disagreement_px(rig: Rig, tracks: Sequence[KeypointTrack], times_s: np.ndarray) -> np.ndarray:
    """(C, C) median disagreement of pairs of cameras; NaN where nobody is seen by both.

    Of more than nine cameras each is compared with eight.
    """
    views = [[people_at(track, t) for t in times_s] for track in tracks]
    result = np.full((len(tracks), len(tracks)), np.nan)
    for i, j in _pairs(len(tracks)):
        result[i, j] = result[j, i] = _median_px(rig.cameras[i], rig.cameras[j], views[i], views[j])
    return result


def _pairs(cameras: int) -> list[tuple[int, int]]:
    """Those that are compared, in order: all, or every camera with the four after it in a ring."""
    near = {(i, (i + step) % cameras) for i in range(cameras) for step in range(1, NEIGHBOURS + 1)}
    return sorted({(min(i, j), max(i, j)) for i, j in near if i != j})


def _partners(camera: int, cameras: int) -> list[int]:
    """Those that one of so many cameras is compared with."""
    return [i + j - camera for i, j in _pairs(cameras) if camera in (i, j)]


def _median_px(
    first: Camera, second: Camera, people_a: list[np.ndarray], people_b: list[np.ndarray]
) -> float:
    pairs = zip(people_a, people_b, strict=True)
    distances = np.concatenate([pair_distances_px(first, second, a, b)[2] for a, b in pairs])
    return float(np.median(distances)) if len(distances) else float("nan")


def per_camera_px(disagreement: np.ndarray) -> np.ndarray:
    """(C,) each camera's disagreement with the typical other one.

    The lower median over the others, so that one bad camera does not spoil the good ones.
    """
    result = np.full(len(disagreement), np.nan)
    for camera, row in enumerate(disagreement):
        known = np.sort(row[np.isfinite(row)])
        if len(known):
            result[camera] = known[(len(known) - 1) // 2]
    return result


def best_shift_s(
    rig: Rig,
    tracks: Sequence[KeypointTrack],
    camera: int,
    times_s: np.ndarray,
    shifts_s: np.ndarray,
) -> tuple[float, float]:
    """The delay to add to one camera's clock that makes it agree best, and what is left [px]."""
    others = _partners(camera, len(tracks))
    views = {other: [people_at(tracks[other], t) for t in times_s] for other in others}
    left = np.full(len(shifts_s), np.inf)
    for index, shift_s in enumerate(shifts_s):
        own = [people_at(tracks[camera], t - shift_s) for t in times_s]
        medians = np.array(
            [_median_px(rig.cameras[camera], rig.cameras[o], own, views[o]) for o in others]
        )
        if np.isfinite(medians).any():
            left[index] = np.nanmin(medians) if len(others) < 3 else np.nanmedian(medians)
    best = int(np.argmin(left))
    return float(shifts_s[best]), float(left[best])


def camera_disagreement_px(
    rig: Rig, tracks: Sequence[KeypointTrack], camera: int, times_s: np.ndarray
) -> float:
    """What one camera disagrees by with the typical other one, as `per_camera_px` of all."""
    views = [[people_at(track, t) for t in times_s] for track in tracks]
    known = np.sort(
        [
            _median_px(rig.cameras[camera], rig.cameras[other], views[camera], views[other])
            for other in _partners(camera, len(tracks))
        ]
    )
    known = known[np.isfinite(known)]
    return float(known[(len(known) - 1) // 2]) if len(known) else float("inf")


def people_in_world(
    rig: Rig, tracks: Sequence[KeypointTrack], times_s: np.ndarray
) -> list[np.ndarray]:
    """Per instant (n, K, 3) landmarks [m] of people whom pairs of views agree about.

    Everyone once per pair; NaN where a landmark is not seen.
    """
    return [_people_in_world(rig, tracks, t_s) for t_s in times_s.tolist()]


def _people_in_world(rig: Rig, tracks: Sequence[KeypointTrack], t_s: float) -> np.ndarray:
    found = [np.empty((0, len(tracks[0].landmarks.landmark_names), 3))]
    views = [people_at(track, t_s) for track in tracks]
    for i, j in _pairs(len(tracks)):
        first, second = rig.cameras[i], rig.cameras[j]
        rows, columns, cost = pair_distances_px(first, second, views[i], views[j])
        good = cost < 0.01 * np.hypot(*first.size_px)
        if good.any():
            found.append(
                _triangulated(first, second, views[i][rows[good]], views[j][columns[good]])
            )
    return np.concatenate(found)


def _triangulated(
    first: Camera, second: Camera, people_a: np.ndarray, people_b: np.ndarray
) -> np.ndarray:
    """(n, k, 3): midpoints of the shortest link between two rays; NaN for nearly parallel ones."""
    u = _rays(first, people_a) @ first.rotation
    v = _rays(second, people_b) @ second.rotation
    u /= np.linalg.norm(u, axis=2, keepdims=True)
    v /= np.linalg.norm(v, axis=2, keepdims=True)
    base = second.position_in_world - first.position_in_world
    cosine = np.sum(u * v, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.where(np.abs(cosine) < 0.99, 1 - cosine**2, np.nan)
        along_u = (u @ base - cosine * (v @ base)) * scale
        along_v = (cosine * (u @ base) - v @ base) * scale
        near_u = first.position_in_world + along_u[:, :, None] * u
        near_v = second.position_in_world + along_v[:, :, None] * v
    return (near_u + near_v) / 2
