"""`fusecap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import EXPORTS, Json, Unit, check_choice, console, print_json

EXAMPLE = "Example: fusecap export take.npz --format bvh --unit cm --out bvh"


def export(
    take: Annotated[
        Path, typer.Argument(help="A solved take (.npz), or the recording (.mcap) of a live run.")
    ],
    format: Annotated[str, typer.Option(help="bvh")] = "bvh",
    out: Annotated[Path | None, typer.Option(help="Folder; default: beside the take.")] = None,
    unit: Unit = "m",
    as_json: Json = False,
) -> None:
    """Write a take in another format, one file per person.

    Of a recording: the poses as they were sent in the run; fusecap solve makes better ones.
    """
    from fusecap.batch.replay import open_take
    from fusecap.export.bvh import export_bvh

    check_choice("--format", format, EXPORTS)
    check_choice("--unit", unit, ("m", "cm"))
    files = export_bvh(open_take(take), out or take.parent, stem=take.stem, unit=unit)
    if as_json:
        print_json({"files": [str(path) for path in files], "unit": unit})
    for path in files if not as_json else ():
        console.print(f"wrote {path} ({unit})", soft_wrap=True)
