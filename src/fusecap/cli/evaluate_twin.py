"""`fusecap evaluate table1`, `figure7` and so on: the paper's experiments on the simulated twin.

One function serves them all, for they differ in nothing but their cells and what they report.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fusecap.cli.common import Json, check_choice, print_json
from fusecap.cli.terminal import cells_bar, console, err, remark, styled, table_of, wrote

if TYPE_CHECKING:
    from fusecap.evaluate.experiments.run import Evaluation
    from fusecap.evaluate.runner import Outcome

_HELP = {
    "table1": "Table 1 on the simulated twin: each sequence with 8 cameras and 13 IMUs.",
    "figure7": "Figure 7 on the simulated twin: 0-8 cameras with 0, 6 and 13 IMUs.",
    "table2": "Table 2 on the simulated twin: 6 IMUs alone; one camera with 13 IMUs.",
    "table3": "Table 3 on the simulated twin: each cost term off, fewer keypoints, offsets on.",
    "table4": "Table 4's protocol on the simulated twin: 4 cameras and one, no IMU.",
    "figure9": "Figure 9 on the simulated twin: the weight of the acceleration term.",
    "figure10": "Figure 10 on the simulated twin: the floor term on and off.",
    "tuning": "How the orientation weight was chosen, on the twin's training takes.",
    "motion": "Instants alone and together: live, 100 ms late, recorded.",
    "people": "Several people on the simulated twin: two, four, bystanders, close interaction.",
}
_COMMON = (
    "\n\nSimulated, and called so. Writes Markdown, CSV, JSON and plots; finished cells are kept "
    "in OUT/cells, so the same command goes on after a kill. Exit code 1 when a cell failed."
)


def add_to(app: typer.Typer) -> None:
    """Add a command per experiment to `fusecap evaluate`."""
    for name, text in _HELP.items():
        app.command(name, help=text + _COMMON, epilog=f"Example: fusecap evaluate {name} --quick")(
            _command(name)
        )


def _command(name: str) -> Callable[..., None]:
    def command(
        out: Annotated[Path, typer.Option(help="Folder for the report and the cells.")] = Path(
            "evaluation"
        ),
        sequences: Annotated[
            str | None, typer.Option(help="Such as 'S1 FS3,S2 FS1'; default: all eight.")
        ] = None,
        seed: Annotated[int, typer.Option(min=0, help="Of the simulated faults.")] = 0,
        weights: Annotated[
            str,
            typer.Option(
                help="default; alone: no term between instants; paper; no-acceleration: the "
                "paper's without that term."
            ),
        ] = "default",
        quick: Annotated[
            bool, typer.Option("--quick", help="Two sequences and fewer configurations.")
        ] = False,
        workers: Annotated[
            int | None, typer.Option(min=1, help="Processes; default: one per core.")
        ] = None,
        ray: Annotated[
            str | None,
            typer.Option(metavar="ADDRESS", help="Use Ray: 'local', 'auto' or host:port."),
        ] = None,
        as_json: Json = False,
    ) -> None:
        from fusecap.evaluate.experiments.experiment import WEIGHTS, settings
        from fusecap.evaluate.experiments.run import as_json as json_of
        from fusecap.evaluate.experiments.run import evaluate, write

        check_choice("--weights", weights, tuple(WEIGHTS))
        chosen = settings(sequences=sequences, seed=seed, quick=quick, weights=weights)
        with _Shown(quiet=as_json) as shown:
            try:
                evaluation = evaluate(
                    name,
                    chosen,
                    out,
                    command=f"fusecap {shlex.join(sys.argv[1:])}",
                    workers=workers,
                    ray=ray,
                    progress=shown.cell,
                )
            except KeyboardInterrupt:
                err.print(f"interrupted; {out / 'cells'} keeps what is done, run it again to go on")
                raise typer.Exit(130) from None
        files = write(evaluation, out)
        if as_json:
            print_json(json_of(evaluation) | {"files": [str(path) for path in files]})
        else:
            _print(evaluation, files)
        if evaluation.failures:
            raise typer.Exit(1)

    return command


def _print(evaluation: Evaluation, files: list[Path]) -> None:
    from fusecap.evaluate.experiments.run import described
    from fusecap.evaluate.twin import TWIN_VERSION

    title = (evaluation.experiment.title, "bold")
    console.print(styled(title, f": simulated twin v{TWIN_VERSION}"))
    for outcome in evaluation.failures:
        console.print(f"failed  {described(outcome.cell)}: {outcome.error}", soft_wrap=True)
    colours = {False: "red", None: "yellow", True: "green"}
    words = {False: "no ", None: "?  ", True: "yes"}
    for finding in evaluation.findings:
        word = words[finding.holds], colours[finding.holds]
        remark(word, f"{finding.statement}: {finding.evidence}", where=console)
    for table in evaluation.report.tables:
        shown = table_of(title=table.title, title_justify="left")
        for column in table.columns:
            shown.add_column(column, overflow="fold")
        for row in table.rows:
            shown.add_row(*[table.shown(value) for value in row])
        console.print(shown)
    wrote(*files)


class _Shown:
    """Cells as they end: a bar with ETA on a terminal, a line each in a log."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._started = time.monotonic()
        self._resumed = 0
        self._bar = cells_bar(quiet=quiet or not err.is_terminal)
        self._task = self._bar.add_task("cells", total=None, eta="-")

    def __enter__(self) -> _Shown:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def cell(self, outcome: Outcome, done: int, total: int) -> None:
        """Progress of the runner."""
        from fusecap.evaluate.experiments.run import described

        self._resumed += outcome.resumed
        solved = done - self._resumed
        left_s = (time.monotonic() - self._started) / max(solved, 1) * (total - done)
        eta = time.strftime("%H:%M:%S", time.gmtime(left_s)) if solved else "-"
        self._bar.update(self._task, completed=done, total=total, eta=eta)
        if self._quiet or err.is_terminal or outcome.resumed:
            return
        state = outcome.error or f"{outcome.elapsed_s:.1f} s"
        err.print(
            f"{done}/{total}  {described(outcome.cell)}: {state}, ETA {eta}",
            soft_wrap=True,
        )
