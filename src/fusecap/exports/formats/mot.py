"""MOT: joint angles for OpenSim, of the model that `osim` writes.

Degrees, and metres for the pelvis' place. A frame where the person is not tracked has no row.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.exports.opensim import coordinate_values, write_motion
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat


def write_mot(take: AnyTake, path: Path, _: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    names, values = coordinate_values(take)
    tracked = take.tracked[0]
    write_motion(path, "Coordinates", names, take.time_s[tracked], values[tracked])


FORMAT = TakeFormat(suffix=".mot", write=write_mot, per_person=True)
