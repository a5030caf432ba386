"""What commands share: consoles, JSON, progress, choices, the files of a solve."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from fusecap.errors import nearest
from fusecap.files import plain

if TYPE_CHECKING:
    from fusecap.batch.solve import Solved
    from fusecap.progress import Progress
    from fusecap.take import Take

err = Console(stderr=True, highlight=False, emoji=False)
console = Console(highlight=False, emoji=False)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
Unit = Annotated[str, typer.Option(help="Length unit of exports: m (Blender) or cm (engines).")]
SessionPath = Annotated[
    Path, typer.Argument(help="session.toml, or the folder that holds it.", show_default=False)
]


def check_choice(option: str, value: str, known: tuple[str, ...]) -> None:
    """Misuse (exit code 2) that names the nearest known value."""
    if value not in known:
        raise typer.BadParameter(f"'{value}'{nearest(value, known)}", param_hint=option)


@contextmanager
def progress(*, quiet: bool, rate: bool = False) -> Iterator[Progress]:
    """A bar with ETA on stderr, one per kind of work; silent with --json.

    With `rate` it also shows how many are done per second.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bars

    class Rate(ProgressColumn):
        def render(self, task: Task) -> str:
            return f"{task.speed:.1f}/s" if task.speed else ""

    columns = (
        TextColumn("{task.description:<28.28}"),
        BarColumn(),
        MofNCompleteColumn(),
        *((Rate(),) if rate else ()),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=err, disable=quiet, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def show(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield show


def write_take(
    take: Take, path: Path, *, exports: list[str], unit: str, picture: bool
) -> list[Path]:
    from fusecap.export.take_files import export_take
    from fusecap.take import save_take

    save_take(take, path)
    files = [path]
    for format in exports:
        files += export_take(take, path.parent, format=format, stem=path.stem, unit=unit)
    frames = len(take.timestamps_ns)
    if picture and frames:
        from fusecap.export.plot import plot_take

        image = path.with_suffix(".png")
        plot_take(take, sorted({0, frames // 3, 2 * frames // 3, frames - 1}), image)
        files.append(image)
    return files


def finish(solved: Solved, files: list[Path], as_json: bool) -> None:
    """Name the files; exit with 130 where the solve was interrupted."""
    if not as_json:
        for path in files:
            console.print(f"wrote {path}", soft_wrap=True)
    if solved.report.interrupted:
        err.print("interrupted: the files hold what was solved until then")
        raise typer.Exit(130)


def print_speed(solved: Solved) -> None:
    report = solved.report
    console.print(
        f"  solve              {report.solve_ms_median:.2f} ms median, "
        f"{report.solve_ms_p99:.2f} ms p99, {report.solves} solves; "
        f"{report.elapsed_s:.1f} s in all"
    )


def json_text(value: dict[str, Any]) -> str:
    """What `--json` prints and report files hold."""
    return json.dumps(plain(value), indent=2)


def print_json(value: dict[str, Any]) -> None:
    typer.echo(json_text(value))
