"""`fusecap doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.many import OnRay, Workers, is_pattern, is_session, matching, run_many
from fusecap.cli.terminal import console, progress, remark

EXAMPLE = "Example: fusecap doctor recordings/duo"


def doctor(
    session: Annotated[
        list[Path],
        typer.Argument(
            help="session.toml, the folder that holds it, or the recording (.mcap) of a live run; "
            "several, or a pattern in quotes.",
            show_default=False,
        ),
    ],
    workers: Workers = None,
    ray: OnRay = None,
    as_json: Json = False,
) -> None:
    """Check a session before it is solved: what is wrong, and what to do about it.

    Of a recording: what is in it, how steadily its sources came, and whether it is whole.
    """
    if not is_pattern(session):
        _diagnose_one(session[0], as_json=as_json)
        return
    run_many(
        "doctor",
        matching(session, wanted=is_session, what="session or recording"),
        {},
        columns=("errors", "warnings"),
        row=_row,
        lines=_lines,
        workers=workers,
        ray=ray,
        again=True,
        as_json=as_json,
        fails=lambda result: bool(result["errors"]),
    )


def _row(result: dict[str, Any]) -> list[str]:
    return [str(result["errors"]), str(len(_serious(result)) - result["errors"])]


def _lines(result: dict[str, Any]) -> list[str]:
    return [f"{each['severity']} {each['where']}: {each['found']}" for each in _serious(result)]


def _serious(result: dict[str, Any]) -> list[dict[str, Any]]:
    return [each for each in result["findings"] if each["severity"] != "info"]


def _diagnose_one(session: Path, *, as_json: bool) -> None:
    from dataclasses import asdict

    from fusecap.doctor import diagnose, diagnose_recording
    from fusecap.recording.layout import SUFFIX

    with progress(quiet=as_json) as show:
        check = diagnose_recording if session.suffix == SUFFIX else diagnose
        findings = check(session, show)
    errors = sum(finding.severity == "error" for finding in findings)
    if as_json:
        print_json({"findings": [asdict(f) for f in findings], "errors": errors})
    else:
        colours = {"error": "red", "warning": "yellow", "info": "cyan"}
        for finding in findings:
            word = finding.severity, colours[finding.severity]
            remark(word, f"{finding.where}: {finding.found}", where=console)
            if finding.remedy:
                console.print(f"  -> {finding.remedy}", soft_wrap=True)
        summary = f"{len(findings)} findings, {errors} of them errors"
        console.print(summary if findings else "nothing is wrong")
    if errors:
        raise typer.Exit(1)
