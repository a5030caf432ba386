"""Tables of results, as Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from fusecap.files import plain

Value = str | float | int | None
"""None and NaN are shown as a dash."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows under named columns; numbers are rounded for people only."""

    title: str
    columns: tuple[str, ...]
    """With their units."""
    rows: tuple[tuple[Value, ...], ...]
    note: str = ""
    digits: int = 1

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"table '{self.title}': {row} under {self.columns}")

    def markdown(self) -> str:
        """A heading, the table with numbers to the right, and its note."""
        numeric = [
            any(isinstance(row[c], int | float) for row in self.rows)
            for c in range(len(self.columns))
        ]
        lines = [f"### {self.title}", "", _row(self.columns)]
        lines.append(_row(["---:" if right else "---" for right in numeric]))
        lines += [_row([self.shown(value) for value in row]) for row in self.rows]
        if self.note:
            lines += ["", self.note]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """Comma-separated, full precision."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([["" if _missing(v) else v for v in row] for row in self.rows])
        return text.getvalue()

    def as_json(self) -> dict[str, Any]:
        """Title, note, columns, rows."""
        return {
            "title": self.title,
            "note": self.note,
            "columns": list(self.columns),
            "rows": plain(self.rows),
        }

    def shown(self, value: Value) -> str:
        """One value as people read it."""
        if _missing(value):
            return "–"
        return f"{value:.{self.digits}f}" if isinstance(value, float) else str(value)


def _row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"


def _missing(value: Value) -> bool:
    return value is None or (isinstance(value, float) and not math.isfinite(value))
