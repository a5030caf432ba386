"""What commands share: JSON, choices, lengths, the files of a solve."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.cli.terminal import console, err, note, wrote
from fusecap.errors import TakeError, nearest
from fusecap.exports.formats import FORMATS
from fusecap.exports.rigs import PRESETS
from fusecap.files import plain

if TYPE_CHECKING:
    from fusecap.batch.solve import Solved
    from fusecap.exports.take_format import ExportOptions
    from fusecap.take import Take

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object for machines.")]
Unit = Annotated[
    str | None,
    typer.Option(help="Length unit of exports that have a choice: m, cm (engines), mm."),
]
RigName = Annotated[
    str, typer.Option("--rig", help="Names and rest pose of exported joints: " + ", ".join(PRESETS))
]
SessionPath = Annotated[
    Path, typer.Argument(help="session.toml, or the folder that holds it.", show_default=False)
]

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


def check_choice(option: str, value: str, known: tuple[str, ...]) -> None:
    """Misuse (exit code 2) that names the nearest known value."""
    if value not in known:
        raise typer.BadParameter(f"'{value}'{nearest(value, known)}", param_hint=option)


def length_m(option: str, text: str) -> float:
    """Metres; a number without a unit is misuse (exit code 2)."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(mm|cm|m|in)\s*", text)
    if match is None:
        raise typer.BadParameter(
            f"'{text}': expected a length with its unit, such as 40mm, 4cm, 0.04m or 1.5in",
            param_hint=option,
        )
    return float(match[1]) * _METRES[match[2]]


def named(option: str, text: str, expected: str) -> tuple[str, str]:
    """The two sides of NAME=VALUE; misuse without either."""
    name, equals, value = text.rpartition("=")
    if not (name and equals and value):
        raise typer.BadParameter(f"'{text}': expected {expected}", param_hint=option)
    return name, value


def format_names(option: str, text: str) -> list[str]:
    """The names of a comma-separated list, each checked."""
    names = list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    for name in names:
        check_choice(option, name, tuple(FORMATS))
    return names


@dataclass(frozen=True, slots=True, kw_only=True)
class Exports:
    """What a command was asked to write beside a take."""

    formats: list[str]
    unit: str | None = None
    rig: str = "native"
    options: ExportOptions | None = None


def write_take(
    take: Take, path: Path, exports: Exports, *, picture: bool, interrupted: bool = False
) -> list[Path]:
    """The take, its exports and its picture; exports of a take that stood there are set aside.

    What an `interrupted` solve has goes beside `path`, by names of its own: a whole take stays.
    """
    from fusecap.exports.take_files import export_all, set_aside
    from fusecap.take import load_take, save_take

    if interrupted:
        path = path.with_name(f"{path.stem}-interrupted{path.suffix}")
    try:
        earlier = load_take(path).subject_names
    except TakeError:
        earlier = ()
    save_take(take, path)
    files = [path]
    if exports.formats:
        files += export_all(
            take,
            path.parent,
            formats=exports.formats,
            stem=path.stem,
            unit=exports.unit,
            rig=exports.rig,
            options=exports.options,
        )
    for aside in set_aside(path.stem, path.parent, earlier, files):
        note(f"{aside.name} is of an earlier solve: renamed, and nothing of it was lost")
    frames = len(take.timestamps_ns)
    if picture and frames:
        from fusecap.exports.plot import plot_take

        image = path.with_suffix(".png")
        plot_take(take, sorted({0, frames // 3, 2 * frames // 3, frames - 1}), image)
        files.append(image)
    return files


def finish(solved: Solved, files: list[Path], as_json: bool) -> None:
    """Name the files; exit with 130 where the solve was interrupted."""
    if not as_json:
        wrote(*files)
    if solved.report.interrupted:
        err.print(
            "interrupted: these files hold what was solved until then; what was solved before "
            "stays where it is"
        )
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
