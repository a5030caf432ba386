"""Rules of the house that a reader could break without noticing."""

from __future__ import annotations

from pathlib import Path

import pytest

import fusecap.export.formats as exports
import fusecap.motion.files as motions
import fusecap.sources.calibration_files.formats as calibrations
import fusecap.sources.imu_files.formats as imus
import fusecap.sources.imu_streams as sensors
import fusecap.streams.protocols as protocols


@pytest.mark.parametrize(
    ("folder", "table"),
    [
        (exports, exports.FORMATS),
        (protocols, protocols.NAMES),
        (sensors, sensors.NAMES),
        (imus, [name.replace("-", "_") for name in imus.NAMES]),
        (calibrations, calibrations.NAMES),
        (motions, motions.NAMES),
    ],
)
def test_every_module_of_a_format_folder_stands_in_its_table(folder, table):
    modules = [path.stem for path in Path(folder.__file__).parent.glob("*.py")]
    assert sorted({*modules} - {"__init__"}) == sorted(table)
