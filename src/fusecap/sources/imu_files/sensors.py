"""Which sensor of a file that holds several."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusecap.errors import InputError, nearest


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
