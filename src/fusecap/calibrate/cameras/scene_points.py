"""Where a camera stands, from points of the scene whose places were measured and that it shows.

Tape on the floor, corners of a box: each camera is placed on its own (perspective from n points),
in the world in which the places were measured, with the lens as it is. OpenCV's SQPnP and, for
points of a plane, both poses of IPPE give starts; the one that explains the marks best is adjusted
to them by least squares. One mark that the others contradict is left out and named.

What goes wrong here is told by name: places that were noted in a left-handed system explain the
marks only when they are mirrored; few points, or points in one corner of the picture, leave the
camera's place open.

Worked number (simulated): points over 2 m, 4.5 m away, marked to 3 px per axis of a 1920-pixel-wide
image, place a camera to 48 mm when six stand about the room, to 71 when six lie on the floor and to
125 when four do; keypoints of people then refine it (`people.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.first_poses import planar_poses
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import REFERENCE_WIDTH_PX, Camera
from fusecap.geometry.projection_derivatives import POSE, projection_derivatives
from fusecap.geometry.similarity import least_turn
from fusecap.sources.marked_points import MarkedPoints

LEAST_POINTS = 4
FLAT = 0.02
"""Points whose spread across is below this share of their spread along are flat."""
OUTLIER_FACTOR = 6.0
"""A mark is left out when it lies this many times farther off than the others without it."""
OUTLIER_PX = 40.0
"""And at least this far, in pixels of a 1920-pixel-wide image: five of six fit without any one."""
POOR_PX = 8.0
"""Of a 1920-pixel-wide image: marks made by hand and a tape measure miss by 1 to 5."""
POOR_MM = 100.0
MARK_PX = 3.0
"""Standard deviation of marks per axis at best, in the same pixels: four points fit anything."""
MIRRORED = 0.5
"""Places are called mirrored where that leaves less than this of the misfit."""


@dataclass(frozen=True, kw_only=True)
class PlacedCamera:
    """One camera in the world of the points it shows."""

    camera: Camera
    names: tuple[str, ...]
    """Of the points that are marked in it."""
    miss_px: Float[np.ndarray, " n"]
    """Of each, in the camera's own pixels."""
    used: Bool[np.ndarray, " n"]
    rms_px: float
    """Of those used, in pixels of a 1920-pixel-wide image."""
    place_sd_mm: float
    """Standard deviation of where it stands, if the errors of marks are independent."""
    problems: tuple[str, ...]


def place_cameras(
    lenses: Sequence[Camera], points: MarkedPoints
) -> tuple[list[PlacedCamera], list[str]]:
    """Every camera that shows some points, and the names of those that show none.

    `points` in the order of `lenses`, with their places. Raises `CalibrationError` with the camera
    that cannot be placed.
    """
    if points.in_world_m is None:
        raise CalibrationError("the points' places are missing: expected columns x_m, y_m, z_m")
    placed, unseen = [], []
    for lens, keypoints in zip(lenses, points.keypoints, strict=True):
        marked = np.flatnonzero(keypoints[:, 2] > 0)
        if len(marked) == 0:
            unseen.append(lens.name)
            continue
        names = tuple(points.names[i] for i in marked)
        placed.append(_place(lens, names, points.in_world_m[marked], keypoints[marked, :2]))
    if not placed:
        raise CalibrationError(
            "no point is marked in any of these cameras; expected columns <camera>_u_px and "
            "<camera>_v_px"
        )
    return placed, unseen


def _place(
    lens: Camera, names: tuple[str, ...], places_m: np.ndarray, pixels: np.ndarray
) -> PlacedCamera:
    if len(names) < LEAST_POINTS:
        raise CalibrationError(
            f"camera '{lens.name}': {len(names)} points are marked, expected {LEAST_POINTS} or "
            "more, better six that do not all lie in one plane"
        )
    spread = _spread(places_m)
    if _on_a_line(spread):
        raise CalibrationError(
            f"camera '{lens.name}': its points lie on a line; mark another one aside"
        )
    used = _without_outlier(lens, places_m, pixels)
    camera = _pose(lens, places_m[used], pixels[used])
    miss = _misses(camera, places_m, pixels)
    rms_px = _rms(miss[used] * lens.pixel_scale)
    sd_mm = _place_sd_mm(camera, places_m[used], miss[used])
    return PlacedCamera(
        camera=camera,
        names=names,
        miss_px=miss,
        used=used,
        rms_px=rms_px,
        place_sd_mm=sd_mm,
        problems=tuple(
            _problems(camera, names, places_m, pixels, miss, used, rms_px, sd_mm, spread)
        ),
    )


def _spread(places_m: np.ndarray) -> np.ndarray:
    """Along their longest axis, across it, and across both."""
    return np.linalg.svd(places_m - places_m.mean(axis=0), compute_uv=False)


def _on_a_line(spread: np.ndarray) -> bool:
    return bool(spread[1] < FLAT * max(spread[0], 1e-9))


def _pose(lens: Camera, places_m: np.ndarray, pixels: np.ndarray) -> Camera:
    """The lens where it explains the marks best; raises `CalibrationError`."""
    adjusted = [_adjusted(start, places_m, pixels) for start in _starts(lens, places_m, pixels)]
    if not adjusted:
        raise CalibrationError(
            f"camera '{lens.name}': its marks give no pose; check that they are in pixels of its "
            f"{lens.size_px[0]} x {lens.size_px[1]} picture, and the places of the points"
        )
    return min(adjusted, key=lambda camera: _rms(_misses(camera, places_m, pixels)))


def _starts(lens: Camera, places_m: np.ndarray, pixels: np.ndarray) -> list[Camera]:
    """Poses before which all points lie."""
    with np.errstate(over="ignore", invalid="ignore"):
        xy = lens.undistort(pixels)
    if not np.isfinite(xy).all():
        return []
    middle = places_m.mean(axis=0)
    _, turns, shifts = cv2.solvePnPGeneric(
        places_m - middle, xy[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
    )[:3]
    poses = [
        (Rotation.from_rotvec(np.ravel(np.asarray(turn))).as_matrix(), np.ravel(np.asarray(shift)))
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    _, spread, axes = np.linalg.svd(places_m - middle)
    if spread[2] < FLAT * spread[0]:
        level = least_turn(axes[2], np.array([0.0, 0.0, 1.0]))
        flat = (places_m - middle) @ level.T
        flat[:, 2] = 0.0
        poses += [
            (pose[:3, :3] @ level, pose[:3, 3]) for pose, _ in planar_poses(lens, flat, pixels)
        ]
    starts = [
        replace(lens, rotation=rotation, translation=shift - rotation @ middle)
        for rotation, shift in poses
        if np.isfinite(rotation).all() and np.isfinite(shift).all()
    ]
    ahead = [start for start in starts if (_depths(start, places_m) > 0).all()]
    return ahead


def _adjusted(start: Camera, places_m: np.ndarray, pixels: np.ndarray) -> Camera:
    def at(x: np.ndarray) -> Camera:
        turn = Rotation.from_rotvec(x[:3]).as_matrix()
        return replace(
            start, rotation=turn @ start.rotation, translation=turn @ start.translation + x[3:]
        )

    def residuals(x: np.ndarray) -> np.ndarray:
        away = (at(x).project(places_m) - pixels) * start.pixel_scale
        return np.nan_to_num(away, nan=REFERENCE_WIDTH_PX).ravel()

    jacobian: Any = "2-point"
    return at(least_squares(residuals, np.zeros(6), jacobian, x_scale="jac").x)


def _depths(camera: Camera, places_m: np.ndarray) -> np.ndarray:
    return places_m @ camera.rotation[2] + camera.translation[2]


def _misses(camera: Camera, places_m: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    away = np.linalg.norm(camera.project(places_m) - pixels, axis=1)
    return np.nan_to_num(away, nan=REFERENCE_WIDTH_PX / camera.pixel_scale)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _without_outlier(lens: Camera, places_m: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """All marks but the one, if any, that five or more others contradict.

    Others on a line contradict nothing: a camera may turn about it.
    """
    every = np.ones(len(pixels), dtype=bool)
    best, best_ratio = every, 1.0
    for index in range(len(pixels) if len(pixels) > LEAST_POINTS + 1 else 0):
        kept = every.copy()
        kept[index] = False
        if _on_a_line(_spread(places_m[kept])):
            continue
        try:
            away = _misses(_pose(lens, places_m[kept], pixels[kept]), places_m, pixels)
        except CalibrationError:
            continue
        away *= lens.pixel_scale
        freedom = 2 * int(kept.sum()) - 6
        others = float(np.sqrt(2 * np.sum(away[kept] ** 2) / freedom))
        ratio = away[index] / max(OUTLIER_FACTOR * others, OUTLIER_PX)
        if ratio > best_ratio:
            best, best_ratio = kept, ratio
    return best


def _place_sd_mm(camera: Camera, places_m: np.ndarray, miss_px: np.ndarray) -> float:
    _, by_camera, _ = projection_derivatives(camera, places_m)
    jacobian = (by_camera[:, :, POSE] * camera.pixel_scale).reshape(-1, 6)
    variance = float(np.sum((miss_px * camera.pixel_scale) ** 2)) / (2 * len(miss_px) - 6)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(variance, MARK_PX**2)
    # The centre is -R't; turning the camera about the world's origin moves it, too.
    x, y, z = camera.translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    by_pose = np.hstack([-cross, -np.eye(3)])
    return 1e3 * float(np.sqrt(np.trace(by_pose @ covariance @ by_pose.T)))


def _problems(
    camera: Camera,
    names: Sequence[str],
    places_m: np.ndarray,
    pixels: np.ndarray,
    miss: np.ndarray,
    used: np.ndarray,
    rms_px: float,
    sd_mm: float,
    spread: np.ndarray,
) -> list[str]:
    where = f"camera '{camera.name}'"
    found = [
        f"{where}: '{name}' is {away:.0f} px from where the others have it and was left out; check "
        "its mark and its place"
        for name, away, kept in zip(names, miss, used, strict=True)
        if not kept
    ]
    if rms_px > POOR_PX:
        found.append(f"{where}: {_why_they_miss(camera, places_m[used], pixels[used], rms_px)}")
    if used.sum() == LEAST_POINTS:
        found.append(f"{where}: four points hardly check each other; mark two more")
    elif spread[2] < FLAT * spread[0] and sd_mm > POOR_MM:
        found.append(f"{where}: all its points lie in one plane; mark some above it")
    if sd_mm > POOR_MM:
        found.append(
            f"{where}: stands where it does to {sd_mm:.0f} mm only; mark more points, nearer and "
            "over more of the picture, or refine it: fusecap calibrate extrinsics --from-people"
        )
    return found


def _why_they_miss(camera: Camera, places_m: np.ndarray, pixels: np.ndarray, rms_px: float) -> str:
    mirrored = places_m * [-1.0, 1.0, 1.0]
    try:
        left_px = _rms(_misses(_pose(camera, mirrored, pixels), mirrored, pixels))
    except CalibrationError:
        left_px = np.inf
    left_px *= camera.pixel_scale
    if left_px < MIRRORED * rms_px:
        return (
            f"the marks are {rms_px:.0f} px off, with the places mirrored {left_px:.1f}: x_m, y_m, "
            "z_m are of a left-handed system; change the sign of one of them for all points"
        )
    return (
        f"the marks are {rms_px:.0f} px off in the mean (of a 1920-pixel-wide picture); check that "
        "names and places belong together, and that the picture is of the lens' calibration"
    )
