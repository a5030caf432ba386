"""TRC: marker trajectories for OpenSim, in its axes (`fusecap.exports.opensim`).

Markers are landmarks, joint centres and two points per bone that show how it is turned; the model
of `osim` carries the same. Where the person is not tracked the cells are empty.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.exports.markers import marker_positions_m
from fusecap.exports.opensim import OPENSIM_FROM_OURS
from fusecap.exports.take_format import UNITS_PER_M, ExportOptions, TakeFormat
from fusecap.files import written_whole
from fusecap.take import Take

_DECIMALS = {"mm": 2, "m": 5}


def write_trc(take: Take, path: Path, options: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    names, places = marker_positions_m(take)
    frames = len(places)
    values = (places @ OPENSIM_FROM_OURS.T * UNITS_PER_M[options.unit]).reshape(frames, -1)
    rate = f"{take.rate_hz:g}"
    axes = "\t".join(f"X{n}\tY{n}\tZ{n}" for n in range(1, len(names) + 1))
    head = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame"
        "\tOrigNumFrames",
        f"{rate}\t{rate}\t{frames}\t{len(names)}\t{options.unit}\t{rate}\t1\t{frames}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
        f"\t\t{axes}",
        "",
    ]
    row = f"\t%.{_DECIMALS[options.unit]}f" * values.shape[1] + "\n"
    missing = "\t" * values.shape[1] + "\n"
    with written_whole(path) as file:
        file.write(("\n".join(head) + "\n").encode())
        for frame, time_s in enumerate(take.time_s.tolist()):
            here = row % tuple(values[frame].tolist()) if take.tracked[0, frame] else missing
            file.write(f"{frame + 1}\t{time_s:.6f}{here}".encode())


FORMAT = TakeFormat(suffix=".trc", write=write_trc, per_person=True, units=tuple(_DECIMALS))
