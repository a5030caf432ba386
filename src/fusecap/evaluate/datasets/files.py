"""What the loaders share: cameras given by their centre, numbers out of text, tar archives."""

from __future__ import annotations

import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.geometry.camera import Camera
from fusecap.inputs import ARCHIVE, DATASET, open_input, read_text
from fusecap.sources.calibration_files import fields

MOST_UNPACKED_BYTES = 32 << 30
"""Of an archive."""


def camera_at_centre(
    path: Path,
    *,
    name: str,
    size_px: tuple[int, int],
    focal_px: np.ndarray,
    centre_px: np.ndarray,
    radial: np.ndarray,
    tangential: np.ndarray,
    rotation: np.ndarray,
    position_m: np.ndarray,
) -> Camera:
    """A camera of `x_cam = R (X - T)`, T its place in the world; k1, k2, k3 and p1, p2 apart."""
    return fields.camera(
        path,
        name=name,
        size_px=np.array(size_px),
        matrix=np.array(
            [[focal_px[0], 0, centre_px[0]], [0, focal_px[1], centre_px[1]], [0, 0, 1]]
        ),
        distortion=np.array([*radial[:2], *tangential, radial[2]]),
        rotation=rotation,
        translation=-rotation @ position_m,
    )


def text_of(path: Path, what: str) -> str:
    """The file; raises `InputError` that says what was expected."""
    return read_text(path, replace(DATASET, what=what))


def floats(words: list[str], where: str) -> np.ndarray:
    """Finite numbers; raises `InputError` naming the first word that is none."""
    values = np.empty(len(words))
    for index, word in enumerate(words):
        try:
            values[index] = float(word)
        except ValueError:
            raise InputError(f"{where}: found '{word[:40]}', expected a number") from None
    if not np.isfinite(values).all():
        raise InputError(f"{where}: holds a value that is not a finite number")
    return values


class _Within:
    """Lets through what stays inside the folder, until it is too much."""

    def __init__(self) -> None:
        self._bytes = 0

    def __call__(self, member: tarfile.TarInfo, folder: str) -> tarfile.TarInfo | None:
        self._bytes += member.size
        if self._bytes > MOST_UNPACKED_BYTES:
            raise tarfile.TarError(f"it unpacks to more than {MOST_UNPACKED_BYTES >> 30} GB")
        return tarfile.data_filter(member, folder)


@contextmanager
def unpacked(archive: Path) -> Iterator[Path]:
    """A tar archive's content in a folder that is deleted afterwards."""
    with tempfile.TemporaryDirectory() as target:
        try:
            with open_input(archive, ARCHIVE) as file, tarfile.open(fileobj=file) as tar:
                tar.extractall(target, filter=_Within())
        except (tarfile.TarError, OSError, EOFError) as error:
            raise InputError(f"{archive}: cannot be unpacked: {error}") from None
        yield Path(target)
