"""What the module of a calibration format says of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fusecap.geometry.camera import Camera, Rig

StatedCamera = tuple[str, Callable[[], Camera]]
"""A name in a file, and what reads that camera or raises `CalibrationError`."""


RigTexts = Callable[[Path, Rig, Sequence[str]], dict[Path, str]]
"""What writes cameras: files by path."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigFormat:
    """How it is told from others, read and written."""

    what: str
    """As a message calls it."""
    suffixes: tuple[str, ...]
    """Of file names; none: it is a folder."""
    unit_is_open: bool
    """Whether translations may be in metres or millimetres; else `read` gives metres."""
    read: Callable[[Path], list[StatedCamera] | None]
    """The cameras, none judged before it is asked for; None where the file or folder is not in this
    format."""
    texts: RigTexts | None
    """The files, for cameras in metres and notes of which a format without comments has none; None:
    it is read only."""

    def has_name(self, path: Path) -> bool:
        """Whether it would be written to this path."""
        if self.suffixes:
            return path.name.endswith(self.suffixes)
        return not path.suffix and not path.is_file()
