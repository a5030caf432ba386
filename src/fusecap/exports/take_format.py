"""What a module of `formats/` says of its format, and what it is told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from fusecap.body.landmarks import LandmarkSet
from fusecap.geometry.camera import Rig
from fusecap.stored_take import StoredTake
from fusecap.take import BLOCK, Take

AnyTake = Take | StoredTake
"""What is exported: half an hour in memory is half a gigabyte, in its file nothing."""
UNITS_PER_M = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
METRE = ("m",)
METRE_AND_CM = ("m", "cm")
"""Blender wants metres, game engines centimetres."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportOptions:
    """What can be chosen; a format that has no use for a thing leaves it."""

    unit: str = "m"
    """One of the format's."""
    rig: str = "native"
    """One of `fusecap.body.rigs.PRESETS`."""
    cameras: Rig | None = None
    """Those that keypoints are seen by."""
    landmarks: LandmarkSet | None = None
    """As the detector of those cameras names them."""


def nothing_needed() -> None:
    """A plain install is enough."""


def blocks(take: AnyTake) -> Iterator[tuple[slice, Take]]:
    """All of it, some frames at a time: which, and the take of them."""
    for first in range(0, len(take.timestamps_ns), BLOCK):
        yield slice(first, first + BLOCK), take.of_frames(first, first + BLOCK)


class WriteTake(Protocol):
    """Writes everybody in a take, whole or not at all; raises `InputError`."""

    def __call__(self, take: AnyTake, path: Path, options: ExportOptions, /) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class TakeFormat:
    """What a format's module says of it."""

    suffix: str
    tag: str = ""
    """Before the ending, where a file beside the take could else be the take itself."""
    write: WriteTake
    per_person: bool
    """A file holds one person: each is a take with that one subject."""
    units: tuple[str, ...] = METRE
    """Of length, the usual one first."""
    max_frames: int | None = None
    """A longer take goes into several files."""
    has_rig: bool = False
    """Whether joints have names and a rest pose that a preset can choose."""
    holds: bool = False
    """A frame without a person shows the last pose, and the file cannot say so."""
    check_needs: Callable[[], object] = nothing_needed
    """Raises `InputError` for a library or program that is not there, and what to do."""
