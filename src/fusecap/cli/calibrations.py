"""What calibration commands share: sources, reports, verdicts and the files they wrote."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from fusecap.calibrate.verdict import Verdict
from fusecap.cli.common import json_text
from fusecap.cli.terminal import console, err, styled
from fusecap.files import check_writable, write_whole

Write = Annotated[
    bool,
    typer.Option("--write", help="Write beside the session, and make session.toml use the result."),
]
_COLOURS = {Verdict.GOOD: "green", Verdict.USABLE: "yellow", Verdict.POOR: "red"}


def coloured(verdict: Verdict) -> tuple[str, str]:
    """A word and its style."""
    return str(verdict), _COLOURS[verdict]


def print_verdict(what: str, verdict: Verdict, advice: Iterable[str]) -> None:
    """The verdict on stdout, and on stderr what to do about one that is not good."""
    console.print(styled(what, ": ", coloured(verdict)))
    for remedy in advice:
        err.print(f"{what}: {remedy}", soft_wrap=True)


def check_stated(out: Path | None, write: bool) -> None:
    """Before anything is read: misuse exits with 2; raises `TakeError` where `out` cannot be."""
    if write and out is not None:
        raise typer.BadParameter("give --out or --write, not both", param_hint="--out")
    if out is not None:
        check_writable(out)


def output_of(session: Path, out: Path | None, write: bool, name: str) -> Path:
    """Where a result goes: as stated, or called `name`, with --write beside the session file.

    Raises `TakeError` where nothing could be written.
    """
    if write:
        check_writable(session)
    path = session.parent / name if write else out or Path(name)
    check_writable(path)
    return path


def from_folder_of(session: Path, file: Path) -> str:
    """A file as the session names it: from its own folder, with forward slashes."""
    return Path(os.path.relpath(file.resolve(), session.resolve().parent)).as_posix()


def print_use(session: Path, write: bool, by_hand: str) -> None:
    """What makes a session use the result, or that it does."""
    console.print(
        f"{session} uses it now" if write else f"use it: {by_hand}; or run with --write",
        soft_wrap=True,
    )


def named_sources(sources: list[str]) -> dict[str, str]:
    """CAMERA=SOURCE arguments by camera; misuse exits with 2."""
    named: dict[str, str] = {}
    for text in sources:
        name, equals, source = text.partition("=")
        if not (equals and name and source):
            raise typer.BadParameter(
                f"'{text}': expected CAMERA=SOURCE, such as left=videos/left.mp4",
                param_hint="SOURCES",
            )
        if name in named:
            raise typer.BadParameter(f"camera '{name}' is given twice", param_hint="SOURCES")
        named[name] = source
    return named


def write_report(out: Path, report: dict[str, Any]) -> Path:
    """The report beside the calibration, as `<name>_report.json`."""
    path = out.with_name(f"{out.stem}_report.json")
    write_whole(path, json_text(report))
    return path
