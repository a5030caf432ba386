"""NumPy arrays of everybody on a rig; the take itself (docs/take.md) has our bones and error bars.

    person_names (S,)  joint_names (J,)  parents (J,)  time_s (T,)  rate_hz
    tracked (S, T)  measured (S, T)
    rest_position_m (S, J, 3)  rest_rotation_xyzw (S, J, 4)    in the world, standing at the origin
    position_m (S, T, J, 3)    rotation_xyzw (S, T, J, 4)      in the parent's frame

A root's values are in the world: right-handed, y up. Frames without a person hold the last pose.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.rigs import rig_preset
from fusecap.errors import TakeError
from fusecap.exports.rest_rig import RestRig
from fusecap.exports.rig_motion import rig_motions
from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat
from fusecap.files import written_whole
from fusecap.stored_take import is_take


def write_npz(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes everybody who is tracked, whole or not at all; never over a take."""
    if is_take(path):
        raise TakeError(f"{path} is a take: export to another name")
    rows = np.flatnonzero(take.tracked.any(axis=1))
    joints = (len(rows), len(take.timestamps_ns), len(rig_preset(options.rig).joints))
    position_m = np.empty((*joints, 3), dtype=np.float32)
    xyzw = np.empty((*joints, 4), dtype=np.float32)
    rest: list[RestRig] = []
    for person, motion in enumerate(rig_motions(take, options.rig)):
        position_m[person], xyzw[person] = motion.position_m, motion.rotation_xyzw
        rest.append(motion.rest)
    arrays = {
        "person_names": np.array(take.subject_names, dtype=np.str_)[rows],
        "joint_names": np.array(rest[0].names, dtype=np.str_),
        "parents": np.array(rest[0].parents),
        "time_s": take.time_s,
        "rate_hz": np.array(take.rate_hz),
        "tracked": take.tracked[rows],
        "measured": take.measured[rows],
        "rest_position_m": np.array([one.position_m for one in rest]),
        "rest_rotation_xyzw": np.array(
            [Rotation.from_matrix(one.rotation).as_quat() for one in rest]
        ),
        "position_m": position_m,
        "rotation_xyzw": xyzw,
    }
    with written_whole(path) as file:
        np.savez(file, **arrays)


FORMAT = TakeFormat(suffix=".npz", tag=".rig", write=write_npz, per_person=False, has_rig=True)
