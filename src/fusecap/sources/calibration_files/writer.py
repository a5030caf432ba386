"""Writes a rig in the format that a file's name asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusecap.errors import CalibrationError
from fusecap.files import check_writable, write_whole
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files.formats import rig_formats
from fusecap.sources.calibration_files.rig_format import RigFormat, RigTexts


def write_rig(path: Path | str, rig: Rig, *, notes: Sequence[str] = ()) -> list[Path]:
    """Writes all cameras and returns the files, each whole or not at all.

    `.toml` is the aniposelib layout in metres (`camera_array.toml` caliscope's), `.qca.txt`
    Qualisys in millimetres, `.json` Panoptic in centimetres; a name without any of these is a
    folder with one JSON per camera in metres. `load_rig` reads all of them back. `notes` become
    comments in a TOML. Rotations that are not quite orthonormal become the nearest rotation in
    a TOML and stay as they are in the others. Raises `CalibrationError` or `TakeError`.
    """
    path = Path(path)
    if not len(rig):
        raise CalibrationError(f"{path}: a calibration without cameras is not written")
    check_rig_path(path)
    _, texts_of = _format_of(path)
    texts = texts_of(path, rig, notes)
    for file, text in texts.items():
        write_whole(file, text)
    return list(texts)


def check_rig_path(path: Path) -> None:
    """Before the work that finds the cameras: raises where `write_rig` could not write them."""
    format, _ = _format_of(path)
    check_writable(path if format.suffixes else path / "camera.json")


def _format_of(path: Path) -> tuple[RigFormat, RigTexts]:
    """By the name of what is to be written."""
    written = [(format, format.texts) for format in rig_formats() if format.texts is not None]
    for format, texts in written:
        if format.has_name(path):
            return format, texts
    known = " or ".join(format.what for format, _ in written)
    raise CalibrationError(f"{path}: no calibration format has this name; expected {known}")
