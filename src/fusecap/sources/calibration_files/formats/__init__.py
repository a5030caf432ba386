"""The table of formats of calibration files, one module each with its `FORMAT`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.sources.calibration_files.rig_format import RigFormat

NAMES = ("aniposelib", "qualisys", "panoptic", "calibio", "easymocap", "shelf")
"""Of their modules, in the order in which they look at a file."""


def rig_formats() -> list[RigFormat]:
    """All of `NAMES`."""
    return [import_module(f"{__name__}.{name}").FORMAT for name in NAMES]
