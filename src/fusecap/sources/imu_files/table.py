"""Delimited text with a header line, as most IMU software exports it, and its sensors."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fusecap.errors import InputError, nearest
from fusecap.inputs import SENSORS, read_lines


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuTable:
    """Columns by name, and the lines that came before their header."""

    path: Path
    preamble: tuple[str, ...]
    columns: tuple[str, ...]
    units: tuple[str, ...]
    """The cells of the last line without a number between header and rows, if any."""
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

    def accelerations(self, names: Sequence[str]) -> tuple[np.ndarray | None, tuple[str, ...]]:
        """(N, 3), and a note where columns that look like accelerations are not these."""
        if self.has(names):
            return self.take(names), ()
        others = [column for column in self.columns if "acc" in column.lower()]
        if not others:
            return None, ()
        listed = ", ".join(others[:3]) + ", ..." * (len(others) > 3)
        return None, (f"no accelerations were read: {listed} are not {', '.join(names)}",)


def read_table(path: Path, *first_columns: str) -> ImuTable:
    """The table whose header line starts with one of `first_columns`.

    Cells stand between tabs, commas or semicolons, in quotes or not; numbers may have a decimal
    comma. Lines below the header without any number, as of units, are passed over. Raises
    `InputError` when there is no such header, no row under it, or when commas between cells and
    commas in numbers cannot be told apart.
    """
    lines = read_lines(path, SENSORS)
    starts = tuple(first_columns)
    preamble: list[str] = []
    header = ""
    for header in lines:
        if header.lstrip(' \t"').startswith(starts):
            break
        preamble.append(header)
    else:
        raise InputError(
            f"{path}: no header line that starts with '{starts[0]}'; "
            "check that the file is of the stated format"
        )
    delimiter = max("\t,;", key=header.count)
    (head,) = csv.reader([header], delimiter=delimiter)
    columns = tuple(cell.strip() for cell in head)
    body = (line for line in lines if line.strip())
    values, units = array("d"), ()
    count, doubled, first_doubled = 0, 0, []
    for cells in csv.reader(body, delimiter=delimiter):
        count += 1
        if len(cells) > 1.5 * len(columns):
            doubled += 1
            first_doubled = first_doubled or cells
        numbers = [number(cell) for cell in cells[: len(columns)]]
        if not values and not np.isfinite(numbers).any():
            units = tuple(cells)
            continue
        values.extend(numbers + [float("nan")] * (len(columns) - len(numbers)))
    if delimiter == "," and doubled > count / 2:
        # Commas between cells and in numbers double the cells of most lines.
        raise InputError(
            f"{path}: lines have {len(first_doubled)} cells under {len(columns)} columns, from "
            f"'{','.join(first_doubled[:2])}' on: the decimal sign is a comma, as is what stands "
            "between cells; export with a decimal point, or with semicolons or tabs between cells"
        )
    if not values:
        raise InputError(f"{path}: no samples below the header; export the recording again")
    return ImuTable(
        path=path,
        preamble=tuple(preamble),
        columns=columns,
        units=units,
        rows=np.frombuffer(values).reshape(-1, len(columns)),
    )


def number(cell: str) -> float:
    """The cell's value, also with a decimal comma; NaN where it is none.

    A moment by ISO 8601 is its seconds since 1970, in UTC where it names no zone.
    """
    try:
        return float(cell.replace(",", ".", 1))
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(cell.strip())
    except ValueError:
        return float("nan")
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


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
