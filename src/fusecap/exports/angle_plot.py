"""Pictures of joint angles: over time with one standard deviation, and over the gait cycle."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusecap.angles.gait import PERCENT, GaitCycles
from fusecap.angles.joint_angles import JointAngles
from fusecap.angles.joints import JOINTS
from fusecap.files import write_picture

_COLOURS = {"left": "C0", "right": "C3", "": "C2"}


def plot_angles(angles: JointAngles, subject: int, path: Path) -> None:
    """One person's angles, a row per joint, as a PNG; bands are one standard deviation."""
    joints = [j for j in JOINTS if any(_kind(n).startswith(f"{j.name}_") for n in angles.names)]
    figure = Figure(figsize=(15, 2.3 * len(joints)), layout="constrained")
    axes = figure.subplots(len(joints), 3, squeeze=False, sharex=True)
    for row, joint in zip(axes, joints, strict=True):
        for ax, angle in zip(row, joint.angles, strict=True):
            _dress(ax, f"{joint.name} {angle}")
            for side, colour in _COLOURS.items():
                name = f"{side}_{joint.name}_{angle}".removeprefix("_")
                if name in angles.names:
                    curves = angles.curve(angles.subject_names[subject], name)
                    _band(ax, angles.time_s, *curves, colour, side or "middle")
    axes[0, 0].legend(loc="upper right", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("s")
    write_picture(figure, path)


def plot_gait(sides: Sequence[GaitCycles], path: Path) -> None:
    """One person's legs over the cycle as a PNG; bands are one standard deviation over cycles."""
    kinds = [_kind(name) for name in sides[0].names]
    figure = Figure(figsize=(15, 2.8 * (len(kinds) // 3)), layout="constrained")
    axes = figure.subplots(len(kinds) // 3, 3, squeeze=False, sharex=True)
    for column, (ax, kind) in enumerate(zip(axes.flat, kinds, strict=True)):
        _dress(ax, kind.replace("_", " "))
        for gait in sides:
            mean, band = gait.mean_deg[:, column], gait.band_deg[:, column]
            label = f"{gait.side}, {len(gait.deg)} cycles"
            _band(ax, PERCENT, mean, band, _COLOURS[gait.side], label)
    axes[0, 0].legend(loc="upper right", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("% of the cycle")
    write_picture(figure, path)


def _kind(name: str) -> str:
    """An angle's name without its side."""
    return name.removeprefix("left_").removeprefix("right_")


def _dress(ax: Axes, title: str) -> None:
    ax.set_title(title, fontsize=9)
    ax.set_ylabel("deg")
    ax.grid(alpha=0.3)


def _band(
    ax: Axes, x: np.ndarray, deg: np.ndarray, sd_deg: np.ndarray, colour: str, label: str
) -> None:
    ax.plot(x, deg, color=colour, linewidth=1.2, label=label)
    ax.fill_between(x, deg - sd_deg, deg + sd_deg, color=colour, alpha=0.2, linewidth=0)
