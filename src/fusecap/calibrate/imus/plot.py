"""Each sensor's residual over time, drawn to be looked at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fusecap.calibrate.imus.motion import SubjectCalibration
from fusecap.files import written_whole

_COLUMNS = 3
_TOP_DEG = 40.0


def plot_residuals(found: SubjectCalibration, path: Path) -> None:
    """One panel per sensor, written as a PNG; a sensor that slipped shows a step."""
    rows = max(1, -(-len(found.sensors) // _COLUMNS))
    figure = Figure(figsize=(15, 0.8 + 2.1 * rows), layout="constrained")
    figure.suptitle(
        f"{found.subject}: angle between sensor and cameras, stretches held out [deg]", fontsize=11
    )
    axes = np.atleast_1d(figure.subplots(rows, _COLUMNS, sharex=True, squeeze=False)).ravel()
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
    for ax in axes[max(0, len(found.sensors) - _COLUMNS) : len(found.sensors)]:
        ax.set_xlabel("s")
        ax.tick_params(labelbottom=True)
    with written_whole(path) as file:
        figure.savefig(file, dpi=80, format="png")
