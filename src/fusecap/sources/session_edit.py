"""What calibrations found is put into session.toml; comments, order and other keys stay."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import Table

from fusecap.files import write_whole
from fusecap.inputs import SESSION, read_text


def edit_session(
    path: Path,
    values: Mapping[str, str | None] | None = None,
    subjects: Mapping[str, Mapping[str, Any]] | None = None,
) -> bool:
    """Sets keys of [session], None taking one away, and of the [[subject]] of each name.

    Subjects that are not there are added. Returns whether the file had to change.
    """
    text = read_text(path, SESSION)
    document: Any = tomlkit.parse(text)
    for key, value in (values or {}).items():
        if value is None:
            document["session"].pop(key, None)
        else:
            _set(document["session"], key, value)
    stated = {str(table["name"]): table for table in document.get("subject", [])}
    for name, keys in (subjects or {}).items():
        if name not in stated:
            stated[name] = tomlkit.table()
            stated[name]["name"] = name
            stated[name].trivia.indent = "\n"
            document.setdefault("subject", tomlkit.aot()).append(stated[name])
        for key, value in keys.items():
            _set(stated[name], key, value)
    changed = tomlkit.dumps(document)
    if changed != text:
        write_whole(path, changed)
    return changed != text


def _set(table: Any, key: str, value: Any) -> None:
    """A new key stands after the last one, before blank lines and comments of what follows."""
    tail = []
    if isinstance(table, Table):
        body = table.value.body
        while body and body[-1][0] is None:
            tail.append(body.pop())
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        inline.update(value)
        value = inline
    table[key] = value
    if isinstance(table, Table):
        table.value.body.extend(reversed(tail))
