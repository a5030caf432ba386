"""A take in the format of another program: a file per person, whatever the format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fusecap.errors import InputError, nearest
from fusecap.export.formats import FORMATS, format_named
from fusecap.files import safe_name
from fusecap.take import Take

UNITS_PER_M = {"m": 1.0, "cm": 100.0}
"""Blender wants metres, game engines centimetres."""


class WriteSubject(Protocol):
    """Writes one subject's motion, whole or not at all; raises `TakeError`."""

    def __call__(
        self, take: Take, subject: str, path: Path, *, units_per_m: float = 1.0
    ) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeFormat:
    """What a format's module says of it."""

    suffix: str
    write: WriteSubject


def export_take(
    take: Take, folder: Path | str, *, format: str, stem: str, unit: str = "m"
) -> list[Path]:
    """One `<stem>_<subject>` for every subject that was tracked at all; returns the paths."""
    if format not in FORMATS:
        raise InputError(f"no export format '{format}'{nearest(format, FORMATS)}")
    if unit not in UNITS_PER_M:
        raise InputError(f"no unit '{unit}'{nearest(unit, UNITS_PER_M)}")
    chosen = format_named(format)
    paths: list[Path] = []
    for subject, name in enumerate(take.subject_names):
        if not take.tracked[subject].any():
            continue
        base = f"{safe_name(stem)}_{safe_name(name)}"
        path = Path(folder) / f"{base}{chosen.suffix}"
        if path in paths:
            path = path.with_name(f"{base}_{subject + 1}{chosen.suffix}")
        chosen.write(take, name, path, units_per_m=UNITS_PER_M[unit])
        paths.append(path)
    return paths
