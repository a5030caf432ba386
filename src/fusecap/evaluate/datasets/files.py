"""What the loaders share: cameras given by their centre, numbers out of text, tar archives."""

from __future__ import annotations

import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from fusecap.errors import InputError
from fusecap.geometry.camera import Camera
from fusecap.sources.calibration_files import fields


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


def read_text(path: Path, what: str) -> str:
    """The file; raises `InputError` that says what was expected."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected {what}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}; expected {what}") from None


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


@contextmanager
def unpacked(archive: Path) -> Iterator[Path]:
    """A tar archive's content in a folder that is deleted afterwards."""
    with tempfile.TemporaryDirectory() as target:
        try:
            with tarfile.open(archive) as tar:
                tar.extractall(target, filter="data")
        except (tarfile.TarError, OSError, EOFError) as error:
            raise InputError(f"{archive}: cannot be unpacked: {error}") from None
        yield Path(target)
