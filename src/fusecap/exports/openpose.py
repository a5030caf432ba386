"""Keypoints as OpenPose JSON: a folder per camera, a file per frame.

    left_000000000012_keypoints.json
    {"version":1.3,"people":[{"person_id":[-1],"pose_keypoints_2d":[x,y,c,...]},...]}

x, y in pixels, c 0-1; a missing keypoint is 0, 0, 0. Who was seen alone also has `appearance`, 40
numbers of how the clothes look (`fusecap.appearance`), which other programs pass over. A frame's
file takes its name only once it is whole, so a folder is valid whenever the writer dies;
`detection.json` beside the frames (docs/formats.md) says what they were made from.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from fusecap.errors import InputError
from fusecap.files import safe_name, written_whole

RECORD_NAME = "detection.json"
_OURS = re.compile(r".*_\d{12}_keypoints\.json|\..*\.part")


def frame_path(folder: Path, camera: str, number: int) -> Path:
    """Where a frame's keypoints go."""
    return folder / f"{safe_name(camera)}_{number:012d}_keypoints.json"


def frame_text(
    people: Float[np.ndarray, "n k 3"], appearance: UInt8[np.ndarray, "n 40"] | None = None
) -> str:
    """A frame's JSON: pixels to a thousandth, confidences to five digits.

    One format string per person takes half the time of `json`.
    """
    count, keypoints, _ = people.shape
    table = np.where(people[:, :, 2:] > 0, people, 0.0).reshape(count, 3 * keypoints)
    person = '{"person_id":[-1],"pose_keypoints_2d":['
    person += ",".join(["%.3f,%.3f,%.5g"] * keypoints) + "]%s}"
    clothes = [""] * count
    if appearance is not None:
        texts = [str(looks).replace(" ", "") for looks in appearance.tolist()]
        seen = appearance.max(axis=1).tolist()
        clothes = [f',"appearance":{t}' if s else "" for t, s in zip(texts, seen, strict=True)]
    rows = zip(table.tolist(), clothes, strict=True)
    entries = ",".join([person % (*values, text) for values, text in rows])
    return f'{{"version":1.3,"people":[{entries}]}}'


def write_frame(
    folder: Path,
    camera: str,
    number: int,
    people: Float[np.ndarray, "n k 3"],
    appearance: UInt8[np.ndarray, "n 40"] | None = None,
) -> None:
    """Writes one frame, whole or not at all; raises `InputError` with the system's reason."""
    path = frame_path(folder, camera, number)
    part = path.with_name(f".{path.name}.part")
    try:
        part.write_text(frame_text(people, appearance), encoding="utf-8")
        os.replace(part, path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error


def write_record(folder: Path, text: str) -> None:
    """Writes `detection.json`."""
    with written_whole(folder / RECORD_NAME) as file:
        file.write(text.encode())


def is_foreign(folder: Path) -> bool:
    """Whether a folder without a record holds anything but what a killed writer left."""
    return folder.is_dir() and any(not path.name.endswith(".part") for path in folder.iterdir())


def clear(folder: Path) -> None:
    """Deletes the frames of an earlier detection, then its record."""
    for path in folder.iterdir():
        if _OURS.fullmatch(path.name):
            path.unlink()
    (folder / RECORD_NAME).unlink(missing_ok=True)
