"""`fusecap init`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fusecap.cli.common import Json, print_json
from fusecap.cli.terminal import console

EXAMPLE = "Example: fusecap init recordings/duo, then: fusecap doctor recordings/duo"


def init(
    folder: Annotated[
        Path, typer.Argument(help="Holds videos, keypoints, sensor files.", show_default=False)
    ],
    as_json: Json = False,
) -> None:
    """Write a first session.toml from the videos, keypoints, calibration, sensors in a folder."""
    from fusecap.detect.detector import DEFAULT_MODEL, DEFAULT_PERSON_MODEL
    from fusecap.detect.model_store import networks_here
    from fusecap.errors import SessionError
    from fusecap.files import written_whole
    from fusecap.sources.folder_survey import survey
    from fusecap.sources.session import FILE_NAME
    from fusecap.sources.session_draft import draft

    target = folder / FILE_NAME
    if target.exists():
        raise SessionError(f"{target}: is there already; edit it, or move it away first")
    found = survey(folder)
    here = networks_here()
    usual = here == {"model": DEFAULT_MODEL, "person_model": DEFAULT_PERSON_MODEL}
    text = draft(found, {} if usual else here)
    with written_whole(target) as file:
        file.write(text.encode())
    if as_json:
        print_json(
            {
                "file": str(target),
                "videos": [str(path) for path in found.videos],
                "keypoints": {name: str(path) for name, path in found.keypoints.items()},
                "calibration": str(found.calibration) if found.calibration else None,
                "sensors": [f"{s.file} {s.sensor or ''}".strip() for s in found.sensors],
            }
        )
        return
    console.print(text, soft_wrap=True)
    console.print(f"wrote {target}; check it: fusecap doctor {folder}", soft_wrap=True)
