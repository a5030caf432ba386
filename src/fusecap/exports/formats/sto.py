"""STO: orientations of all bones as OpenSense takes those of sensors.

Columns are `<body>_imu` with OpenSim's names of bodies, cells are w,x,y,z: world_from_body, in
OpenSim's axes. A frame where the person is not tracked has no row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.shape import shape_with_clavicles
from fusecap.exports.opensim import OPENSIM_FROM_OURS, opensim_preset
from fusecap.exports.rest_rig import RestRig, rest_rig
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat, blocks
from fusecap.files import written_whole
from fusecap.geometry.quaternions import from_wxyz, to_wxyz
from fusecap.take import Take


def write_sto(take: AnyTake, path: Path, _: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all."""
    preset = opensim_preset(take)
    rest = rest_rig(preset, shape_with_clavicles(take.shape(0)))
    head = [
        f"DataRate={take.rate_hz:f}",
        "DataType=Quaternion",
        "version=3",
        "OpenSimVersion=4.5",
        "endheader",
        "\t".join(("time", *(f"{name}_imu" for name in rest.names))),
    ]
    row = "%.6f" + "\t%.6f,%.6f,%.6f,%.6f" * len(rest.names) + "\n"
    with written_whole(path) as file:
        file.write(("\n".join(head) + "\n").encode())
        for frames, part in blocks(take):
            for values in _table(part, take.time_s[frames], rest):
                file.write((row % tuple(values.tolist())).encode())


def _table(
    take: Take, time_s: Float[np.ndarray, " t"], rest: RestRig
) -> Float[np.ndarray, "tracked columns"]:
    tracked = take.tracked[0]
    turn = Rotation.from_matrix(OPENSIM_FROM_OURS)
    columns = [time_s[tracked, None]]
    for bone, name in enumerate(take.bone_names):
        in_world = from_wxyz(take.bone_rotation_in_world_wxyz[0, tracked, bone])
        of_body = in_world * Rotation.from_matrix(rest.rest_of(name)).inv()
        columns.append(to_wxyz(turn * of_body * turn.inv()))
    return np.concatenate(columns, axis=1)


FORMAT = TakeFormat(suffix=".sto", write=write_sto, per_person=True)
