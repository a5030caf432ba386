"""C3D: points, segment rotations and steps, for biomechanics.

Points are landmarks and joint centres, rotations the bones with their joints (a 4 x 4 per frame),
in our world: y up, millimetres. A frame where the person is not tracked has residuals of -1. The
EVENT group holds foot strikes and foot offs (`fusecap.feet`).
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fusecap.exports.library import missing
from fusecap.exports.markers import Marker, bone_markers, marker_positions_m
from fusecap.exports.take_format import (
    UNITS_PER_M,
    AnyTake,
    ExportOptions,
    TakeFormat,
    blocks,
)
from fusecap.feet import foot_events
from fusecap.files import safe_name, written_whole
from fusecap.take import Take

_BLOCK = 512
_LAST_FRAME, _DATA_START = slice(8, 10), slice(16, 18)
"""Of a file's head."""
_MOST_FRAMES = 26_000
"""ezc3d takes the block where rotations begin for one of 32767 at most; a frame's points are 624
bytes."""
_MOST = 255
"""Entries of a parameter; further ones stand in NAME2, NAME3 ..."""


def write_c3d(take: AnyTake, path: Path, options: ExportOptions) -> None:
    """Writes the one subject of `take`, whole or not at all; raises `InputError` without ezc3d.

    ezc3d takes 23 KB for a frame, so it writes one frame, and the others follow here.
    """
    held = take.of_frames(0, len(take.timestamps_ns))
    markers = bone_markers(held.shape(0), axes=False)
    scale = UNITS_PER_M[options.unit]
    head = _head(held, markers, options.unit)
    with written_whole(path) as file:
        file.write(head)
        for _, part in blocks(held):
            file.write(_points(part, markers, scale).tobytes())
        file.write(b"\0" * (-file.tell() % _BLOCK))
        for _, part in blocks(held):
            file.write(_rotations(part, scale).tobytes())


def _head(take: Take, markers: list[Marker], unit: str) -> bytes:
    """All that stands before the frames."""
    file = _ezc3d().c3d()
    file["data"]["points"] = np.zeros((4, len(markers), 1))
    file["data"]["meta_points"]["residuals"] = np.zeros((1, len(markers), 1))
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, len(markers), 1), dtype=bool)
    file["data"]["rotations"] = np.zeros((4, 4, len(take.bone_names), 1))
    point = file["parameters"]["POINT"]
    point["RATE"]["value"] = [take.rate_hz]
    point["UNITS"]["value"] = [unit]
    point["LABELS"]["value"] = [name for name, _, _ in markers]
    point["DESCRIPTIONS"]["value"] = ["" for _ in markers]
    file.add_parameter("POINT", "X_SCREEN", ["+X"])
    file.add_parameter("POINT", "Y_SCREEN", ["+Y"])
    file.add_parameter("ROTATION", "RATE", [take.rate_hz])
    file.add_parameter("ROTATION", "LABELS", list(take.bone_names))
    subject = safe_name(take.subject_names[0])
    file.add_parameter("SUBJECTS", "USED", [1])
    file.add_parameter("SUBJECTS", "NAMES", [subject])
    file.add_parameter("SUBJECTS", "LABEL_PREFIXES", [""])
    _add_events(file, take, subject)
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "head.c3d"
        file.write(str(written))
        content = bytearray(written.read_bytes())
    frames = len(take.timestamps_ns)
    points_from = int.from_bytes(content[_DATA_START], "little")
    blocks_of_points = -(-frames * len(markers) * 16 // _BLOCK)
    content[_LAST_FRAME] = frames.to_bytes(2, "little")
    _set(content, b"POINT", b"FRAMES", frames)
    _set(content, b"ROTATION", b"DATA_START", points_from + blocks_of_points)
    return bytes(content[: (points_from - 1) * _BLOCK])


def _set(content: bytearray, group: bytes, name: bytes, value: int) -> None:
    """A parameter of one integer: name, two bytes of a link, type, no dimensions, value."""
    at = content.index(name, content.index(group)) + len(name) + 4
    content[at : at + 2] = value.to_bytes(2, "little")


def _ezc3d() -> Any:
    """The library, which has no types."""
    try:
        import ezc3d
    except ImportError as error:
        raise missing(error, extra="c3d") from error
    return ezc3d


def _points(take: Take, markers: list[Marker], scale: float) -> Float[np.ndarray, "t m 4"]:
    """Places, and residuals of -1 where not tracked."""
    tracked = take.tracked[0]
    points = np.zeros((len(tracked), len(markers), 4), dtype="<f4")
    points[tracked, :, :3] = scale * marker_positions_m(take, markers)[tracked]
    points[~tracked, :, 3] = -1.0
    return points


def _rotations(take: Take, scale: float) -> Float[np.ndarray, "t b 17"]:
    """world_from_bone by columns, then how sure it is; of no rotation where not tracked."""
    tracked = take.tracked[0]
    transform = np.zeros((len(tracked), len(take.bone_names), 4, 4))
    transform[:] = np.eye(4)
    transform[tracked, :, :3, :3] = take.bone_rotation_in_world(0)[tracked]
    transform[tracked, :, :3, 3] = scale * take.bone_position_in_world_m[0, tracked]
    columns = np.zeros((*transform.shape[:2], 17), dtype="<f4")
    columns[..., :16] = transform.swapaxes(2, 3).reshape(*transform.shape[:2], 16)
    return columns


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
    max_frames=_MOST_FRAMES,
    check_needs=_ezc3d,
)
