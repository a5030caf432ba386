"""`fusecap doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import console, progress, remark

EXAMPLE = "Example: fusecap doctor recordings/duo"


def doctor(
    session: Annotated[
        Path,
        typer.Argument(
            help="session.toml, the folder that holds it, or the recording (.mcap) of a live run.",
            show_default=False,
        ),
    ],
    as_json: Json = False,
) -> None:
    """Check a session before it is solved: what is wrong, and what to do about it.

    Of a recording: what is in it, how steadily its sources came, and whether it is whole.
    """
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
