"""Pictures of a synchronisation: how well every offset fits, and the signals on one clock."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusecap.calibrate.sync.clock_rows import ClockRow
from fusecap.calibrate.sync.curves import Curve
from fusecap.calibrate.sync.session import Synchronisation
from fusecap.files import write_picture

_CLOSE_UP_S = 3.0


def draw(found: Synchronisation, path: Path) -> None:
    """A PNG: a row per clock with its cost over the offset, then rows of signals laid together."""
    curves: list[tuple[ClockRow, Curve | None]] = []
    cameras = [row for row in found.rows if row.kind == "camera"]
    if found.cameras is not None:
        curves += list(zip(cameras, found.cameras.curves, strict=True))
    sensors = [row for row in found.rows if row.kind == "imu"]
    curves += [(row, clock.curve) for row, clock in zip(sensors, found.imus, strict=True)]
    signals = _signals(found, sensors)
    count = max(len(curves) + len(signals), 1)
    figure = Figure(figsize=(12, 2.3 * count), layout="constrained")
    axes = figure.subplots(count, 2, squeeze=False)
    for (row, curve), (whole, near) in zip(curves, axes, strict=False):
        _panel(whole, row, curve, None)
        _panel(near, row, curve, 0.5)
    if curves:
        axes[len(curves) - 1][0].set_xlabel("offset [s]")
        axes[len(curves) - 1][1].set_xlabel("offset [s], about the one found")
    for (title, unit, traces), pair in zip(signals, axes[len(curves) :], strict=False):
        for panel in pair:
            for label, (times_s, values) in traces.items():
                panel.plot(times_s, values, linewidth=1, label=label)
            panel.grid(alpha=0.3)
            panel.set_ylabel(unit)
            panel.set_title(title, size=9)
        middle_s = _liveliest_s(traces)
        pair[1].set_xlim(middle_s - _CLOSE_UP_S / 2, middle_s + _CLOSE_UP_S / 2)
        pair[1].legend(fontsize=7, loc="upper right")
    if signals:
        axes[-1][0].set_xlabel("session time [s]")
        axes[-1][1].set_xlabel("session time [s], where most moves")
    write_picture(figure, path)


Signals = tuple[str, str, dict[str, tuple[np.ndarray, np.ndarray]]]
"""Title, unit, and times and values by label."""


def _signals(found: Synchronisation, sensors: Sequence[ClockRow]) -> list[Signals]:
    result: list[Signals] = []
    if len(found.speeds) > 1:
        traces = {name: (speed[0], speed[1]) for name, speed in found.speeds.items()}
        result.append(("how fast people move in each camera", "extents/s", traces))
    for row, clock in zip(sensors, found.imus, strict=True):
        if clock.aligned is not None and row.offset_s is not None:
            times_s, bones, worn = clock.aligned
            traces = {"bones in the video": (times_s, bones), "sensors": (times_s, worn)}
            result.append((f"{row.name}: {_which(row)}, mean angular speed", "rad/s", traces))
    return result


def _which(row: ClockRow) -> str:
    return ", ".join(row.sensors) if len(row.sensors) < 4 else f"{len(row.sensors)} sensors"


def _liveliest_s(traces: dict[str, tuple[np.ndarray, np.ndarray]]) -> float:
    """The middle of the seconds with the largest mean of the first signal that covers them."""
    times_s, values = next(iter(traces.values()))
    step_s = float(np.median(np.diff(times_s)))
    width = max(1, min(len(values), round(_CLOSE_UP_S / step_s)))
    mean = np.convolve(np.nan_to_num(values), np.ones(width), mode="same")
    return float(times_s[int(np.argmax(mean))])


def _panel(axes: Axes, row: ClockRow, curve: Curve | None, about_s: float | None) -> None:
    label = row.name if row.kind == "camera" else f"{row.name}: {_which(row)}"
    title = f"{label} ({row.word})"
    axes.grid(alpha=0.3)
    axes.set_ylabel("misfit")
    if curve is None:
        axes.set_title(f"{title}: nothing to compare", size=9)
        return
    axes.plot(curve.shifts_s, curve.mean, color="C0", linewidth=1)
    for rival_s in row.rivals_s:
        axes.axvline(rival_s, color="C3", linestyle=":", linewidth=1)
    if row.offset_s is not None:
        axes.axvline(row.offset_s, color="C2", linewidth=1.2)
        title += f" {1e3 * row.offset_s:+.1f} ms"
        if row.error_s:
            title += f" ± {1e3 * row.error_s:.1f}"
            axes.axvspan(
                row.offset_s - row.error_s, row.offset_s + row.error_s, color="C2", alpha=0.2
            )
        if about_s is not None:
            axes.set_xlim(row.offset_s - about_s, row.offset_s + about_s)
            near = np.abs(curve.shifts_s - row.offset_s) <= about_s
            seen = curve.mean[near & np.isfinite(curve.mean)]
            if len(seen):
                axes.set_ylim(seen.min() - 0.02, seen.max() + 0.02)
    axes.set_title(title, size=9)
