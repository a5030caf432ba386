"""The table of formats of motion files, one module each with its `FORMAT`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.motion.motion_format import MotionFormat

NAMES = ("bvh", "amc", "expmap")
"""Of their modules."""


def motion_formats() -> dict[str, MotionFormat]:
    """All of `NAMES`, by suffix."""
    formats = [import_module(f"{__name__}.{name}").FORMAT for name in NAMES]
    return {format.suffix: format for format in formats}
