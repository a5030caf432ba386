"""A tidy table: one row per frame, person and bone, for pandas, R and spreadsheets.

    frame,time_s,person,bone,x_m,y_m,z_m,qw,qx,qy,qz,bone_sigma_deg,position_sigma_m,measured

The joint at the bone's root and the quaternion world_from_bone, y up; a person who is not tracked
has no row in that frame, and measured is 0 where the pose is predicted by the motion around.
"""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np

from fusecap.exports.take_format import AnyTake, ExportOptions, TakeFormat, blocks
from fusecap.files import written_whole
from fusecap.take import Take

COLUMNS = (
    *("frame", "time_s", "person", "bone", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz"),
    *("bone_sigma_deg", "position_sigma_m", "measured"),
)
_NUMBERS = ",%.4f,%.4f,%.4f,%.5f,%.5f,%.5f,%.5f,%.2f,%.4f,%d"


def write_csv(take: AnyTake, path: Path, _: ExportOptions) -> None:
    """Writes everybody, whole or not at all."""
    rows = [
        "".join(f"%d,%.6f{_named(name, bone)}{_NUMBERS}\n" for bone in take.bone_names)
        for name in take.subject_names
    ]
    times = take.time_s.tolist()
    with written_whole(path) as file:
        file.write((",".join(COLUMNS) + "\n").encode())
        for frames, part in blocks(take):
            for here, time_s in enumerate(times[frames]):
                for person in np.flatnonzero(part.tracked[:, here]).tolist():
                    values = _values(part, person, here, frames.start + here, time_s)
                    file.write((rows[person] % tuple(values)).encode())


def _values(part: Take, person: int, here: int, frame: int, time_s: float) -> list[float]:
    table = np.empty((len(part.bone_names), 12))
    table[:, 0], table[:, 1] = frame, time_s
    table[:, 2:5] = part.bone_position_in_world_m[person, here]
    table[:, 5:9] = part.bone_rotation_in_world_wxyz[person, here]
    table[:, 9] = part.bone_sigma_deg[person, here]
    table[:, 10] = part.position_sigma_m[person, here]
    table[:, 11] = part.measured[person, here]
    return table.ravel().tolist()


def _named(person: str, bone: str) -> str:
    """Quoted where a name needs it, and safe from the formatting of numbers."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow([person, bone])
    return f",{text.getvalue()}".replace("%", "%%")


FORMAT = TakeFormat(suffix=".csv", write=write_csv, per_person=False)
