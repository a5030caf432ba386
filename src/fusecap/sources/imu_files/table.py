"""Delimited text with a header line, as most IMU software exports it, and its sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusecap.errors import InputError, nearest
from fusecap.inputs import SENSORS, read_text


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuTable:
    """Columns by name, and the lines that came before their header."""

    path: Path
    preamble: tuple[str, ...]
    columns: tuple[str, ...]
    rows: np.ndarray
    """(N, columns); NaN for empty or unreadable cells and for what a cut-off last line lacks."""

    def has(self, names: Sequence[str]) -> bool:
        """Whether all these columns exist."""
        return all(name in self.columns for name in names)

    def take(self, names: Sequence[str]) -> np.ndarray:
        """(N, len(names)); raises `InputError` for a missing column."""
        for name in names:
            if name not in self.columns:
                raise InputError(f"{self.path}: no column '{name}'{nearest(name, self.columns)}")
        return self.rows[:, [self.columns.index(name) for name in names]]

    def take_or_nan(self, names: Sequence[str]) -> np.ndarray:
        """`take`, or NaN when a column is missing."""
        if not self.has(names):
            return np.full((len(self.rows), len(names)), np.nan)
        return self.take(names)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file; raises `InputError`."""
    return read_text(path, SENSORS, strict=False).splitlines()


def read_table(path: Path, first_column: str, *, units_line: bool = False) -> ImuTable:
    """The table whose header line starts with `first_column`; tabs, commas or semicolons.

    Raises `InputError` when there is no such header or no row under it.
    """
    lines = read_lines(path)
    headers = (i for i, line in enumerate(lines) if line.lstrip().startswith(first_column))
    index = next(headers, None)
    if index is None:
        raise InputError(
            f"{path}: no header line that starts with '{first_column}'; "
            "check that the file is of the stated format"
        )
    delimiter = max("\t,;", key=lines[index].count)
    columns = tuple(cell.strip() for cell in lines[index].split(delimiter))
    body = lines[index + 1 + units_line :]
    rows = [_numbers(line.split(delimiter), len(columns)) for line in body if line.strip()]
    if not rows:
        raise InputError(f"{path}: no samples below the header; export the recording again")
    return ImuTable(path=path, preamble=tuple(lines[:index]), columns=columns, rows=np.array(rows))


def _numbers(cells: list[str], count: int) -> list[float]:
    values = [number(cell) for cell in cells[:count]]
    return values + [float("nan")] * (count - len(values))


def number(cell: str) -> float:
    """The cell's value; NaN where it is none."""
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def chosen(path: Path, wanted: str | None, present: Sequence[str]) -> str:
    """The wanted sensor, or the only one; raises `InputError` naming those present."""
    if wanted is None:
        if len(present) == 1:
            return present[0]
        raise InputError(
            f"{path}: holds {len(present)} sensors ({', '.join(present)}); give sensor of this imu"
        )
    if wanted not in present:
        raise InputError(f"{path}: no sensor '{wanted}'{nearest(wanted, present)}")
    return wanted
