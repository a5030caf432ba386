"""How the default weight of the orientation term was chosen: on training takes, never on test ones.

Not an experiment of the paper, which tuned its weights on 200 frames of one take. Bodies and motion
are those of the twin's training split, which shares nothing with the sequences of the other tables.
"""

from __future__ import annotations

from fusecap.evaluate.cells import TwinCell
from fusecap.evaluate.experiments.experiment import Experiment, Report, Results, Settings
from fusecap.evaluate.tables import Table, Value
from fusecap.evaluate.twin import twin_training_sequences

INPUTS = ((8, 13), (3, 6), (1, 13), (0, 13))
WEIGHTS = (1.0, 3.0, 10.0, 20.0, 30.0, 100.0)
_METRICS = {"aligned_error_mm": "position, aligned mm", "orientation_error_deg": "orientation deg"}


def _row(settings: Settings, cameras: int, imus: int, weight: float) -> list[TwinCell]:
    scenes = [sequence.key for sequence in twin_training_sequences()]
    return [
        settings.cell(scene, cameras=cameras, imus=imus, weights={"orientation": weight})
        for scene in (scenes[:2] if settings.quick else scenes)
    ]


def _weights(settings: Settings) -> tuple[float, ...]:
    return (1.0, 20.0) if settings.quick else WEIGHTS


def cells(settings: Settings) -> list[TwinCell]:
    rows = [_row(settings, *given, weight) for given in INPUTS for weight in _weights(settings)]
    return [cell for sequence in zip(*rows, strict=True) for cell in sequence]


def report(settings: Settings, results: Results) -> Report:
    return Report(tables=tuple(_table(settings, results, metric) for metric in _METRICS))


def _table(settings: Settings, results: Results, metric: str) -> Table:
    rows: list[tuple[Value, ...]] = []
    for cameras, imus in INPUTS:
        means = [
            results.spread(_row(settings, cameras, imus, weight), "score", metric).mean
            for weight in _weights(settings)
        ]
        rows.append((f"{cameras} camera{'s' * (cameras != 1)}, {imus} IMUs", *means))
    return Table(
        title=f"Training takes, weight of E_R: {_METRICS[metric]}",
        columns=("input", *(f"{weight:g}" for weight in _weights(settings))),
        rows=tuple(rows),
        digits=2,
    )


TUNING = Experiment(
    name="tuning", title="Tuning: the orientation weight", cells=cells, report=report
)
