"""Stick figures of a take, drawn to be looked at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusecap.body.shape import end_offsets_m
from fusecap.files import write_picture
from fusecap.take import Take

_VIEWS = {
    "front (from +z)": (0, 1),
    "side (from -x)": (2, 1),
    "top": (0, 2),
}
"""Title to horizontal and vertical axis."""
_SIDE_WIDTH = {"left": 2.2, "right": 1.0}
"""The left side of a body is drawn thicker, so that mirrored poses are seen."""


def plot_take(take: Take, frames: Sequence[int], path: Path | str) -> None:
    """One row of front, side and top views per frame, a colour per subject, written as a PNG."""
    figure = Figure(figsize=(15, 4.6 * len(frames)), layout="constrained")
    axes = figure.subplots(len(frames), len(_VIEWS), squeeze=False)
    for row, frame in zip(axes, frames, strict=True):
        for ax, (title, view) in zip(row, _VIEWS.items(), strict=True):
            for subject, name in enumerate(take.subject_names):
                if take.tracked[subject, frame]:
                    _draw(ax, take, subject, frame, view, f"C{subject % 10}", name)
            _dress(ax, view, f"{take.time_s[frame]:.2f} s, {title}")
        if row[0].get_legend_handles_labels()[0]:
            row[0].legend(loc="upper right", fontsize=8)
    write_picture(figure, Path(path))


def _draw(
    ax: Axes,
    take: Take,
    subject: int,
    frame: int,
    view: tuple[int, int],
    colour: str,
    label: str,
) -> None:
    horizontal, vertical = view
    for index, (name, start, end) in enumerate(_sticks(take, subject, frame)):
        ax.plot(
            [start[horizontal], end[horizontal]],
            [start[vertical], end[vertical]],
            color=colour,
            linewidth=_SIDE_WIDTH.get(name.partition("_")[0], 1.6),
            solid_capstyle="round",
            label=label if index == 0 else None,
        )


def _sticks(
    take: Take, subject: int, frame: int
) -> list[tuple[str, Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Bone name, start and end in the world [m]: joint to parent joint, and the leaves' ends."""
    position = take.bone_position_in_world_m[subject, frame]
    rotation = take.bone_rotation_in_world(subject)[frame]
    sticks = [
        (take.bone_names[bone], position[parent], position[bone])
        for bone, parent in enumerate(take.parents)
        if parent >= 0
    ]
    for name, offset in end_offsets_m(take.shape(subject)).items():
        bone = take.bone_names.index(name)
        sticks.append((name, position[bone], position[bone] + rotation[bone] @ offset))
    return sticks


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
