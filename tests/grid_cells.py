"""Cells for tests of the runner; a worker process imports them from here."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Square:
    number: int
    does: str = ""
    """"raise", "die", "end", "hang up" or "wait"; else it squares at once."""
    log: str = ""
    """Folder in which every start leaves a file."""


def square(cell: Square) -> dict[str, float]:
    if cell.log:
        (Path(cell.log) / f"{cell.number}_{time.time_ns()}").touch()
    if cell.does == "raise":
        raise ValueError(f"{cell.number} is not to be squared")
    if cell.does == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if cell.does == "end":  # as whoever stops a process asks it to, twice
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
    if cell.does == "hang up":  # as a terminal that is closed
        os.kill(os.getpid(), signal.SIGHUP)
    if cell.does == "wait":
        time.sleep(0.4)
    return {"square": cell.number**2, "threads": float(os.environ["OMP_NUM_THREADS"])}


def cube(cell: Square) -> dict[str, int]:
    return {"cube": cell.number**3}


def not_a_number(cell: Square) -> dict[str, float]:
    return {"value": float("nan")}
