"""C3D: points, segment rotations and steps, for biomechanics.

Points are landmarks and joint centres, rotations the bones with their joints (a 4 x 4 per frame),
in our world: y up, millimetres. A frame where the person is not tracked has residuals of -1. The
EVENT group holds foot strikes and foot offs (`fusecap.feet`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fusecap.exports.library import missing, written_by_name
from fusecap.exports.markers import marker_positions_m
from fusecap.exports.take_format import UNITS_PER_M, ExportOptions, TakeFormat
from fusecap.feet import foot_events
from fusecap.files import safe_name
from fusecap.take import Take

_MOST = 255
"""Entries of a parameter; further ones stand in NAME2, NAME3 ..."""


def write_c3d(take: Take, path: Path, options: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all; raises `InputError` without ezc3d."""
    ezc3d = _ezc3d()
    scale = UNITS_PER_M[options.unit]
    names, places = marker_positions_m(take, axes=False)
    tracked = take.tracked[0]
    file = ezc3d.c3d()
    points = np.ones((4, len(names), len(tracked)))
    points[:3] = np.where(tracked, (scale * places).transpose(2, 1, 0), 0.0)
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = np.where(tracked, 0.0, -1.0)[None, None].repeat(
        len(names), axis=1
    )
    file["data"]["meta_points"]["camera_masks"] = np.zeros(
        (7, len(names), len(tracked)), dtype=bool
    )
    file["data"]["rotations"] = _rotations(take, scale)
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [take.rate_hz]
    point["UNITS"]["value"] = [options.unit]
    point["LABELS"]["value"] = names
    point["DESCRIPTIONS"]["value"] = ["" for _ in names]
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Y"])
    file.add_parameter("ROTATION", "RATE", [take.rate_hz])
    file.add_parameter("ROTATION", "LABELS", list(take.bone_names))
    subject = safe_name(take.subject_names[0])
    file.add_parameter("SUBJECTS", "USED", [1])
    file.add_parameter("SUBJECTS", "NAMES", [subject])
    file.add_parameter("SUBJECTS", "LABEL_PREFIXES", [""])
    _add_events(file, take, subject)
    written_by_name(path, lambda part: file.write(str(part)))


def _ezc3d() -> Any:
    """The library, which has no types."""
    try:
        import ezc3d
    except ImportError as error:
        raise missing(error, extra="c3d") from error
    return ezc3d


def _rotations(take: Take, scale: float) -> np.ndarray:
    """(4, 4, b, t): world_from_bone; of no rotation and no place where not tracked."""
    tracked = take.tracked[0]
    frames, bones = len(tracked), len(take.bone_names)
    transform = np.zeros((frames, bones, 4, 4))
    transform[:] = np.eye(4)
    transform[tracked, :, :3, :3] = take.bone_rotation_in_world(0)[tracked]
    transform[tracked, :, :3, 3] = scale * take.bone_position_in_world_m[0, tracked]
    return transform.transpose(2, 3, 1, 0)


def _add_events(file: Any, take: Take, subject: str) -> None:
    events = foot_events(take, 0)
    times = take.time_s[[event.frame for event in events]]
    file.add_parameter("EVENT", "USED", [len(events)])
    for number, first in enumerate(range(0, len(events), _MOST), start=1):
        some = events[first : first + _MOST]
        tail = "" if number == 1 else str(number)
        minutes, seconds = np.divmod(times[first : first + _MOST], 60.0)
        file.add_parameter("EVENT", f"TIMES{tail}", np.stack([minutes, seconds]))
        for name, values in {
            "CONTEXTS": [event.side.title() for event in some],
            "LABELS": ["Foot Strike" if event.strikes else "Foot Off" for event in some],
            "SUBJECTS": [subject for _ in some],
            "DESCRIPTIONS": ["" for _ in some],
        }.items():
            file.add_parameter("EVENT", name + tail, values)


FORMAT = TakeFormat(
    suffix=".c3d",
    write=write_c3d,
    per_person=True,
    units=("mm", "m"),
    max_frames=65535,
    check_needs=_ezc3d,
)
