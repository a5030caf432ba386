"""What speaks for a calibration of several cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusecap.calibrate.cameras import extrinsics, extrinsics_checks
from fusecap.calibrate.cameras.board import Board
from fusecap.calibrate.cameras.board_views import CameraShots
from fusecap.calibrate.cameras.extrinsics import RigSolution
from fusecap.calibrate.cameras.extrinsics_checks import HeldOut, Repeatability, ScaleCheck
from fusecap.calibrate.cameras.intrinsics import coverage_cells
from fusecap.calibrate.verdict import Marks, Verdict
from fusecap.errors import CalibrationError
from fusecap.geometry.camera import REFERENCE_WIDTH_PX, Camera
from fusecap.progress import Progress

GOOD_PX, POOR_PX = 1.0, 3.0
"""Median held-out error of a corner, in pixels of a 1920-pixel-wide image."""
GOOD_SCALE, POOR_SCALE = 0.005, 0.02
"""Mean triangulated edge of a square: how far from the stated one, as a share."""
GOOD_CENTRE, POOR_CENTRE = 0.003, 0.015
"""Spread of a camera's centre over resampled instants, as a share of the rig's size."""
GOOD_COVERAGE = 0.3
"""Of the cells of each image."""
ENOUGH_INSTANTS, FEW_INSTANTS = 15, 5
WORST_CAMERA = 2.0
"""One camera may miss by so many times what all together may."""
GOOD_LEFT_OUT, POOR_LEFT_OUT = 0.1, 0.3
"""Share of the views that contradict the rest: beyond a third, which are the right ones is open."""
GOOD_RESAMPLES, POOR_RESAMPLES = 8, 5
"""Of `RESAMPLES`, those in which all cameras stay connected."""


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """One camera of a rig."""

    name: str
    views: int
    """Images that show the board while another camera sees it."""
    held_out_px: float
    """Root mean square; the board's pose fitted to all views of the instant."""
    held_out_median_px: float
    predicted_median_px: float
    """The board's pose fitted to the other cameras' views."""
    coverage: float
    """Share of the image's cells that hold a corner."""
    centre_spread_mm: float
    rotation_spread_deg: float
    pixel_scale: float
    """A pixel of this camera in pixels of a 1920-pixel-wide image."""


@dataclass(frozen=True, kw_only=True)
class ViewReport:
    """One image."""

    camera: str
    label: str
    instant: int
    held_out_px: float
    """Root mean square; NaN where it could not be held out."""
    left_out: bool


@dataclass(frozen=True, kw_only=True)
class RigReport:
    """A calibration of several cameras and what speaks for it."""

    cameras: tuple[CameraReport, ...]
    views: tuple[ViewReport, ...]
    instants: int
    """At which two cameras or more see the board."""
    shared: dict[str, int]
    """Instants per pair of cameras."""
    held_out_px: float
    held_out_median_px: float
    predicted_median_px: float
    scale: ScaleCheck
    resamples: int
    rig_size_m: float
    """The largest distance between two cameras."""
    verdict: Verdict
    advice: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class RigCalibration:
    """Everything `calibrate extrinsics` has."""

    solution: RigSolution
    held_out: tuple[HeldOut, ...]
    report: RigReport


def calibrate_rig(
    cameras: Sequence[Camera],
    found: Sequence[CameraShots],
    board: Board,
    *,
    refine_intrinsics: bool = False,
    seed: int = 0,
    progress: Progress = lambda what, done, total: None,
) -> RigCalibration:
    """Solves the rig and measures it; raises `CalibrationError` where it cannot be solved.

    `cameras` hold the intrinsics, in the order of `found`; the first becomes the world.
    """
    if board.ambiguous:
        raise CalibrationError(
            f"a {board.words} looks the same after half a turn, so cameras that see it from "
            "different sides disagree on its first corner; print a charuco board (fusecap "
            f"calibrate board), or a checkerboard of {board.columns} x {board.rows + 1} squares"
        )
    for camera, shots in zip(cameras, found, strict=True):
        if camera.size_px != shots.size_px:
            raise CalibrationError(
                f"camera '{camera.name}': its intrinsics are for {camera.size_px[0]} x "
                f"{camera.size_px[1]} px, {shots.source} is {shots.size_px[0]} x "
                f"{shots.size_px[1]}; calibrate the lens in the mode that records"
            )
    views = extrinsics.views_of(found)
    progress("all cameras at once", 0, 1)
    solution = extrinsics.solve(cameras, views, board, refine_intrinsics=refine_intrinsics)
    progress("all cameras at once", 1, 1)
    held_out, scale = extrinsics_checks.held_out(
        cameras, views, board, refine_intrinsics=refine_intrinsics, progress=progress
    )
    repeated = extrinsics_checks.repeatability(
        solution,
        views,
        board,
        refine_intrinsics=refine_intrinsics,
        seed=seed,
        progress=progress,
    )
    return RigCalibration(
        solution=solution,
        held_out=tuple(held_out),
        report=_report(solution, found, held_out, scale, repeated),
    )


def _report(
    solution: RigSolution,
    found: Sequence[CameraShots],
    held_out: Sequence[HeldOut],
    scale: ScaleCheck,
    repeated: Repeatability,
) -> RigReport:
    by_view = {(view.camera, view.instant): view for view in held_out}
    left_out = set(solution.left_out)
    instants = set(solution.boards)
    cameras, views = [], []
    for index, (camera, shots) in enumerate(zip(solution.cameras, found, strict=True)):
        mine = [view for view in held_out if view.camera == index]
        used = [shot for shot in shots.shots if shot.instant in instants]
        cells = coverage_cells([shot.view for shot in used], shots.size_px)
        cameras.append(
            CameraReport(
                name=camera.name,
                views=len(used),
                held_out_px=_rms([view.fitted_px for view in mine]),
                held_out_median_px=_median([view.fitted_px for view in mine]),
                predicted_median_px=_median([view.predicted_px for view in mine]),
                coverage=float((cells > 0).mean()),
                centre_spread_mm=repeated.centre_mm[index],
                rotation_spread_deg=repeated.rotation_deg[index],
                pixel_scale=camera.pixel_scale,
            )
        )
        for shot in used:
            view = by_view.get((index, shot.instant))
            views.append(
                ViewReport(
                    camera=camera.name,
                    label=shot.label,
                    instant=shot.instant,
                    held_out_px=np.nan if view is None else _rms([view.fitted_px]),
                    left_out=(index, shot.instant) in left_out,
                )
            )
    centres = np.array([camera.position_in_world for camera in solution.cameras])
    size = float(np.linalg.norm(centres[:, None] - centres[None], axis=2).max())
    seen = {
        (a.name, b.name): len({s.instant for s in a.shots} & {s.instant for s in b.shots})
        for i, a in enumerate(found)
        for b in found[i + 1 :]
    }
    scaled = [view.fitted_px * solution.cameras[view.camera].pixel_scale for view in held_out]
    verdict, advice = verdict_of(
        error_px=_median(scaled),
        scale=scale,
        cameras=cameras,
        size_m=size,
        instants=len(instants),
        left_out=len(left_out) / max(len(views), 1),
        resamples=repeated.resamples,
    )
    return RigReport(
        cameras=tuple(cameras),
        views=tuple(views),
        instants=len(instants),
        shared={f"{a}, {b}": count for (a, b), count in seen.items()},
        held_out_px=_rms([view.fitted_px for view in held_out]),
        held_out_median_px=_median([view.fitted_px for view in held_out]),
        predicted_median_px=_median([view.predicted_px for view in held_out]),
        scale=scale,
        resamples=repeated.resamples,
        rig_size_m=size,
        verdict=verdict,
        advice=advice,
    )


def verdict_of(
    *,
    error_px: float,
    scale: ScaleCheck,
    cameras: Sequence[CameraReport],
    size_m: float,
    instants: int,
    left_out: float,
    resamples: int,
) -> tuple[Verdict, tuple[str, ...]]:
    """The worst of all marks, and what to do; what could not be measured counts as poor.

    `error_px` is the median of all held-out corners in pixels of a 1920-pixel-wide image,
    `left_out` the share of views that contradict the rest.
    """
    marks = Marks()
    marks.mark(
        -instants,
        -ENOUGH_INSTANTS,
        -FEW_INSTANTS,
        f"{instants} instants with the board in two cameras are few: record {ENOUGH_INSTANTS} or "
        "more, all over the volume",
    )
    worst = max(cameras, key=lambda c: np.nan_to_num(_scaled_px(c), nan=np.inf))
    marks.mark(
        left_out,
        GOOD_LEFT_OUT,
        POOR_LEFT_OUT,
        f"{100 * left_out:.0f} % of the views contradict the rest and were left out: check that "
        "cameras are in step and that the board does not bend",
    )
    marks.mark(
        float(np.maximum(error_px, _scaled_px(worst) / WORST_CAMERA)),
        GOOD_PX,
        POOR_PX,
        f"held-out corners miss by {error_px:.1f} px of a {REFERENCE_WIDTH_PX:.0f}-px-wide image "
        f"in the median, most in '{worst.name}' ({_scaled_px(worst):.1f} px): move the board "
        "slowly or hold it still, check that cameras are in step and intrinsics theirs",
    )
    least = min(cameras, key=lambda c: c.coverage)
    marks.mark(
        1 - least.coverage,
        1 - GOOD_COVERAGE,
        1.0,
        f"the board covered {100 * least.coverage:.0f} % of the image of '{least.name}': carry it "
        "through the whole volume",
    )
    off = abs(scale.mean - 1.0)
    marks.mark(
        off,
        GOOD_SCALE,
        POOR_SCALE,
        f"triangulated squares measure {100 * scale.mean:.1f} % of the stated size: measure the "
        "print, check the intrinsics",
    )
    spread = max(cameras, key=lambda c: np.nan_to_num(c.centre_spread_mm, nan=np.inf))
    marks.mark(
        1e-3 * spread.centre_spread_mm / max(size_m, 1e-9),
        GOOD_CENTRE,
        POOR_CENTRE,
        f"'{spread.name}' moves by {spread.centre_spread_mm:.0f} mm with the choice of instants: "
        "record more boards that it shares with the others, closer to the cameras and tilted",
    )
    marks.mark(
        -resamples,
        -GOOD_RESAMPLES,
        -POOR_RESAMPLES,
        f"only {resamples} of {extrinsics_checks.RESAMPLES} resampled calibrations connect all "
        "cameras: record more boards that cameras see together",
    )
    return marks.verdict, tuple(marks.advice)


def _scaled_px(camera: CameraReport) -> float:
    """Median held-out error, in pixels of a 1920-pixel-wide image."""
    return camera.held_out_median_px * camera.pixel_scale


def _rms(errors: Sequence[np.ndarray]) -> float:
    every = np.concatenate([np.zeros(0), *errors])
    return float(np.sqrt(np.nanmean(every**2))) if np.isfinite(every).any() else np.nan


def _median(errors: Sequence[np.ndarray | None]) -> float:
    every = np.concatenate([np.zeros(0), *(e for e in errors if e is not None)])
    return float(np.nanmedian(every)) if np.isfinite(every).any() else np.nan
