"""Figure 10: the floor term, with one camera and no IMU, and with more [1, sec. 4.1.3]."""

from __future__ import annotations

from matplotlib.figure import Figure

from fusecap.evaluate.cells import TwinCell
from fusecap.evaluate.experiments.experiment import (
    Claim,
    Experiment,
    Report,
    Results,
    Settings,
    below,
    both,
)
from fusecap.evaluate.tables import Table, Value

INPUTS = ((1, 0), (1, 13), (4, 0), (8, 13))
"""Cameras, IMUs."""
METRICS = {
    "position, global mm": ("score", "position_error_mm", "mean"),
    "position, Procrustes mm": ("score", "aligned_error_mm", "mean"),
    "orientation, global deg": ("score", "orientation_error_deg", "mean"),
}
BELOW = {
    "foot joints below the floor %": ("floor", "share"),
    "mean depth mm": ("floor", "mean_mm"),
    "worst depth mm": ("floor", "worst_mm"),
}


def _row(settings: Settings, cameras: int, imus: int, *, floor: bool) -> list[TwinCell]:
    changes = {} if floor else {"weights": {"floor": 0.0}}
    return [
        settings.cell(scene, cameras=cameras, imus=imus, **changes) for scene in settings.sequences
    ]


def cells(settings: Settings) -> list[TwinCell]:
    rows = [_row(settings, *given, floor=on) for given in INPUTS for on in (True, False)]
    return [cell for sequence in zip(*rows, strict=True) for cell in sequence]


def report(settings: Settings, results: Results) -> Report:
    rows: list[tuple[Value, ...]] = []
    values: dict[tuple[int, int, bool], dict[str, float]] = {}
    for cameras, imus in INPUTS:
        for on in (True, False):
            chosen = _row(settings, cameras, imus, floor=on)
            found = {n: results.mean(chosen, *path) for n, path in (METRICS | BELOW).items()}
            found["foot joints below the floor %"] *= 100
            values[cameras, imus, on] = found
            views = f"{cameras} camera{'s' * (cameras > 1)}"
            rows.append((f"{views}, {imus} IMUs", "on" if on else "off", *found.values()))
    with_floor, without = values[1, 0, True], values[1, 0, False]
    deep, place = "mean depth mm", "position, Procrustes mm"
    return Report(
        tables=(
            Table(
                title="Figure 10: the floor term",
                columns=("input", "floor term", *METRICS, *BELOW),
                rows=tuple(rows),
                note="Ankle and toe joint centres below y = 0; the truth has none there.",
            ),
        ),
        findings=(
            Claim(
                statement="With one camera the floor term keeps the feet from going through the "
                "floor (mean depth at most a third)",
                evidence=f"{with_floor[deep]:.2f} mm with it, {without[deep]:.2f} mm without",
                holds=below(with_floor[deep], without[deep], 1 / 3),
            ),
            Claim(
                statement="It hardly changes the position error (less than 5 %)",
                evidence=f"{with_floor[place]:.1f} mm with it, {without[place]:.1f} mm without",
                holds=both(below(abs(with_floor[place] / without[place] - 1), 0.05)),
            ),
        ),
        plots={"": _plot(values)},
    )


def _plot(values: dict[tuple[int, int, bool], dict[str, float]]) -> Figure:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    names = [f"{c} cam, {i} IMU" for c, i in INPUTS]
    for ax, metric in zip(
        figure.subplots(1, 2), ("mean depth mm", "position, Procrustes mm"), strict=True
    ):
        for shift, on in ((-0.2, True), (0.2, False)):
            ax.bar(
                [x + shift for x in range(len(INPUTS))],
                [values[c, i, on][metric] for c, i in INPUTS],
                0.38,
                label=f"floor term {'on' if on else 'off'}",
            )
        ax.set_xticks(range(len(INPUTS)), names)
        ax.set_ylabel(metric)
    figure.axes[0].legend()
    return figure


FIGURE10 = Experiment(
    name="figure10", title="Figure 10: the floor term", cells=cells, report=report
)
