"""Stick figures of a take, drawn to be looked at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusecap.exports.stick_figures import Sticks, TakeSticks, passing
from fusecap.exports.take_format import AnyTake
from fusecap.files import write_picture

_VIEWS = {
    "front (from +z)": (0, 1),
    "side (from -x)": (2, 1),
    "top": (0, 2),
}
"""Title to horizontal and vertical axis."""
_LEFT_WIDTH, _WIDTH, _RIGHT_WIDTH = 2.2, 1.6, 1.0
"""The left side of a body is drawn thicker, so that mirrored poses are seen."""
_GREY = "0.65"
"""Of passers-by, and of bones that nothing measures."""


def plot_take(take: AnyTake, frames: Sequence[int], path: Path | str) -> None:
    """One row of front, side and top views per frame, a colour per subject, written as a PNG.

    Passers-by are grey, and do not widen a view; bones that nothing measures are dotted and grey.
    """
    figure = Figure(figsize=(15, 4.6 * len(frames)), layout="constrained")
    axes = figure.subplots(len(frames), len(_VIEWS), squeeze=False)
    figures, passes_by = TakeSticks(take), passing(take.tracked)
    order = np.argsort(passes_by, kind="stable").tolist()
    for row, frame in zip(axes, frames, strict=True):
        for ax, (title, view) in zip(row, _VIEWS.items(), strict=True):
            _dress(ax, view, f"{take.time_s[frame]:.2f} s, {title}")
            for subject in order:
                sticks = figures.at_frame(subject, frame)
                if sticks is not None:
                    if passes_by[subject]:
                        ax.autoscale_view()
                        ax.set_autoscale_on(False)
                    colour = _GREY if passes_by[subject] else f"C{subject % 10}"
                    _draw(ax, sticks, view, colour, take.subject_names[subject])
        if row[0].get_legend_handles_labels()[0]:
            row[0].legend(loc="upper right", fontsize=8)
    write_picture(figure, Path(path))


def _draw(ax: Axes, sticks: Sticks, view: tuple[int, int], colour: str, label: str) -> None:
    for row, (start, end) in enumerate(zip(sticks.start_m, sticks.end_m, strict=True)):
        horizontal, vertical = ([start[axis], end[axis]] for axis in view)
        width = _LEFT_WIDTH if sticks.left[row] else _RIGHT_WIDTH if sticks.right[row] else _WIDTH
        ax.plot(
            horizontal,
            vertical,
            color=colour if sticks.measured[row] else _GREY,
            linewidth=width,
            linestyle="-" if sticks.measured[row] else ":",
            label=label if row == 0 else None,
        )


def _dress(ax: Axes, view: tuple[int, int], title: str) -> None:
    horizontal, vertical = view
    names = "xyz"
    ax.set_title(title, fontsize=9)
    ax.set_xlabel(f"{names[horizontal]} [m]")
    ax.set_ylabel(f"{names[vertical]} [m]")
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(alpha=0.3)
    if vertical == 1:
        ax.axhline(0.0, color="0.5", linewidth=1)
    else:
        ax.invert_yaxis()
