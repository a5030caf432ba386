"""Who is to be tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fusecap.errors import SessionError


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """A named person, and where on the floor they begin."""

    name: str
    start_m: tuple[float, float] | None = None
    """World (x, z) at the first instant, or None: whoever is found."""


def check_distinct(subjects: Sequence[Subject]) -> None:
    """Raises `SessionError` when two subjects share a name."""
    names = [subject.name for subject in subjects]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise SessionError(f"two subjects are called {', '.join(doubled)}; names must differ")
