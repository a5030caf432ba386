"""`fusecap doctor`."""

from __future__ import annotations

import typer

from fusecap.cli.common import Json, SessionPath, console, print_json, progress

EXAMPLE = "Example: fusecap doctor recordings/duo"


def doctor(
    session: SessionPath,
    as_json: Json = False,
) -> None:
    """Check a session before it is solved: what is wrong, and what to do about it."""
    from dataclasses import asdict

    from fusecap.doctor import diagnose

    with progress(quiet=as_json) as show:
        findings = diagnose(session, show)
    errors = sum(finding.severity == "error" for finding in findings)
    if as_json:
        print_json({"findings": [asdict(f) for f in findings], "errors": errors})
    else:
        colours = {"error": "red", "warning": "yellow", "info": "cyan"}
        for finding in findings:
            colour = colours[finding.severity]
            console.print(f"[{colour}]{finding.severity}[/] ", end="")
            console.print(f"{finding.where}: {finding.found}", markup=False, soft_wrap=True)
            if finding.remedy:
                console.print(f"  -> {finding.remedy}", markup=False, soft_wrap=True)
        summary = f"{len(findings)} findings, {errors} of them errors"
        console.print(summary if findings else "nothing is wrong")
    if errors:
        raise typer.Exit(1)
