"""JSON whose top is an object."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fusecap.errors import CalibrationError


def load(path: Path) -> dict[str, Any]:
    """The object; raises `CalibrationError` for anything else."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise CalibrationError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(data, dict):
        raise CalibrationError(f"{path}: expected a JSON object, found a {type(data).__name__}")
    return data
