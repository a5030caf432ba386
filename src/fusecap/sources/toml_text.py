"""The TOML files that one command writes and another reads."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

from fusecap.errors import InputError


def quoted(text: str) -> str:
    """A TOML string: JSON's escapes are TOML's, and DEL, which TOML alone forbids, is escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def read_written(path: Path, format: str, command: str) -> dict[str, Any]:
    """The keys of a file of this `format`, which `command` writes; raises `InputError`."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    if data.get("format") != format:
        raise InputError(
            f'{path}: format is {data.get("format")!r}, expected "{format}"; write the file with: '
            f"{command}"
        )
    return data
