"""Calibration files: one module per format, recognised by content rather than asked for."""

from fusecap.sources.calibration_files.loader import load_lenses, load_rig
from fusecap.sources.calibration_files.plausibility import check_rig
from fusecap.sources.calibration_files.writer import write_rig

__all__ = ["check_rig", "load_lenses", "load_rig", "write_rig"]
