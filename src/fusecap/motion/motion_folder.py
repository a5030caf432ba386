"""Every take in a folder, loose or in tar archives.

A take's key is its path without suffix, as 'asfamc/01/01_01' or 'bvh/06_02': the folder's or the
archive's inside.
"""

from __future__ import annotations

import tarfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from fusecap.errors import InputError, nearest
from fusecap.inputs import ARCHIVE, MOTION, open_input, read_bytes
from fusecap.motion.files import motion_formats
from fusecap.motion.motion import Motion
from fusecap.motion.motion_format import MotionFormat

_ARCHIVES = ("*.tar", "*.tar.xz", "*.tar.gz", "*.tgz")


class MotionFolder:
    """The texts of all motion files under `folder`; takes are parsed when asked for."""

    def __init__(self, folder: Path) -> None:
        """Raises `InputError` where the folder is missing or holds no take."""
        if not folder.is_dir():
            raise InputError(f"no folder of motion at {folder}")
        self._formats = motion_formats()
        self._texts = _texts(folder, self._formats)
        self._takes = {
            path.removesuffix(PurePosixPath(path).suffix): path
            for path in sorted(self._texts)
            if PurePosixPath(path).suffix in self._formats
        }
        if not self._takes:
            raise InputError(
                f"{folder} holds no motion, loose or in tar archives; expected "
                + " or ".join(format.what for format in self._formats.values())
            )

    @property
    def keys(self) -> list[str]:
        """Keys of all takes, sorted."""
        return list(self._takes)

    def __getitem__(self, key: str) -> Motion:
        """The take; raises `InputError` where there is none or its file is broken."""
        if key not in self._takes:
            raise InputError(f"no take '{key}'{nearest(key, self._takes)}")
        path = self._takes[key]
        format = self._formats[PurePosixPath(path).suffix]
        folder = PurePosixPath(path).parent
        beside = {
            other: text
            for other, text in self._texts.items()
            if format.beside
            and other.endswith(format.beside)
            and PurePosixPath(other).parent == folder
        }
        return format.parse(self._texts[path], path, beside)


def _texts(folder: Path, formats: Mapping[str, MotionFormat]) -> Mapping[str, str]:
    texts: dict[str, str] = {}

    def add(path: str, content: bytes) -> None:
        text = content.decode("utf-8", errors="replace")
        format = formats.get(PurePosixPath(path).suffix)
        if format is None or format.holds(text):
            texts[path] = text

    wanted = {*formats, *(format.beside for format in formats.values() if format.beside)}
    for file in sorted(folder.rglob("*")):
        if file.suffix in wanted and file.is_file():
            add(file.relative_to(folder).as_posix(), read_bytes(file, MOTION))
    for archive in sorted(path for pattern in _ARCHIVES for path in folder.glob(pattern)):
        try:
            with open_input(archive, ARCHIVE) as file, tarfile.open(fileobj=file) as tar:
                for member in tar:
                    path = PurePosixPath(member.name)
                    content = tar.extractfile(member) if path.suffix in wanted else None
                    if content is not None and member.size <= (MOTION.most_bytes or 0):
                        add(path.as_posix(), content.read())
        except (tarfile.TarError, EOFError, OSError) as error:
            raise InputError(f"{archive}: cannot be unpacked: {error}") from None
    return texts
