"""MOT: joint angles for OpenSim, of the model that `osim` writes.

Degrees, and metres for the pelvis' place. A frame where the person is not tracked has no row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusecap.exports.opensim import coordinate_values
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.files import written_whole
from fusecap.take import Take


def write_mot(take: Take, path: Path, _: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    names, values = coordinate_values(take)
    tracked = take.tracked[0]
    table = np.concatenate([take.time_s[:, None], values], axis=1)[tracked]
    head = [
        "Coordinates",
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={table.shape[1]}",
        "inDegrees=yes",
        "endheader",
        "\t".join(("time", *names)),
    ]
    with written_whole(path) as file:
        file.write(("\n".join(head) + "\n").encode())
        np.savetxt(file, table, fmt="%.6f", delimiter="\t")


FORMAT = TakeFormat(suffix=".mot", write=write_mot, per_person=True)
