"""Puts calibrated cameras into the world: floor at y = 0, y up, north where IMUs have it.

A calibration from a moving board knows where cameras stand to each other, not where the floor is.
One of four things tells it:

    board on the floor      its plane is the floor, its edges are x and z
    marked points           their places in the world are measured: a rigid or similarity fit
    points on the floor     three or more: the plane through them is the floor
    gravity                 an IMU at rest, on a camera or on the board, feels what is up

and each gives a `Similarity`, new world from old, that moves all cameras together: how they stand
to each other and what they see stays as it was.

A board's plane is only as level as its corners say. Worked number (simulated): 24 corners of 60 mm
squares in 1920-pixel-wide images (focal length 1150 px), 4.6 m away and found to 0.3 px, leave 0.15
degrees of tilt in two views and 0.11 in four: 10 and 8 mm of height at 4 m.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.floor_board import fit_board
from fusecap.errors import CalibrationError, InputError, nearest
from fusecap.geometry.camera import Rig
from fusecap.geometry.similarity import Similarity, fitted_similarity, least_turn
from fusecap.geometry.triangulation import triangulate
from fusecap.sources.marked_points import MarkedPoints

FLAT = 0.05
"""Points whose spread across is below this share of their spread along lie on a line."""
OUTLIER_FACTOR = 6.0
"""A point is an outlier when it lies this many times farther off than the others without it."""
OUTLIER_M = 0.02
"""And at least this far."""
CLICK_ROBUST_PX = 25.0
"""Marks are made by hand; one that is farther off than three times this is a mistake."""
POOR_PX = 2.0
"""Of a 1920-pixel-wide image: reprojection above which a board does not lie as it is seen."""
POOR_MM = 20.0
POOR_TILT_DEG = 0.25
POOR_SCALE = 0.01

REFERENCES = {"nwu": 0.0, "enu": 90.0}
"""Reference worlds of IMUs: the compass bearing of their x axis [degrees]."""


@dataclass(frozen=True, kw_only=True)
class Residual:
    """How far one point, or one camera's corners, are from where the result has them."""

    name: str
    mm: float | None = None
    px: float | None = None
    """Root mean square, in pixels of that camera."""
    used: bool = True
    """Whether it took part; an outlier does not."""


@dataclass(frozen=True, kw_only=True)
class NewWorld:
    """A new world, and how sure it is."""

    change: Similarity
    how: str
    residuals: tuple[Residual, ...] = ()
    rms_mm: float | None = None
    rms_px: float | None = None
    """Of a 1920-pixel-wide image."""
    tilt_deg: float | None = None
    """Standard deviation of the floor's tilt, if the errors of marks or corners are independent."""
    found_scale: float | None = None
    """What the calibration's lengths would have to be multiplied by; done where asked for."""
    world_from_board: Float[np.ndarray, "3 3"] | None = None
    """How the board on the floor lies in the new world."""
    problems: tuple[str, ...] = ()
    """What is poor, each with its remedy."""


def from_board(
    rig: Rig,
    board: Board,
    views: Mapping[str, BoardView],
    *,
    thickness_m: float = 0.0,
    up_in_board: Float[np.ndarray, "3"] | None = None,
    scale: bool = False,
) -> NewWorld:
    """The world of a board that lies on the floor, face up.

    The origin is the outer corner of the board's first square, `thickness_m` below its face; x runs
    along the rows of squares, z along the columns, y to where the cameras are. With `up_in_board`
    (from an IMU on it) the board gives the origin and the heading, gravity what is up. `scale` also
    fits the size of the calibration to the board's; it takes two views. Raises `CalibrationError`.
    """
    if not views:
        raise CalibrationError("no camera sees the board on the floor; expected one or more")
    if scale and len(views) < 2:
        raise CalibrationError(
            "one view cannot tell the calibration's scale from a board; give two or more"
        )
    fit = fit_board(rig, board, views, scale=False)
    with_scale = fit_board(rig, board, views, scale=True) if len(views) > 1 else None
    chosen = with_scale if scale and with_scale is not None else fit
    found_scale = None if with_scale is None else 1.0 / with_scale.size
    world_from_board = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    if up_in_board is not None:
        level = least_turn(world_from_board @ up_in_board, np.array([0.0, 1.0, 0.0]))
        world_from_board = level @ world_from_board
    rotation = world_from_board @ chosen.rotation.T
    grow = 1.0 / chosen.size
    change = Similarity(
        rotation=rotation,
        translation_m=np.array([0.0, thickness_m, 0.0]) - grow * rotation @ chosen.translation_m,
        scale=grow,
    )
    problems = []
    if chosen.rms_px > POOR_PX:
        problems.append(
            f"the board's corners are {chosen.rms_px:.1f} px off in the mean; check that the board "
            "did not move between the images, that board.toml is this board's and that the images "
            "have the calibration's resolution"
        )
    if up_in_board is None and chosen.tilt_deg > POOR_TILT_DEG:
        problems.append(
            f"the floor's tilt is known to {chosen.tilt_deg:.2f} deg only; show the board to more "
            "cameras, lay it nearer, or use a larger one"
        )
    if found_scale is not None and not scale and abs(found_scale - 1) > POOR_SCALE:
        problems.append(
            f"the board says that lengths of this calibration are to be multiplied by "
            f"{found_scale:.4f}; if board.toml has the measured square, use --scale-by board"
        )
    return NewWorld(
        change=change,
        how=f"board on the floor, seen by {len(views)} of {len(rig)} cameras"
        + ("" if up_in_board is None else ", up from gravity"),
        residuals=tuple(Residual(name=n, px=px) for n, px in chosen.camera_px.items()),
        rms_px=chosen.rms_px,
        tilt_deg=chosen.tilt_deg if up_in_board is None else None,
        found_scale=found_scale,
        world_from_board=world_from_board,
        problems=tuple(problems),
    )


def from_points(rig: Rig, points: MarkedPoints, *, scale: bool = False) -> NewWorld:
    """The world in which marked points have their measured places, by least squares.

    Rigid, or with `scale` a similarity (Umeyama 1991). A point that contradicts the others is left
    out and named. Raises `InputError` for fewer than three points in two views or points on a line.
    """
    if points.in_world_m is None:
        raise InputError("marked points need x_m, y_m, z_m; points on the floor alone do without")
    old, seen, unseen = _triangulated(rig, points)
    new = points.in_world_m[seen]
    names = [points.names[i] for i in seen]
    _check_spread(new, "the points' places in the world")
    _check_spread(old, "the marked points, as the cameras see them,")

    def distance(kept: np.ndarray) -> np.ndarray:
        return np.linalg.norm(
            fitted_similarity(old[kept], new[kept], scale=scale).points(old) - new, axis=1
        )

    used = _without_outlier(new, distance, least=3)
    change = fitted_similarity(old[used], new[used], scale=scale)
    away_m = np.linalg.norm(change.points(old) - new, axis=1)
    rms_mm = 1e3 * float(np.sqrt(np.mean(away_m[used] ** 2)))
    similar = fitted_similarity(old[used], new[used], scale=True)
    problems = _outlier_words(names, away_m, used)
    if rms_mm > POOR_MM:
        problems.append(
            f"the points fit to {rms_mm:.0f} mm; check their marks, their measured places and the "
            "calibration"
        )
    if not scale and abs(similar.scale - 1) > POOR_SCALE:
        problems.append(
            f"the points fit better when lengths of this calibration are multiplied by "
            f"{similar.scale:.4f}; if their places were measured with care, use --scale-by points"
        )
    if used.sum() == 3:
        problems.append("three points hardly check each other; mark a fourth")
    return NewWorld(
        change=change,
        how=f"{used.sum()} marked points, {'similarity' if scale else 'rigid'}",
        residuals=_point_residuals(names, away_m, used, unseen),
        rms_mm=rms_mm,
        found_scale=similar.scale,
        problems=tuple(problems),
    )


def from_floor_points(
    rig: Rig, points: MarkedPoints, *, up_in_old: Float[np.ndarray, "3"] | None = None
) -> NewWorld:
    """The world whose floor is the plane through marked points, below the cameras.

    The axes turn no farther than the plane asks for and the origin moves along up only, so where x
    points stays as it was. With `up_in_old` gravity says what is up, and one point how high the
    floor is. Raises `InputError`.
    """
    old, seen, unseen = _triangulated(rig, points, least=1 if up_in_old is not None else 3)
    names = [points.names[i] for i in seen]
    centres = np.array([camera.position_in_world for camera in rig.cameras])
    used = np.ones(len(old), dtype=bool)
    tilt_deg = None
    up = up_in_old
    if up is None:
        _check_spread(old, "the floor's points")
        used = _without_outlier(old, lambda kept: _distance_from_plane(old, kept), least=4)
        up, spread_m = _plane(old[used])
        up = up * np.sign(up @ (centres.mean(axis=0) - old.mean(axis=0)))
        if used.sum() > 3:
            off = (old[used] - old[used].mean(axis=0)) @ up
            noise = np.sqrt(np.sum(off**2) / (used.sum() - 3))
            tilt_deg = float(np.degrees(noise / (spread_m * np.sqrt(used.sum()))))
    rotation = least_turn(up, np.array([0.0, 1.0, 0.0]))
    height = old @ rotation.T[:, 1]
    floor = height[used].mean()
    away_m = np.abs(height - floor)
    rms_mm = 1e3 * float(np.sqrt(np.mean(away_m[used] ** 2)))
    problems = _outlier_words(names, away_m, used)
    if tilt_deg is None and used.sum() == 3:
        problems.append("three points make any plane: nothing checks them; mark a fourth")
    if rms_mm > POOR_MM:
        problems.append(f"the points leave their plane by {rms_mm:.0f} mm; check their marks")
    if tilt_deg is not None and tilt_deg > POOR_TILT_DEG:
        problems.append(
            f"the floor's tilt is known to {tilt_deg:.2f} deg only; mark points farther apart"
        )
    return NewWorld(
        change=Similarity(rotation=rotation, translation_m=np.array([0.0, -floor, 0.0])),
        how=f"{used.sum()} points on the floor",
        residuals=_point_residuals(names, away_m, used, unseen),
        rms_mm=rms_mm,
        tilt_deg=tilt_deg,
        problems=tuple(problems),
    )


def from_gravity(up_in_old: Float[np.ndarray, "3"]) -> NewWorld:
    """The world turned until `up_in_old` is y; its origin stays, so the floor is still unknown."""
    return NewWorld(
        change=Similarity(rotation=least_turn(up_in_old, np.array([0.0, 1.0, 0.0]))),
        how="gravity",
        problems=(
            "gravity says what is up, not where the floor is; add --floor-points with one point "
            "or more, or --board, or set floor = false in the session",
        ),
    )


def to_reference(
    reference_from_body: Float[np.ndarray, "3 3"], world_from_body: Float[np.ndarray, "3 3"]
) -> Similarity:
    """The turn about y after which the world is an IMU's reference world: heading_deg is then 0."""
    turn = reference_from_body @ world_from_body.T
    angle = np.arctan2(turn[0, 2] - turn[2, 0], turn[0, 0] + turn[2, 2])
    return _turn_about_up(float(angle))


def to_north(x_bearing_deg: float, reference: str = "nwu") -> Similarity:
    """The turn about y after which x points where the reference world's x does.

    `x_bearing_deg` is what a compass reads along the world's x axis as it is: 0 north, 90 east.
    """
    return _turn_about_up(np.radians(REFERENCES[reference] - x_bearing_deg))


def known_length(
    rig: Rig, first: str, second: str, length_m: float, points: MarkedPoints | None = None
) -> Similarity:
    """The scale at which two cameras, or two marked points, are `length_m` apart.

    Raises `InputError` for unknown names.
    """
    places = {camera.name: camera.position_in_world for camera in rig.cameras}
    if points is not None:
        old, seen, _ = _triangulated(rig, points, least=1)
        places |= {points.names[i]: place for i, place in zip(seen, old, strict=True)}
    for name in (first, second):
        if name not in places:
            raise InputError(
                f"no camera or point in two views is called '{name}'{nearest(name, places)}"
            )
    distance = float(np.linalg.norm(places[first] - places[second]))
    if distance < 1e-6 or not 0.01 <= length_m <= 200.0:
        raise InputError(
            f"'{first}' and '{second}' are {distance:.3f} apart in the calibration and "
            f"{length_m:g} m in truth; expected two places and 0.01 to 200 m"
        )
    return Similarity(scale=length_m / distance)


def _triangulated(
    rig: Rig, points: MarkedPoints, least: int = 3
) -> tuple[np.ndarray, list[int], tuple[str, ...]]:
    """Places in the old world of the points that two cameras agree on, which, and the others."""
    places, _ = triangulate(rig, points.keypoints, CLICK_ROBUST_PX)
    good = np.isfinite(places[:, 0])
    unseen = tuple(name for name, ok in zip(points.names, good, strict=True) if not ok)
    if good.sum() < least:
        lost = f" ({', '.join(unseen[:5])} are not)" if unseen else ""
        raise InputError(
            f"{good.sum()} of {len(good)} points are marked in two cameras that agree{lost}, "
            f"expected {least} or more; mark more points, each in two cameras"
        )
    return places[good], [int(i) for i in np.flatnonzero(good)], unseen


def _check_spread(points: np.ndarray, what: str) -> None:
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) < 3 or spread[1] < FLAT * max(spread[0], 1e-9):
        raise InputError(f"{what} lie on a line; mark another one aside")


def _without_outlier(points: np.ndarray, distance, *, least: int) -> np.ndarray:
    """All but the one point, if any, that the others contradict and that is not needed.

    `distance` gives all points' distances [m] from a fit to the kept ones.
    """
    every = np.ones(len(points), dtype=bool)
    if len(points) <= least:
        return every
    best, best_ratio = every, 1.0
    for index in range(len(points)):
        kept = every.copy()
        kept[index] = False
        rest = points[kept] - points[kept].mean(axis=0)
        spread = np.linalg.svd(rest, compute_uv=False)
        if spread[1] < FLAT * spread[0]:
            continue
        away = distance(kept)
        freedom = max(3 * int(kept.sum()) - 6, 1)
        others = np.sqrt(3 * np.sum(away[kept] ** 2) / freedom)
        ratio = away[index] / max(OUTLIER_FACTOR * others, OUTLIER_M)
        if ratio > best_ratio:
            best, best_ratio = kept, ratio
    return best


def _plane(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Normal, and root mean square spread along the plane's narrow side [m]."""
    _, singular, vt = np.linalg.svd(points - points.mean(axis=0))
    return vt[2], float(singular[1] / np.sqrt(len(points)))


def _distance_from_plane(points: np.ndarray, kept: np.ndarray) -> np.ndarray:
    normal, _ = _plane(points[kept])
    return np.abs((points - points[kept].mean(axis=0)) @ normal)


def _outlier_words(names: Sequence[str], away_m: np.ndarray, used: np.ndarray) -> list[str]:
    return [
        f"'{name}' is {1e3 * away:.0f} mm from where the others have it and was left out; check "
        "its marks and its place"
        for name, away, kept in zip(names, away_m, used, strict=True)
        if not kept
    ]


def _point_residuals(
    names: Sequence[str], away_m: np.ndarray, used: np.ndarray, unseen: Sequence[str]
) -> tuple[Residual, ...]:
    seen = [
        Residual(name=name, mm=1e3 * float(away), used=bool(kept))
        for name, away, kept in zip(names, away_m, used, strict=True)
    ]
    return (*seen, *(Residual(name=name, used=False) for name in unseen))


def _turn_about_up(angle_rad: float) -> Similarity:
    return Similarity(rotation=Rotation.from_rotvec([0.0, angle_rad, 0.0]).as_matrix())
