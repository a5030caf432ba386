"""`fusecap export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, Unit, check_choice, print_json
from fusecap.cli.terminal import console
from fusecap.export.formats import FORMATS

EXAMPLE = "Example: fusecap export take.npz --format bvh --unit cm --out bvh"
_FORMATS_HELP = "; ".join(f"{name}: {what}" for name, what in FORMATS.items())


def export(
    take: Annotated[
        Path, typer.Argument(help="A solved take (.npz), or the recording (.mcap) of a live run.")
    ],
    format: Annotated[str, typer.Option(help=_FORMATS_HELP)] = "bvh",
    out: Annotated[Path | None, typer.Option(help="Folder; default: beside the take.")] = None,
    unit: Unit = "m",
    as_json: Json = False,
) -> None:
    """Write a take in another format, one file per person.

    Of a recording: the poses as they were sent in the run; fusecap solve makes better ones.
    """
    from fusecap.batch.replay import open_take
    from fusecap.export.take_files import UNITS_PER_M, export_take

    check_choice("--format", format, tuple(FORMATS))
    check_choice("--unit", unit, tuple(UNITS_PER_M))
    files = export_take(
        open_take(take), out or take.parent, format=format, stem=take.stem, unit=unit
    )
    if as_json:
        print_json({"files": [str(path) for path in files], "unit": unit})
    for path in files if not as_json else ():
        console.print(f"wrote {path} ({unit})", soft_wrap=True)
