"""Calibrated landmark offsets as TOML: what `fusecap calibrate offsets` writes and a session names.

    format = "fusecap landmark offsets 1"
    landmark_set = "body25"
    origin = "eq. 17-18 with the truth of truth.npz, 1200 person-frames"

    [everyone]                              # fractions of stature in the bone's frame:
    nose = [0.0, 0.0231, 0.0592]            # x to the subject's left, y up, z forward at rest

    [subject.anna]                          # optional; comes before [everyone]
    left_ear = [0.0451, 0.0340, 0.0012]

Landmarks that are not listed keep their defaults.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.body.landmarks import LANDMARKS, LandmarkOffsets, LandmarkSet, Offset
from fusecap.errors import InputError, nearest
from fusecap.sources.toml_text import quoted, read_written

FORMAT = "fusecap landmark offsets 1"
MAX_FRACTION = 0.25
"""Of stature: no landmark lies farther from its bone's joint."""
_KEYS = ("format", "landmark_set", "origin", "everyone", "subject")


def offsets_toml(landmarks: LandmarkSet, *, origin: str) -> str:
    """The text of a file with the offsets of a calibrated set; `origin` says where they are from.

    Everyone's offsets are written for all of its landmarks, so the file does not depend on the
    defaults of a later version.
    """
    lines = [
        "# Where keypoints lie on the body: fractions of stature in the frames of their bones",
        "# (x to the subject's left, y up, z forward in the rest pose).",
        f"format = {quoted(FORMAT)}",
        f"landmark_set = {quoted(landmarks.name)}",
        f"origin = {quoted(origin)}",
        "",
        "[everyone]",
        *_rows(dict(zip(landmarks.landmark_names, landmarks.fractions.tolist(), strict=True))),
    ]
    for subject, offsets in (landmarks.offsets or LandmarkOffsets()).subjects.items():
        lines += ["", f"[subject.{quoted(subject)}]", *_rows(offsets)]
    return "\n".join(lines) + "\n"


def read_offsets(path: Path | str, landmark_set: str) -> LandmarkOffsets:
    """The offsets in a file, which must be of this landmark set; raises `InputError`."""
    path = Path(path)
    data = read_written(path, FORMAT, "fusecap calibrate offsets")
    for key in data:
        if key not in _KEYS:
            raise InputError(f"{path}: unknown key '{key}'{nearest(key, _KEYS)}")
    if data.get("landmark_set") != landmark_set:
        raise InputError(
            f"{path}: holds offsets of '{data.get('landmark_set')}', the session's keypoints are "
            f"'{landmark_set}'; a detector's offsets hold for its own keypoints only"
        )
    return LandmarkOffsets(
        everyone=_offsets(path, "everyone", data.get("everyone", {})),
        subjects={
            name: _offsets(path, f"subject.{name}", table)
            for name, table in _table(path, "subject", data.get("subject", {})).items()
        },
    )


def _table(path: Path, where: str, table: Any) -> Mapping[str, Any]:
    if not isinstance(table, dict):
        raise InputError(f"{path}: {where} is {table!r}, expected a table")
    return table


def _offsets(path: Path, where: str, table: Any) -> dict[str, Offset]:
    offsets = {}
    for name, value in _table(path, f"[{where}]", table).items():
        if name not in LANDMARKS:
            raise InputError(
                f"{path}: [{where}] has no landmark '{name}'{nearest(name, LANDMARKS)}"
            )
        numbers = isinstance(value, list) and [
            v for v in value if isinstance(v, int | float) and not isinstance(v, bool)
        ]
        if not numbers or len(numbers) != 3 or len(value) != 3 or not np.isfinite(numbers).all():
            raise InputError(f"{path}: [{where}] {name} is {value!r}, expected [x, y, z]")
        if np.linalg.norm(numbers) > MAX_FRACTION:
            raise InputError(
                f"{path}: [{where}] {name} lies {np.linalg.norm(numbers):.3g} statures from its "
                f"joint, expected at most {MAX_FRACTION}; offsets are fractions of stature, not "
                "metres or millimetres"
            )
        offsets[name] = (float(numbers[0]), float(numbers[1]), float(numbers[2]))
    return offsets


def _rows(offsets: Mapping[str, Any]) -> list[str]:
    return [
        f"{name} = [{', '.join(f'{value + 0.0:.5f}' for value in offset)}]"
        for name, offset in offsets.items()
    ]
