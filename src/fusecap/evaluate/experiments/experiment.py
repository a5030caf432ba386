"""What an experiment is: cells to solve, then tables, plots and findings made of their results.

settings ──cells()──▶ grid runner ──Results──▶ report() ──▶ Markdown, CSV, JSON, PNG
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from fusecap.errors import InputError, nearest
from fusecap.evaluate.cells import TwinCell
from fusecap.evaluate.runner import Outcome
from fusecap.evaluate.tables import Table, Value
from fusecap.evaluate.twin import twin_sequences
from fusecap.solve.options import Weights

WEIGHTS: Mapping[str, Weights] = {
    "default": Weights(),
    "alone": Weights().alone(),
    "no-acceleration": replace(Weights.paper(), acceleration=0.0),
    "paper": Weights.paper(),
}
"""The solver's own weights; the same with each instant alone; the paper's without its acceleration
term; the paper's as printed."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the user may choose."""

    sequences: tuple[str, ...]
    seed: int = 0
    quick: bool = False
    """Fewer sequences and configurations, to see that it runs."""
    weights: str = "default"

    def cell(self, scene: str, **changes: Any) -> TwinCell:
        """A cell of the twin under these settings; `weights=` changes single ones."""
        weights = asdict(WEIGHTS[self.weights]) | dict(changes.pop("weights", {}))
        return TwinCell(scene=scene, seed=self.seed, weights=weights, **changes)


def settings(
    *, sequences: str | None, seed: int, quick: bool, weights: str = "default"
) -> Settings:
    """Settings from the command line; raises `InputError` for an unknown sequence."""
    known = [sequence.key for sequence in twin_sequences()]
    chosen = [name.strip() for name in sequences.split(",")] if sequences else known
    for name in chosen:
        if name not in known:
            raise InputError(f"the twin has no sequence '{name}'{nearest(name, known)}")
    return Settings(
        sequences=tuple(chosen[:2] if quick else chosen), seed=seed, quick=quick, weights=weights
    )


@dataclass(frozen=True, kw_only=True)
class Claim:
    """Something the paper found, and whether the twin shows it."""

    statement: str
    evidence: str
    holds: bool | None
    """None: it could not be decided."""
    why: str = ""
    """What is known about the reason where it does not hold."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """What an experiment says."""

    tables: tuple[Table, ...]
    findings: tuple[Claim, ...] = ()
    plots: Mapping[str, Figure] = field(default_factory=dict)
    """By the end of their file names."""


class Results:
    """Results by cell; a failed cell has none."""

    def __init__(self, outcomes: Iterable[Outcome]) -> None:
        self._by_cell = {repr(outcome.cell): outcome.result for outcome in outcomes}

    def of(self, cell: TwinCell) -> dict[str, Any] | None:
        """What came of one cell; None where it failed."""
        return self._by_cell.get(repr(cell))

    def mean(self, cells: Iterable[TwinCell], *path: str) -> float:
        """Mean of one number over the cells that have it, e.g. "score", "idf1"."""
        return mean([number(self.of(cell), *path) for cell in cells])

    def spread(self, cells: Iterable[TwinCell], *path: str) -> Spread:
        """A `Summary` pooled over cells of equal length, e.g. "score", "position_error_mm"."""
        each = [
            [number(self.of(cell), *path, part) for part in ("mean", "std", "median", "mad")]
            for cell in cells
        ]
        means, std, median, mad = (np.array(column) for column in zip(*each, strict=True))
        pooled = mean(means)
        return Spread(
            mean=pooled,
            std=math.sqrt(max(mean(std**2 + means**2) - pooled**2, 0.0)),
            median=mean(median),
            mad=mean(mad),
            across=float(np.nanstd(means)) if np.isfinite(means).any() else math.nan,
        )


@dataclass(frozen=True, kw_only=True)
class Spread:
    """Errors over several sequences."""

    mean: float
    std: float
    """Over all bones and frames."""
    median: float
    """Mean of the sequences' medians; so is `mad`."""
    mad: float
    across: float
    """Standard deviation of the sequences' means."""


def number(result: Any, *path: str) -> float:
    """The number at a path of names in a result; NaN where it is missing."""
    for name in path:
        result = result.get(name) if isinstance(result, Mapping) else None
    return float(result) if isinstance(result, int | float) else math.nan


def with_spread(value: float, spread: float) -> str | None:
    """Such as "26.1 (9.3)"; None where it is unknown."""
    return f"{value:.1f} ({spread:.1f})" if math.isfinite(value + spread) else None


def mean(values: Sequence[float] | np.ndarray) -> float:
    """Over the values that are numbers; NaN where none is."""
    known = np.array(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) else math.nan


def below(small: float, large: float, factor: float = 1.0) -> bool | None:
    """Whether `small` < `factor` x `large`; None where either is unknown."""
    return small < factor * large if math.isfinite(small + large) else None


def both(*facts: bool | None) -> bool | None:
    """Whether all hold; None where one that matters is unknown."""
    if False in facts:
        return False
    return None if None in facts else True


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One of the paper's tables or figures."""

    name: str
    title: str
    cells: Callable[[Settings], list[TwinCell]]
    report: Callable[[Settings, Results], Report]


def bars(table: Table) -> Figure:
    """A table for experiments that draw nothing of their own: left mm, right degrees.

    One group per row, one bar per column; a value such as "26.1 (9.3)" is drawn as 26.1.
    """
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
