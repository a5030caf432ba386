"""Pictures of a synchronisation: how well every offset fits, clock by clock."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusecap.calibrate.sync.curves import Curve
from fusecap.calibrate.sync.session import Row, Synchronisation
from fusecap.sinks.files import written_whole


def draw(found: Synchronisation, path: Path | str) -> None:
    """One panel per clock with its cost over the offset, written as a PNG."""
    curves: list[tuple[Row, Curve | None]] = []
    cameras = [row for row in found.rows if row.kind == "camera"]
    if found.cameras is not None:
        curves += list(zip(cameras, found.cameras.curves, strict=True))
    sensors = [row for row in found.rows if row.kind == "imu"]
    curves += [(row, clock.curve) for row, clock in zip(sensors, found.imus, strict=True)]
    figure = Figure(figsize=(12, 2.3 * max(len(curves), 1)), layout="constrained")
    axes = figure.subplots(max(len(curves), 1), 2, squeeze=False)
    for (row, curve), (whole, near) in zip(curves, axes, strict=False):
        _panel(whole, row, curve, None)
        _panel(near, row, curve, 0.5)
    if curves:
        axes[-1][0].set_xlabel("offset [s]")
        axes[-1][1].set_xlabel("offset [s], about the one found")
    png = io.BytesIO()
    figure.savefig(png, dpi=80, format="png")
    with written_whole(Path(path)) as file:
        file.write(png.getvalue())


def _panel(axes: Axes, row: Row, curve: Curve | None, about_s: float | None) -> None:
    label = row.name if row.kind == "camera" else f"{row.name}: {', '.join(row.sensors[:3])}"
    title = f"{label} ({row.verdict})"
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
