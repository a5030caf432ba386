"""How the default weight of the orientation term was chosen: on training takes, never on test ones.

Not an experiment of the paper, which tuned its weights on 200 frames of one take. Bodies and motion
are those of the twin's training split, which shares nothing with the sequences of the other tables.
"""

from __future__ import annotations

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
from fusecap.evaluate.twin import twin_training_sequences
from fusecap.solve.options import Weights

INPUTS = ((8, 13), (3, 6), (1, 13), (0, 13))
DEFAULT = Weights().orientation
WEIGHTS = (1.0, 3.0, 10.0, 20.0, 30.0, 100.0)
_METRICS = {"aligned_error_mm": "position, aligned mm", "orientation_error_deg": "orientation deg"}


def _row(settings: Settings, cameras: int, imus: int, weight: float) -> list[TwinCell]:
    scenes = [sequence.key for sequence in twin_training_sequences()]
    return [
        settings.cell(scene, cameras=cameras, imus=imus, weights={"orientation": weight})
        for scene in (scenes[:2] if settings.quick else scenes)
    ]


def _weights(settings: Settings) -> tuple[float, ...]:
    return (1.0, DEFAULT) if settings.quick else WEIGHTS


def cells(settings: Settings) -> list[TwinCell]:
    rows = [_row(settings, *given, weight) for given in INPUTS for weight in _weights(settings)]
    return [cell for sequence in zip(*rows, strict=True) for cell in sequence]


def report(settings: Settings, results: Results) -> Report:
    return Report(
        tables=tuple(_table(settings, results, metric) for metric in _METRICS),
        findings=tuple(_finding(settings, results, *given) for given in INPUTS),
    )


def _finding(settings: Settings, results: Results, cameras: int, imus: int) -> Claim:
    printed, ours = (
        [results.spread(_row(settings, cameras, imus, w), "score", m).mean for m in _METRICS]
        for w in (1.0, DEFAULT)
    )
    return Claim(
        statement=f"{_named(cameras, imus)}: a weight of {DEFAULT:g} errs less than the printed 1",
        evidence=f"aligned {ours[0]:.1f} mm, {ours[1]:.1f} deg against {printed[0]:.1f} mm, "
        f"{printed[1]:.1f} deg",
        holds=both(below(ours[0], printed[0]), below(ours[1], printed[1])),
    )


def _named(cameras: int, imus: int) -> str:
    return f"{cameras} camera{'s' * (cameras != 1)}, {imus} IMUs"


def _table(settings: Settings, results: Results, metric: str) -> Table:
    rows: list[tuple[Value, ...]] = []
    for cameras, imus in INPUTS:
        means = [
            results.spread(_row(settings, cameras, imus, weight), "score", metric).mean
            for weight in _weights(settings)
        ]
        rows.append((_named(cameras, imus), *means))
    return Table(
        title=f"Training takes, weight of E_R: {_METRICS[metric]}",
        columns=("input", *(f"{weight:g}" for weight in _weights(settings))),
        rows=tuple(rows),
        digits=2,
    )


TUNING = Experiment(
    name="tuning", title="Tuning: the orientation weight", cells=cells, report=report
)
