"""Measured bone lengths with error bars, against what the stature says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fusecap.calibrate.shape import MeasuredBody
from fusecap.files import written_whole


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
    with written_whole(path) as file:
        figure.savefig(file, dpi=90, format="png")
