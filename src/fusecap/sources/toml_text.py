"""The TOML files that one command writes and another reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fusecap.errors import InputError
from fusecap.inputs import SETTINGS, read_toml


def quoted(text: str) -> str:
    """A TOML string: JSON's escapes are TOML's, and DEL, which TOML alone forbids, is escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def read_written(path: Path, format: str, command: str) -> dict[str, Any]:
    """The keys of a file of this `format`, which `command` writes; raises `InputError`."""
    data = read_toml(path, SETTINGS)
    if data.get("format") != format:
        raise InputError(
            f'{path}: format is {data.get("format")!r}, expected "{format}"; write the file with: '
            f"{command}"
        )
    return data
