"""A table as bars, for experiments that draw nothing of their own: left mm, right degrees."""

from __future__ import annotations

import math

from matplotlib.figure import Figure

from fusecap.evaluate.tables import Table, Value


def bars(table: Table) -> Figure:
    """One group per row, one bar per column; a value such as "26.1 (9.3)" is drawn as 26.1."""
    names = [str(row[0]) for row in table.rows]
    figure = Figure(figsize=(13, 1.2 + 0.55 * len(names)), layout="constrained")
    for ax, unit in zip(figure.subplots(1, 2, sharey=True), ("mm", "deg"), strict=True):
        columns = [
            c for c, name in enumerate(table.columns) if unit in name.replace(",", " ").split()
        ]
        height = 0.8 / max(len(columns), 1)
        for place, column in enumerate(columns):
            ax.barh(
                [y - 0.4 + height * (place + 0.5) for y in range(len(names))],
                [_number(row[column]) for row in table.rows],
                0.9 * height,
                label=table.columns[column],
            )
        ax.set_yticks(range(len(names)), names)
        ax.set_xlabel(unit)
        if columns:
            ax.legend(fontsize=8, loc="lower right")
    figure.axes[0].invert_yaxis()
    return figure


def _number(value: Value) -> float:
    try:
        return float(str(value).split()[0])
    except ValueError:
        return math.nan
