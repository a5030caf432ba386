"""Every take in a folder, loose or in tar archives.

A take's key is its path without suffix, as 'asfamc/01/01_01' or 'bvh/06_02': the folder's or the
archive's inside. An AMC take needs its skeleton beside it, '01.asf' or the only ASF there.
"""

from __future__ import annotations

import re
import tarfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from fusecap.errors import InputError, nearest
from fusecap.motion.files.amc import parse_amc, parse_asf
from fusecap.motion.files.bvh import parse_bvh
from fusecap.motion.files.expmap import parse_expmap
from fusecap.motion.motion import Motion

_TAKE_SUFFIXES = (".amc", ".bvh", ".txt")
_ARCHIVES = ("*.tar", "*.tar.xz", "*.tar.gz", "*.tgz")


class MotionFolder:
    """The texts of all motion files under `folder`; takes are parsed when asked for."""

    def __init__(self, folder: Path) -> None:
        """Raises `InputError` where the folder is missing or holds no take."""
        if not folder.is_dir():
            raise InputError(f"no folder of motion at {folder}")
        self._texts = _texts(folder)
        self._takes = {
            path.removesuffix(PurePosixPath(path).suffix): path
            for path in sorted(self._texts)
            if PurePosixPath(path).suffix in _TAKE_SUFFIXES
        }
        if not self._takes:
            raise InputError(
                f"{folder} holds no motion; expected .asf with .amc, .bvh or exponential-map .txt "
                "files, loose or in tar archives"
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
        text = self._texts[path]
        match PurePosixPath(path).suffix:
            case ".amc":
                skeleton = self._skeleton_of(path)
                return parse_amc(text, parse_asf(self._texts[skeleton], skeleton), path)
            case ".bvh":
                return parse_bvh(text, path)
            case _:
                return parse_expmap(text, path)

    def _skeleton_of(self, take: str) -> str:
        beside = PurePosixPath(take).parent
        subject = re.split(r"[_.]", PurePosixPath(take).name)[0]
        skeletons = [
            path
            for path in self._texts
            if path.endswith(".asf") and PurePosixPath(path).parent == beside
        ]
        named = [path for path in skeletons if PurePosixPath(path).stem == subject]
        if len(named or skeletons) != 1:
            raise InputError(
                f"{take}: expected its skeleton '{subject}.asf' beside it; "
                f"found {', '.join(skeletons) or 'no .asf'}"
            )
        return (named or skeletons)[0]


def _texts(folder: Path) -> Mapping[str, str]:
    texts: dict[str, str] = {}

    def add(path: str, content: bytes) -> None:
        text = content.decode("utf-8", errors="replace")
        if not path.endswith(".txt") or "," in text.partition("\n")[0]:
            texts[path] = text

    wanted = (".asf", *_TAKE_SUFFIXES)
    for file in sorted(folder.rglob("*")):
        if file.suffix in wanted and file.is_file():
            add(file.relative_to(folder).as_posix(), file.read_bytes())
    for archive in sorted(path for pattern in _ARCHIVES for path in folder.glob(pattern)):
        try:
            with tarfile.open(archive) as tar:
                for member in tar:
                    content = tar.extractfile(member) if member.isfile() else None
                    if content is not None and PurePosixPath(member.name).suffix in wanted:
                        add(PurePosixPath(member.name).as_posix(), content.read())
        except (tarfile.TarError, EOFError, OSError) as error:
            raise InputError(f"{archive}: cannot be unpacked: {error}") from None
    return texts
