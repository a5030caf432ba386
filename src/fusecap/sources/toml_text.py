"""Text as TOML writes it."""

from __future__ import annotations

import json


def quoted(text: str) -> str:
    """A TOML string: JSON's escapes are TOML's, and DEL, which TOML alone forbids, is escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
