"""Held-out residuals of every camera before and after, drawn to be looked at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fusecap.calibrate.cameras.people import PeopleCalibration
from fusecap.files import written_whole

_COLUMNS = 6
"""Cameras in a row of the picture."""


def plot_residuals(found: PeopleCalibration, path: Path) -> None:
    """A pair of panels per camera on one scale: where keypoints lie from their landmark [px]."""
    pairs = list(found.residuals_px.items())
    columns = max(1, min(_COLUMNS, len(pairs)))
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
    with written_whole(path) as file:
        figure.savefig(file, dpi=90, format="png")
