"""From an experiment's name to its files: cells through the runner, the report to a folder."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from fusecap.evaluate.cells import solve_cell
from fusecap.evaluate.code_version import code_version
from fusecap.evaluate.experiments.experiment import (
    Claim,
    Experiment,
    Report,
    Results,
    Settings,
    bars,
)
from fusecap.evaluate.experiments.figure7 import FIGURE7
from fusecap.evaluate.experiments.figure9 import FIGURE9
from fusecap.evaluate.experiments.figure10 import FIGURE10
from fusecap.evaluate.experiments.motion import MOTION
from fusecap.evaluate.experiments.people import PEOPLE
from fusecap.evaluate.experiments.table1 import TABLE1
from fusecap.evaluate.experiments.table2 import TABLE2
from fusecap.evaluate.experiments.table3 import TABLE3
from fusecap.evaluate.experiments.table4 import TABLE4
from fusecap.evaluate.experiments.tuning import TUNING
from fusecap.evaluate.runner import OnOutcome, Outcome, run_cells
from fusecap.evaluate.twin import TWIN_VERSION
from fusecap.files import plain, written_whole

EXPERIMENTS = {
    each.name: each
    for each in (TABLE1, FIGURE7, TABLE2, TABLE3, TABLE4, FIGURE9, FIGURE10, PEOPLE, TUNING, MOTION)
}
_HOLDS = {False: "does NOT hold", None: "undecided", True: "holds"}


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A finished experiment."""

    experiment: Experiment
    settings: Settings
    report: Report
    outcomes: tuple[Outcome, ...]
    command: str

    @property
    def failures(self) -> list[Outcome]:
        """Cells that have no result."""
        return [outcome for outcome in self.outcomes if outcome.result is None]

    @property
    def findings(self) -> list[Claim]:
        """Bad news first."""
        return sorted(self.report.findings, key=lambda f: (False, None, True).index(f.holds))


def evaluate(
    name: str,
    settings: Settings,
    out: Path,
    *,
    command: str = "",
    workers: int | None = None,
    ray: str | None = None,
    progress: OnOutcome | None = None,
) -> Evaluation:
    """Run experiment `name`; cells already in `out`/cells are not solved again."""
    experiment = EXPERIMENTS[name]
    outcomes = run_cells(
        experiment.cells(settings),
        solve_cell,
        folder=out / "cells",
        versions={"twin": TWIN_VERSION},
        workers=workers,
        ray=ray,
        progress=progress,
    )
    return Evaluation(
        experiment=experiment,
        settings=settings,
        report=experiment.report(settings, Results(outcomes)),
        outcomes=tuple(outcomes),
        command=command,
    )


def write(evaluation: Evaluation, out: Path) -> list[Path]:
    """Markdown, JSON, one CSV per table and the plots; returns their paths."""
    name = evaluation.experiment.name
    files: dict[str, bytes] = {
        f"{name}.md": markdown(evaluation).encode(),
        f"{name}.json": json.dumps(as_json(evaluation), indent=1).encode(),
    }
    tables = evaluation.report.tables
    plots = evaluation.report.plots or {"": bars(tables[0])}
    for index, table in enumerate(tables):
        part = f"_{index + 1}" if len(tables) > 1 else ""
        files[f"{name}{part}.csv"] = table.csv().encode()
    for part, figure in plots.items():
        png = io.BytesIO()
        figure.suptitle(f"{evaluation.experiment.title} (simulated twin v{TWIN_VERSION})")
        figure.savefig(png, dpi=80, format="png")
        files[f"{name}{part}.png"] = png.getvalue()
    for file_name, content in files.items():
        with written_whole(out / file_name) as file:
            file.write(content)
    return [out / file_name for file_name in files]


def markdown(evaluation: Evaluation) -> str:
    """The whole report, what fell short first."""
    settings = evaluation.settings
    scenes = dict.fromkeys(cell.scene for cell in evaluation.experiment.cells(settings))
    lines = [
        f"## {evaluation.experiment.title}: simulated twin v{TWIN_VERSION}",
        "",
        f"`{evaluation.command}`, {datetime.now(UTC):%Y-%m-%d}, "
        f"fusecap {code_version(solve_cell)}, seed {settings.seed}, weights: {settings.weights}, "
        f"scenes: {', '.join(scenes)}."
        " **Simulated**: no camera, sensor or person was there; see docs/simulation.md.",
        "",
    ]
    for outcome in evaluation.failures:
        lines.append(f"- **Failed**: {described(outcome.cell)}: {outcome.error}")
    for finding in evaluation.findings:
        why = f" {finding.why}" if finding.why and not finding.holds else ""
        lines.append(
            f"- **{_HOLDS[finding.holds]}**: {finding.statement}. {finding.evidence}.{why}"
        )
    lines += ["", *[table.markdown() for table in evaluation.report.tables]]
    return "\n".join(lines)


def as_json(evaluation: Evaluation) -> dict[str, Any]:
    """The report for machines."""
    return plain(
        {
            "experiment": evaluation.experiment.name,
            "title": evaluation.experiment.title,
            "simulated": True,
            "twin_version": TWIN_VERSION,
            "code_version": code_version(solve_cell),
            "date": f"{datetime.now(UTC):%Y-%m-%d}",
            "command": evaluation.command,
            "settings": asdict(evaluation.settings),
            "findings": [asdict(finding) for finding in evaluation.findings],
            "tables": [table.as_json() for table in evaluation.report.tables],
            "failed": [
                {"cell": asdict(outcome.cell), "error": outcome.error}
                for outcome in evaluation.failures
            ],
            "cells": len(evaluation.outcomes),
            "work_s": sum(outcome.elapsed_s for outcome in evaluation.outcomes),
        }
    )


def described(cell: Any) -> str:
    """A cell in a few words: what differs from the default cell of its scene."""
    values = asdict(cell)
    scene = values.pop("scene")
    default = asdict(type(cell)(scene=scene))
    changed = []
    for key, value in values.items():
        usual = default[key]
        if value == usual:
            continue
        if isinstance(value, dict):
            inner = {k: v for k, v in value.items() if not usual or usual.get(k) != v}
            value = " ".join(f"{k}={v:g}" for k, v in inner.items()) if usual else "given"
        changed.append(f"{key}={value}")
    return ", ".join([scene, *changed])
