"""TRC: marker trajectories for OpenSim, in its axes (`fusecap.exports.opensim`).

Markers are landmarks, joint centres and two points per bone that show how it is turned; the model
of `osim` carries the same. Where the person is not tracked the cells are empty.
"""

from __future__ import annotations

from pathlib import Path

from fusecap.exports.markers import bone_markers, marker_positions_m
from fusecap.exports.opensim import OPENSIM_FROM_OURS
from fusecap.exports.take_format import (
    UNITS_PER_M,
    AnyTake,
    ExportOptions,
    TakeFormat,
    blocks,
)
from fusecap.files import written_whole

_DECIMALS = {"mm": 2, "m": 5}


def write_trc(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    markers = bone_markers(take.shape(0))
    names, times = [name for name, _, _ in markers], take.time_s.tolist()
    frames = len(times)
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
    row = f"\t%.{_DECIMALS[options.unit]}f" * (3 * len(names)) + "\n"
    missing = "\t" * (3 * len(names)) + "\n"
    with written_whole(path) as file:
        file.write(("\n".join(head) + "\n").encode())
        for some, part in blocks(take):
            places = marker_positions_m(part, markers) @ OPENSIM_FROM_OURS.T
            values = (UNITS_PER_M[options.unit] * places).reshape(len(places), -1).tolist()
            told = zip(times[some], part.tracked[0].tolist(), values, strict=True)
            for frame, (time_s, tracked, xyz) in enumerate(told, start=some.start + 1):
                here = row % tuple(xyz) if tracked else missing
                file.write(f"{frame}\t{time_s:.6f}{here}".encode())


FORMAT = TakeFormat(suffix=".trc", write=write_trc, per_person=True, units=tuple(_DECIMALS))
