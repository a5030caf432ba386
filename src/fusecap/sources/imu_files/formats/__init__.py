"""The table of formats of IMU files, one module each with its `FORMAT`.

A module is imported when its format is asked for, so that the table itself costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.sources.imu_files.loader import ImuFormat

NAMES = ("csv", "xsens-mt", "xsens-dot", "mvnx", "sto", "apdm-csv", "gaittoolbox-csv")
"""As a session writes them; a module's name has underscores. Of two whose marks a file carries, the
first is its format: MT Manager writes an empty SampleTimeFine, DOT's clock."""


def format_named(name: str) -> ImuFormat:
    """One of `NAMES`."""
    return import_module(f"{__name__}.{name.replace('-', '_')}").FORMAT
