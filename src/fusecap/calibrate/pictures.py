"""Pictures of calibrations, drawn to be looked at; all are PNGs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusecap.calibrate.cameras.board_views import CameraShots
from fusecap.calibrate.cameras.extrinsics import RigSolution
from fusecap.calibrate.cameras.intrinsics import Intrinsics
from fusecap.calibrate.cameras.people_report import PeopleCalibration
from fusecap.calibrate.cameras.report import RigCalibration
from fusecap.calibrate.imus.motion import SubjectCalibration
from fusecap.calibrate.shape import MeasuredBody
from fusecap.files import write_picture

_SENSOR_COLUMNS = 3
_TOP_DEG = 40.0


def plot_rig(calibration: RigCalibration, found: Sequence[CameraShots], path: Path) -> None:
    """Corners of every camera, coloured by their held-out error, and the rig; a PNG."""
    solution = calibration.solution
    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.2 * rows + 4.2), layout="constrained")
    grid = figure.add_gridspec(rows + 1, columns, height_ratios=[3.2] * rows + [4.2])
    miss = {(view.camera, view.instant): view.fitted_px for view in calibration.held_out}
    every = np.concatenate([np.zeros(1), *miss.values()])
    top = max(1.0, float(np.percentile(every, 95)))
    for index, shots in enumerate(found):
        ax = figure.add_subplot(grid[index // columns, index % columns])
        pixels, error = [np.zeros((0, 2))], [np.zeros(0)]
        for shot in shots.shots:
            if (index, shot.instant) in miss:
                pixels.append(shot.view.pixels)
                error.append(miss[index, shot.instant])
        seen = _draw_image(ax, shots.size_px, np.concatenate(pixels), np.concatenate(error), top)
        row = calibration.report.cameras[index]
        ax.set_title(f"{shots.name}: {row.held_out_median_px:.2f} px median", fontsize=9)
        if index == len(found) - 1:
            figure.colorbar(seen, ax=ax, label="held-out error [px]")
    ax = figure.add_subplot(grid[rows, :])
    _draw_rig(ax, solution)
    write_picture(figure, path)


def plot_lenses(lenses: Sequence[Intrinsics], found: Sequence[CameraShots], path: Path) -> None:
    """Where each camera saw corners, coloured by their image's held-out error; a PNG."""
    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(4.4 * columns, 3.4 * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.ravel()[len(found) :]:
        ax.set_axis_off()
    top = max([1.0, *(2 * lens.held_out_px for lens in lenses)])
    for ax, lens, shots in zip(axes.ravel(), lenses, found, strict=False):
        by_label = {image.label: image for image in lens.images}
        used = [shot for shot in shots.shots if shot.label in by_label]
        error = [np.full(len(s.view), by_label[s.label].held_out_px) for s in used]
        seen = _draw_image(
            ax,
            shots.size_px,
            np.concatenate([np.zeros((0, 2)), *(s.view.pixels for s in used)]),
            np.concatenate([np.zeros(0), *error]),
            top,
        )
        ax.set_title(
            f"{shots.name}: {lens.held_out_px:.2f} px held out, "
            f"{100 * lens.coverage:.0f} % covered, {lens.verdict}",
            fontsize=9,
        )
        figure.colorbar(seen, ax=ax, label="error of the image [px]")
    write_picture(figure, path)


def _draw_image(
    ax: Axes,
    size_px: tuple[int, int],
    pixels: Float[np.ndarray, "n 2"],
    error: Float[np.ndarray, " n"],
    top: float,
):
    width, height = size_px
    seen = ax.scatter(pixels[:, 0], pixels[:, 1], c=error, s=5, cmap="viridis", vmin=0.0, vmax=top)
    ax.set_xlim(0, width)
    ax.set_ylim(height, 0)
    ax.set_aspect("equal")
    ax.set_xticks(np.linspace(0, width, 9), minor=True)
    ax.set_yticks(np.linspace(0, height, 7), minor=True)
    ax.set_xticks([0, width])
    ax.set_yticks([0, height])
    ax.grid(which="minor", alpha=0.3)
    return seen


def _draw_rig(ax: Axes, solution: RigSolution) -> None:
    """In the plane of the cameras' widest spread."""
    centres = np.array([camera.position_in_world for camera in solution.cameras])
    boards = np.array([pose[:3, 3] for pose in solution.boards.values()])
    middle = centres.mean(axis=0)
    _, _, axes = np.linalg.svd(np.vstack([centres, boards]) - middle, full_matrices=False)
    flat = (centres - middle) @ axes[:2].T
    there = (boards - middle) @ axes[:2].T
    ax.scatter(there[:, 0], there[:, 1], s=6, color="0.6", label="boards")
    ax.scatter(flat[:, 0], flat[:, 1], s=40, color="C3", marker="s", label="cameras")
    for camera, place in zip(solution.cameras, flat, strict=True):
        ahead = 0.3 * axes[:2] @ camera.rotation[2]
        ax.annotate(
            "",
            xy=(place[0] + ahead[0], place[1] + ahead[1]),
            xytext=(place[0], place[1]),
            arrowprops={"arrowstyle": "->", "color": "C3"},
        )
        ax.annotate(camera.name, (place[0], place[1]), xytext=(5, 5), textcoords="offset points")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title("the rig, seen along the direction in which it is thinnest", fontsize=9)
    ax.set_xlabel("[m]")
    ax.set_ylabel("[m]")
    ax.grid(alpha=0.3)
    ax.legend(fontsize=8)


def plot_people(found: PeopleCalibration, path: Path) -> None:
    """A pair of panels per camera on one scale: where keypoints lie from their landmark [px]."""
    pairs = list(found.residuals_px.items())
    columns = max(1, min(6, len(pairs)))
    rows = 2 * -(-len(pairs) // columns)
    figure = Figure(figsize=(3.1 * columns + 0.6, 3.1 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    everything = [np.abs(part) for _, pair in pairs for part in pair if len(part)]
    reach = float(np.percentile(np.concatenate(everything), 99.5)) if everything else 1.0
    for ax in axes.ravel():
        ax.set_axis_off()
    for index, (change, (_, pair)) in enumerate(zip(found.cameras, pairs, strict=True)):
        panels = zip(pair, ("before", "after"), (change.before, change.after), strict=True)
        for below, (residual, when, fit) in enumerate(panels):
            ax = axes[2 * (index // columns) + below, index % columns]
            ax.set_axis_on()
            ax.axhline(0, color="0.7", linewidth=0.8)
            ax.axvline(0, color="0.7", linewidth=0.8)
            colour = "C1" if when == "before" else "C0"
            ax.scatter(*residual.T, s=3, alpha=0.35, color=colour, linewidths=0)
            ax.set_xlim(-reach, reach)
            ax.set_ylim(reach, -reach)
            ax.set_aspect("equal")
            ax.set_title(
                f"{change.name} {when}: {fit.median_px:.1f} px, 90 % {fit.p90_px:.1f}", fontsize=9
            )
            ax.set_xlabel("right [px]", fontsize=8)
            ax.set_ylabel("down [px]", fontsize=8)
            ax.tick_params(labelsize=7)
    figure.suptitle("Keypoints about their triangulated landmarks, held-out instants", fontsize=11)
    write_picture(figure, path)


def plot_sensors(found: SubjectCalibration, path: Path) -> None:
    """One panel per sensor, written as a PNG; a sensor that slipped shows a step."""
    rows = max(1, -(-len(found.sensors) // _SENSOR_COLUMNS))
    figure = Figure(figsize=(15, 0.8 + 2.1 * rows), layout="constrained")
    figure.suptitle(
        f"{found.subject}: angle between sensor and cameras, stretches held out [deg]", fontsize=11
    )
    axes = np.atleast_1d(figure.subplots(rows, _SENSOR_COLUMNS, sharex=True, squeeze=False)).ravel()
    for ax, sensor, (times_s, residual_deg) in zip(axes, found.sensors, found.series, strict=False):
        good = sensor.usable
        ax.plot(times_s, residual_deg, ".", markersize=2, color="C0" if good else "C3")
        ax.axhline(sensor.held_out_deg, color="0.4", linewidth=1)
        if sensor.change is not None:
            ax.axvline(sensor.change.time_s, color="C3", linestyle="--", linewidth=1)
        ax.set_title(
            f"{sensor.bone}: median {sensor.held_out_deg:.1f} deg, {sensor.verdict}",
            fontsize=9,
            color="black" if good else "C3",
        )
        top = float(np.percentile(residual_deg, 99)) * 1.1 if len(residual_deg) else 1.0
        ax.set_ylim(0.0, min(max(top, 10.0), max(_TOP_DEG, 2 * sensor.held_out_deg)))
        ax.grid(alpha=0.3)
    for ax in axes[len(found.sensors) :]:
        ax.set_axis_off()
    for ax in axes[max(0, len(found.sensors) - _SENSOR_COLUMNS) : len(found.sensors)]:
        ax.set_xlabel("s")
        ax.tick_params(labelbottom=True)
    write_picture(figure, path)


def plot_bodies(bodies: Sequence[MeasuredBody], path: Path) -> None:
    """One panel per person: lengths [mm], bars of two standard deviations; written as a PNG."""
    figure = Figure(figsize=(9, 5.2 * len(bodies)), layout="constrained")
    panels = figure.subplots(len(bodies), 1, squeeze=False)[:, 0]
    for axes, body in zip(panels, bodies, strict=True):
        rows = np.arange(len(body.bones))
        for told, colour, words in (
            (True, "C0", "from this recording"),
            (False, "0.6", "from the stature"),
        ):
            chosen = [i for i, bone in enumerate(body.bones) if bone.told == told]
            if chosen:
                axes.errorbar(
                    [1e3 * body.bones[i].length_m for i in chosen],
                    rows[chosen],
                    xerr=[2e3 * body.bones[i].sigma_m for i in chosen],
                    fmt="o",
                    color=colour,
                    capsize=3,
                    label=f"{words}, two standard deviations",
                )
        axes.plot(
            [1e3 * bone.from_height_m for bone in body.bones],
            rows,
            "|",
            color="k",
            markersize=11,
            label=f"proportions of {body.height_m:.2f} m",
        )
        axes.set_yticks(rows, [bone.bone for bone in body.bones])
        axes.invert_yaxis()
        axes.set_xlabel("distance from the parent's joint, mm")
        axes.set_title(f"{body.name}, {body.instants} instants")
        axes.grid(axis="x", alpha=0.3)
        axes.legend(fontsize=8)
    write_picture(figure, path)
