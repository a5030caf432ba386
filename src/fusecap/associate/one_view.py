"""What a single view says: a direction, and a place only together with a depth known before."""

from __future__ import annotations

import numpy as np

from fusecap.associate.matching import cheapest
from fusecap.associate.options import TrackerOptions
from fusecap.associate.track import Track, absorb
from fusecap.associate.views import Views
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
    """The one camera that is left sees unseen subjects (by row) again, near where expected.

    At the depth they had, and nearer than they can have gone; who is who then is a guess.
    """
    rows = list(unseen)
    away_s = [(now_ns - track.seen_ns) * 1e-9 for track in unseen.values()]
    reach = options.reach_m + options.reach_speed_m_s * np.array(away_s)
    distance = views.distances(expected[rows], 2 * float(reach.max()), free)
    for row, n in cheapest(np.where(distance < reach[:, None], distance, np.inf)):
        t, camera = rows[row], int(views.camera_of[n])
        seen = _at_depth(rig.cameras[camera], views.rays[n], expected[t])
        moved = np.nanmedian(seen - expected[t], axis=0)
        unseen[t].settle(np.where(np.isnan(seen), unseen[t].landmarks + moved, seen), now_ns)
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
