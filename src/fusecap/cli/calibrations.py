"""What calibration commands share: sources, reports, verdicts and the files they wrote."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import typer

from fusecap.calibrate.verdict import Verdict
from fusecap.cli.common import json_text
from fusecap.cli.terminal import console, err, styled
from fusecap.files import write_whole

_COLOURS = {Verdict.GOOD: "green", Verdict.USABLE: "yellow", Verdict.POOR: "red"}


def coloured(verdict: Verdict) -> tuple[str, str]:
    """A word and its style."""
    return str(verdict), _COLOURS[verdict]


def print_verdict(what: str, verdict: Verdict, advice: Iterable[str]) -> None:
    """The verdict on stdout, and on stderr what to do about one that is not good."""
    console.print(styled(what, ": ", coloured(verdict)))
    for remedy in advice:
        err.print(f"{what}: {remedy}", soft_wrap=True)


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
