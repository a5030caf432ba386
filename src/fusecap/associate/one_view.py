"""What a single view says: a direction, and a place only together with a depth known before."""

from __future__ import annotations

import numpy as np

from fusecap.associate.matching import cheapest
from fusecap.associate.options import TrackerOptions
from fusecap.associate.track import Track, absorb
from fusecap.associate.views import MIN_COMMON, Views
from fusecap.geometry.camera import Camera, Rig

_HIP_HEIGHT_M = 0.9
"""Of an adult, where only a start position on the floor is known."""


def follow(
    rig: Rig,
    views: Views,
    tracks: list[Track],
    person: np.ndarray,
    expected: np.ndarray,
    now_ns: int,
) -> None:
    """Move the tracks that hardly more than one view shows: sideways, at the depth they had."""
    for t in range(len(expected)):
        if tracks[t].seen_ns < now_ns and (person[t] >= 0).any():
            camera = int(np.argmax(person[t] >= 0))
            ray = views.rays[person[t, camera]]
            seen = _at_depth(rig.cameras[camera], ray, tracks[t].landmarks)
            absorb([tracks[t]], seen[None], expected[t : t + 1], now_ns)


def find_again(
    rig: Rig,
    views: Views,
    unseen: dict[int, Track],
    person: np.ndarray,
    expected: np.ndarray,
    free: np.ndarray,
    options: TrackerOptions,
    now_ns: int,
) -> None:
    """Single cameras see unseen subjects (by row) again, near where expected and posed as expected.

    At the depth they had, and nearer than they can have gone; who is who then is a guess.
    """
    rows, people = list(unseen), np.flatnonzero(free)
    cost = np.full((len(rows), len(people)), np.inf)
    moved = np.zeros((*cost.shape, 3))
    for row, t in enumerate(rows):
        away_s = (now_ns - unseen[t].seen_ns) * 1e-9
        reach_m = options.reach_m + options.reach_speed_m_s * away_s
        for column, n in enumerate(people):
            camera = rig.cameras[views.camera_of[n]]
            seen = _at_depth(camera, views.rays[n], expected[t]) - expected[t]
            known = np.isfinite(seen[:, 0])
            if known.sum() < MIN_COMMON:
                continue
            moved[row, column] = np.median(seen[known], axis=0)
            away_m = float(np.linalg.norm(moved[row, column]))
            other_m = np.linalg.norm(seen[known] - moved[row, column], axis=1).mean()
            if away_m < reach_m and other_m < options.candidates.consistency_m:
                cost[row, column] = away_m + other_m
    for row, column in cheapest(cost):
        t, n = rows[row], int(people[column])
        camera = int(views.camera_of[n])
        seen = _at_depth(rig.cameras[camera], views.rays[n], expected[t])
        elsewhere = unseen[t].landmarks + moved[row, column]
        unseen[t].settle(np.where(np.isnan(seen), elsewhere, seen), now_ns)
        person[t, camera] = n
        free[n] = False


def nearest_in_view(
    camera: Camera, views: Views, start_m: tuple[float, float], radius_m: float
) -> int:
    """The detection of the only camera nearest to a person at `start_m`; -1 if none is near."""
    hips = camera.rotation @ [start_m[0], _HIP_HEIGHT_M, start_m[1]] + camera.translation
    weight = views.rays[:, :, 2:]
    middle = (np.nan_to_num(views.rays[:, :, :2]) * weight).sum(axis=1)
    middle /= np.maximum(weight.sum(axis=1), 1e-9)
    away_m = np.linalg.norm(middle * hips[2] - hips[:2], axis=1)
    nearest = int(np.argmin(away_m))
    return nearest if away_m[nearest] < radius_m else -1


def _at_depth(camera: Camera, ray: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Where one view puts landmarks (k, 3) if their depth has not changed; NaN where unseen."""
    depth = landmarks @ camera.rotation[2] + camera.translation[2]
    depth = np.where(ray[:, 2] > 0, depth, np.nan)
    in_cam = np.stack([ray[:, 0] * depth, ray[:, 1] * depth, depth], axis=1)
    return (in_cam - camera.translation) @ camera.rotation
