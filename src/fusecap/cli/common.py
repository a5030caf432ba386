"""What commands share: JSON, choices, lengths, the files of a solve."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fusecap.body.rigs import PRESETS
from fusecap.cli.terminal import console, err, note, wrote
from fusecap.errors import nearest
from fusecap.exports.formats import FORMATS
from fusecap.files import plain

if TYPE_CHECKING:
    from fusecap.batch.solve import Solved
    from fusecap.exports.take_files import TakeFile
    from fusecap.exports.take_format import ExportOptions
    from fusecap.stored_take import StoredTake

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


def named_once(option: str, texts: Iterable[str] | None, expected: str) -> dict[str, str]:
    """Values by names of a repeated NAME=VALUE; a name that comes twice is misuse."""
    found: dict[str, str] = {}
    for text in texts or ():
        name, value = named(option, text, expected)
        if name in found:
            raise typer.BadParameter(
                f"'{name}' is both '{found[name]}' and '{value}'", param_hint=option
            )
        found[name] = value
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Exports:
    """What a command was asked to write beside a take."""

    formats: list[str]
    unit: str | None = None
    rig: str = "native"
    options: ExportOptions | None = None

    def planned(self, take: StoredTake, path: Path, folder: Path | None = None) -> list[TakeFile]:
        """What to write of the take at `path`; beside it unless told."""
        from fusecap.exports.made_files import made_stem
        from fusecap.exports.take_files import plan_files

        return plan_files(
            take,
            folder or path.parent,
            formats=self.formats,
            stem=made_stem(path),
            unit=self.unit,
            rig=self.rig,
            options=self.options,
        )


def checked_exports(option: str, text: str, unit: str | None, rig: str) -> Exports:
    """Of a comma-separated list of formats, checked before any work, with the libraries they need.

    Names that are not known are misuse (exit code 2); the rest raises `InputError`.
    """
    from fusecap.exports.take_files import check_formats
    from fusecap.exports.take_format import UNITS_PER_M

    names = list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    for name in names:
        check_choice(option, name, tuple(FORMATS))
    if unit is not None:
        check_choice("--unit", unit, tuple(UNITS_PER_M))
    check_choice("--rig", rig, tuple(PRESETS))
    check_formats(names, unit=unit, rig=rig)
    return Exports(formats=names, unit=unit, rig=rig)


def write_take(solved: Solved, path: Path, exports: Exports, *, picture: bool) -> list[Path]:
    """The take, its exports and its picture; what was made of a take that stood there is set aside.

    Only once the take is written: where that fails, all stays. The take's provenance holds the
    solve's report. What an interrupted solve has goes beside `path`, by names of its own: a whole
    take stays.
    """
    from fusecap.exports.made_files import list_made
    from fusecap.exports.take_files import held_poses
    from fusecap.stored_take import StoredTake

    if solved.report.interrupted:
        path = path.with_name(f"{path.stem}-interrupted{path.suffix}")
    solved.save(path)
    files = [path]
    frames = solved.report.instants
    image = path.with_suffix(".png")
    try:
        with StoredTake(path) as take:
            planned = exports.planned(take, path)
            for file in planned:
                file.write(take)
                files.append(file.path)
                list_made(path, files)
            if picture and frames:
                from fusecap.exports.plot import plot_take

                plot_take(take, sorted({0, frames // 3, 2 * frames // 3, frames - 1}), image)
                files.append(image)
            for text in held_poses(take, planned):
                note(text)
    finally:
        set_aside_earlier(path, files)
    return files


def set_aside_earlier(take: Path, files: Iterable[Path]) -> None:
    """After a take was written: of what is listed as made from it, `files` are; others go aside."""
    from fusecap.exports.made_files import set_aside_others

    for aside in set_aside_others(take, files):
        note(f"{aside.name} is of an earlier take: renamed, and nothing of it was lost")


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
