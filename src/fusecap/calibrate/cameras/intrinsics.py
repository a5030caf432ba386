"""One camera's lens from images of a board.

`cv2.calibrateCamera` with k1 alone gives a start (least squares); a robust bundle adjustment takes
it from there, images that then miss by far are left out by name, and it is repeated.

**How many distortion coefficients.** Each model (`MODELS`) is calibrated on four fifths of the
images and judged on the rest, in turn. On a held-out image the board's pose is fitted, for it is
not known, and the lens stays: six numbers of some dozens. A richer model is taken only where it
lowers the held-out error by more than `WORTH`; coefficients that the images do not support make
calibrations worse where no board has been.

**Repeatability.** The calibration is repeated on images drawn with replacement; the spread of the
focal length says how much of it is the choice of images. The covariance of least squares counts
every corner's error as independent, which they are not; both are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from fusecap.calibrate.cameras.board import Board, BoardView
from fusecap.calibrate.cameras.board_views import CameraShots, Shot, diverse
from fusecap.calibrate.cameras.bundle_adjustment import (
    RAYLEIGH_MEDIAN,
    Corners,
    adjust,
    outlying,
    residuals_px,
    robust_scale_px,
    stack_views,
    view_rms_px,
)
from fusecap.calibrate.verdict import Marks, Verdict
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import Camera
from fusecap.geometry.projection_derivatives import PARAMETERS
from fusecap.progress import Progress

MIN_IMAGES = 4
"""Fewer do not determine a lens and leave nothing to check it on."""
ENOUGH_IMAGES, FEW_IMAGES = 15, 6
"""With fewer the verdict is not good, or poor."""
MAX_IMAGES = 60
"""Used of a longer recording: those that differ most."""
WORTH = 0.02
"""A model with more coefficients must lower the held-out error by this share."""
FOLDS = 5
RESAMPLES = 12
COVERAGE_GRID = (8, 6)
"""Cells across and down the image."""
MODELS: dict[str, tuple[int, ...]] = {
    "none": (),
    "k1": (10,),
    "k1 k2": (10, 11),
    "k1 k2 p1 p2 k3": (10, 11, 12, 13, 14),
}
"""Distortion models by name, and the numbers of a camera that they free."""


_TILTED_DEG = 25.0
"""Boards whose tilts differ by less than this do not tell focal length from distance."""
_GOOD_FOCAL, _POOR_FOCAL = 0.005, 0.02
"""Spread of the focal length over resampled images, as a share."""
_GOOD_COVERAGE, _POOR_COVERAGE = 0.6, 0.3
_NOT_ALL_EDGES = 0.5
"""What coverage counts for at most where an edge was never reached."""
_GOOD_PX, _POOR_PX = 0.7, 2.0
"""Held-out error, in pixels of a 1920-pixel-wide image."""


@dataclass(frozen=True, kw_only=True)
class ImageError:
    """How well one image is explained."""

    label: str
    held_out_px: float
    """Root mean square by a calibration without this image, NaN where it has no pose."""
    left_out: bool
    """Contradicts the rest, and was not used."""


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A calibrated lens and what speaks for it."""

    camera: Camera
    """At the origin."""
    model: str
    held_out_px: float
    """Root mean square over images that the calibration did not use."""
    held_out_by_model_px: dict[str, float]
    images: tuple[ImageError, ...]
    inspected: int
    shown: int
    """Images that show the board; the most different `MAX_IMAGES` of them are used."""
    coverage: float
    """Share of the cells of `COVERAGE_GRID` that hold a corner."""
    cells: Int[np.ndarray, "rows columns"]
    """Corners per cell."""
    tilt_deg: float
    """Spread of the boards' tilt against the image: 90th percentile of angles between normals."""
    focal_sigma_px: float
    """From the least squares covariance and the corners' scatter."""
    focal_spread_px: float
    """Standard deviation of fx over resampled images."""
    centre_spread_px: float
    """The same of the principal point."""
    resamples: int
    verdict: Verdict
    advice: tuple[str, ...]
    """What keeps it from being better, and what to record."""


def calibrate_intrinsics(
    found: CameraShots,
    board: Board,
    *,
    model: str | None = None,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> Intrinsics:
    """The lens of one camera; raises `CalibrationError` where the images do not determine it."""
    if len(found.shots) < MIN_IMAGES:
        raise CalibrationError(
            f"camera '{found.name}' ({found.source}): the board is in {len(found.shots)} of "
            f"{found.inspected} images; expected at least {MIN_IMAGES}, better {ENOUGH_IMAGES} or "
            "more: record the board at different places, distances and tilts"
        )
    shots = diverse(found.shots, MAX_IMAGES, found.size_px)
    names = [model] if model else list(MODELS)
    total = len(names) * FOLDS + RESAMPLES
    what = f"lens of {found.name}"
    start = _start(found, shots, board)
    fits, judged, by_image = {}, {}, {}
    for index, name in enumerate(names):
        fits[name] = _fit(start, shots, board, name)
        judged[name], by_image[name] = _held_out(
            fits[name], shots, board, name, lambda n, i=index: progress(what, i * FOLDS + n, total)
        )
    score = {name: _trimmed_rms(errors) for name, errors in judged.items()}
    chosen = _chosen(score)
    full = fits[chosen]
    focal, centre = _resampled(
        full,
        shots,
        board,
        chosen,
        seed,
        lambda n: progress(what, len(names) * FOLDS + n, total),
    )
    cells = coverage_cells([shots[i].view for i in full.kept], found.size_px)
    result = Intrinsics(
        camera=full.camera,
        model=chosen,
        held_out_px=score[chosen],
        held_out_by_model_px=score,
        images=tuple(
            ImageError(
                label=shot.label,
                held_out_px=float(by_image[chosen][i]),
                left_out=i not in full.kept,
            )
            for i, shot in enumerate(shots)
        ),
        inspected=found.inspected,
        shown=len(found.shots),
        coverage=float((cells > 0).mean()),
        cells=cells,
        tilt_deg=_tilt_deg(full.boards[full.kept]),
        focal_sigma_px=full.focal_sigma_px,
        focal_spread_px=float(np.std(focal, ddof=1)) if len(focal) > 1 else np.nan,
        centre_spread_px=float(np.linalg.norm(np.std(centre, axis=0, ddof=1)))
        if len(centre) > 1
        else np.nan,
        resamples=len(focal),
        verdict=Verdict.GOOD,
        advice=(),
    )
    marks = _marks(result)
    return replace(result, verdict=marks.verdict, advice=tuple(marks.advice))


@dataclass(frozen=True, kw_only=True)
class _Fit:
    camera: Camera
    boards: Float[np.ndarray, "b 4 4"]
    """cam_from_board of all images, also of those left out."""
    kept: list[int]
    focal_sigma_px: float


def _fit(start: _Fit, shots: Sequence[Shot], board: Board, model: str) -> _Fit:
    """Robust least squares without the images that contradict the rest."""
    free = np.zeros((1, PARAMETERS), dtype=bool)
    free[0, 6:10] = True
    free[0, list(MODELS[model])] = True
    camera = replace(start.camera, distortion=start.camera.distortion * free[0, 10:15])
    boards, kept = start.boards.copy(), list(start.kept)
    while True:
        corners = _corners(shots, kept, board)
        first = adjust([camera], boards[kept], corners, free=free, robust_px=2.0, max_steps=20)
        errors = np.linalg.norm(residuals_px(first.cameras, first.boards, corners), axis=1)
        result = adjust(
            first.cameras, first.boards, corners, free=free, robust_px=robust_scale_px(errors)
        )
        camera, boards[kept] = result.cameras[0], result.boards
        bad = outlying(view_rms_px(result.cameras, result.boards, corners, corners.board))
        if not bad.any() or len(kept) - bad.sum() < MIN_IMAGES or len(kept) < len(start.kept):
            break
        kept = [i for i, is_bad in zip(kept, bad, strict=True) if not is_bad]
    errors = np.linalg.norm(residuals_px(result.cameras, result.boards, corners), axis=1)
    sigma = float(np.nanmedian(errors)) / RAYLEIGH_MEDIAN
    return _Fit(
        camera=camera,
        boards=boards,
        kept=kept,
        focal_sigma_px=sigma * float(np.sqrt(max(result.covariance[0, 0], 0.0))),
    )


def _start(found: CameraShots, shots: Sequence[Shot], board: Board) -> _Fit:
    """OpenCV's calibration with k1 alone."""
    flags = cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
            [board.corners_in_board_m[s.view.corner_ids].astype(np.float32) for s in shots],
            [s.view.pixels.astype(np.float32) for s in shots],
            found.size_px,
            np.eye(3),
            np.zeros(5),
            flags=flags,
        )
        camera = Camera(
            name=found.name,
            size_px=found.size_px,
            matrix=np.asarray(matrix, dtype=np.float64),
            distortion=np.asarray(distortion, dtype=np.float64).ravel()[:5],
            rotation=np.eye(3),
            translation=np.zeros(3),
        )
    except (cv2.error, CalibrationError) as error:
        reason = getattr(error, "err", None) or str(error)
        raise CalibrationError(
            f"camera '{found.name}' ({found.source}): {len(shots)} images do not determine the "
            f"lens ({reason}); record the board tilted in several directions"
        ) from None
    boards = np.tile(np.eye(4), (len(shots), 1, 1))
    for pose, turn, shift in zip(boards, turns, shifts, strict=True):
        pose[:3, :3] = Rotation.from_rotvec(np.asarray(turn).ravel()).as_matrix()
        pose[:3, 3] = np.asarray(shift).ravel()
    return _Fit(camera=camera, boards=boards, kept=list(range(len(shots))), focal_sigma_px=np.nan)


def _held_out(
    full: _Fit, shots: Sequence[Shot], board: Board, model: str, done: Callable[[int], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of all corners (distances), and root mean square per image."""
    errors, by_image = [], np.full(len(shots), np.nan)
    folds = min(FOLDS, len(shots))
    fixed = np.zeros((1, PARAMETERS), dtype=bool)
    for fold, out in enumerate(np.array_split(np.arange(len(shots)), folds)):
        done(fold)
        kept = [i for i in full.kept if i not in out]
        if len(kept) < MIN_IMAGES - 1:
            continue
        lens = _fit(replace(full, kept=kept), shots, board, model).camera
        corners = _corners(shots, out.tolist(), board)
        boards = adjust([lens], full.boards[out], corners, free=fixed).boards
        miss = np.linalg.norm(residuals_px([lens], boards, corners), axis=1)
        for row, i in enumerate(out.tolist()):
            of_image = miss[corners.board == row]
            if np.isfinite(of_image).all():
                errors.append(of_image)
                by_image[i] = np.sqrt((of_image**2).mean())
    done(folds)
    return np.concatenate([np.zeros(0), *errors]), by_image


def _trimmed_rms(errors: np.ndarray) -> float:
    """Without the worst 1 % of corners, which one misread view would otherwise decide."""
    if not len(errors):
        return np.inf
    return float(np.sqrt((np.sort(errors)[: max(1, int(0.99 * len(errors)))] ** 2).mean()))


def _chosen(score: dict[str, float]) -> str:
    """The simplest model that no richer one beats by more than `WORTH`."""
    names = list(score)
    chosen = names[0]
    for name in names[1:]:
        if score[name] < (1 - WORTH) * score[chosen]:
            chosen = name
    return chosen


def _resampled(
    full: _Fit,
    shots: Sequence[Shot],
    board: Board,
    model: str,
    seed: int,
    done: Callable[[int], None],
) -> tuple[np.ndarray, np.ndarray]:
    """Fx, and the principal point, of calibrations from images drawn with replacement."""
    rng = np.random.default_rng(seed)
    focal, centre = [], []
    for sample in range(RESAMPLES):
        done(sample)
        drawn = rng.choice(full.kept, len(full.kept))
        if len(set(drawn.tolist())) < MIN_IMAGES - 1:
            continue
        again = replace(full, boards=full.boards[drawn], kept=list(range(len(drawn))))
        other = _fit(again, [shots[i] for i in drawn], board, model).camera
        focal.append(other.matrix[0, 0])
        centre.append(other.matrix[:2, 2])
    done(RESAMPLES)
    return np.array(focal), np.array(centre)


def coverage_cells(
    views: Sequence[BoardView], size_px: tuple[int, int]
) -> Int[np.ndarray, "rows columns"]:
    """Corners per cell of `COVERAGE_GRID`."""
    pixels = np.concatenate([np.zeros((0, 2)), *(view.pixels for view in views)])
    columns, rows = COVERAGE_GRID
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(rows, columns), range=((0, size_px[1]), (0, size_px[0]))
    )
    return counts.astype(np.int64)


def _tilt_deg(boards: Float[np.ndarray, "b 4 4"]) -> float:
    normals = boards[:, :3, 2]
    angle = np.degrees(np.arccos(np.clip(np.abs(normals @ normals.T), -1, 1)))
    return float(np.percentile(angle, 90))


def _empty_edges(cells: np.ndarray) -> list[str]:
    """Edges of the image along which fewer than a quarter of the cells hold a corner."""
    edges = {
        "left": cells[:, :2],
        "right": cells[:, -2:],
        "top": cells[:2],
        "bottom": cells[-2:],
    }
    return [name for name, part in edges.items() if (part > 0).mean() < 0.25]


def _marks(found: Intrinsics) -> Marks:
    camera = found.camera
    scale = camera.pixel_scale
    spread = found.focal_spread_px / camera.matrix[0, 0]
    marks = Marks()
    used = sum(not image.left_out for image in found.images)
    marks.mark(
        -used,
        -ENOUGH_IMAGES,
        -FEW_IMAGES,
        f"{used} images are few: use {ENOUGH_IMAGES} to 40 that differ",
    )
    marks.mark(
        found.held_out_px * scale,
        _GOOD_PX,
        _POOR_PX,
        f"held-out error {found.held_out_px:.2f} px: check that the board is flat, its squares "
        "equal, images sharp and focus and zoom locked",
    )
    empty = _empty_edges(found.cells)
    marks.mark(
        1 - (min(found.coverage, _NOT_ALL_EDGES) if empty else found.coverage),
        1 - _GOOD_COVERAGE,
        1 - _POOR_COVERAGE,
        f"the board covered {100 * found.coverage:.0f} % of the image: record it also near the "
        f"{', '.join(empty) or 'edges'}",
    )
    marks.mark(
        -found.tilt_deg,
        -_TILTED_DEG,
        -_TILTED_DEG / 2,
        f"boards differ by {found.tilt_deg:.0f} deg in tilt: tilt the board 20 to 45 deg towards "
        "and away from the camera, in several directions",
    )
    if not np.isfinite(spread):
        spread = np.inf
    marks.mark(
        spread,
        _GOOD_FOCAL,
        _POOR_FOCAL,
        f"the focal length varies by {100 * spread:.1f} % with the choice of images: record more "
        "tilted boards, close to the camera",
    )
    return marks


def _corners(shots: Sequence[Shot], kept: Sequence[int], board: Board) -> Corners:
    return stack_views(
        [(0, row, shots[i].view) for row, i in enumerate(kept)], board.corners_in_board_m
    )
