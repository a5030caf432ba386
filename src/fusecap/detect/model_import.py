"""Networks out of packages that a user has: a wheel, an npm package, an archive, a folder, a file.

A file is known by its name inside the package and its SHA-256; where that of OpenMMLab's is not
known, by the archive's own name.
"""

from __future__ import annotations

import hashlib
import io
import tarfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import cast

from fusecap.detect.model_store import MAX_BYTES, MODELS, StoredModel, keep
from fusecap.errors import InputError
from fusecap.inputs import ARCHIVE, NETWORK, open_input

_CHUNK = 1 << 20
_MOST_FILES = 100_000
_MOST_UNPACKED = 1 << 34
"""Bytes of an archive that are gone through."""
_UNREADABLE = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, OSError),
    *(NotImplementedError, RuntimeError, ValueError),  # of locked and garbled archives
)


def import_models(
    path: Path, *, models: Mapping[str, StoredModel] = MODELS, cache: Path | None = None
) -> list[str]:
    """Keeps every known network that is in there; their names.

    Raises `InputError` where there is none, or where the package cannot be read.
    """
    kept: list[str] = []
    with _told(path):
        for found, file in _files(path):
            for name, stored in models.items():
                if name not in kept and _is(stored, found, file, path):
                    file.seek(0)
                    keep(name, stored, file, cache)
                    kept.append(name)
    if not kept:
        known = sorted({stored.member for stored in models.values() if stored.member})
        raise InputError(
            f"{path}: no network that is known here is in it (looked for {', '.join(known)}, by "
            "name and checksum); one of your own needs no import: give its path as the model"
        )
    return kept


def _is(stored: StoredModel, found: str, file: io.BufferedIOBase, package: Path) -> bool:
    if found != stored.member:
        return False
    if stored.sha256 is None:
        return stored.url is not None and package.name == PurePosixPath(stored.url).name
    file.seek(0)
    digest = hashlib.sha256()
    while chunk := file.read(_CHUNK):
        digest.update(chunk)
    return digest.hexdigest() == stored.sha256


def _files(path: Path) -> Iterator[tuple[str, io.BufferedIOBase]]:
    """Name and content of every file that may be a network."""
    if path.is_dir():
        for each in sorted(one for one in path.rglob("*") if one.is_file())[:_MOST_FILES]:
            if each.suffix in (".onnx", ".tflite"):
                with open_input(each, NETWORK) as file:
                    yield each.name, file
        return
    with open_input(path, ARCHIVE) as file:
        if zipfile.is_zipfile(file):
            yield from _zipped(file)
            return
        file.seek(0)
        if tarfile.is_tarfile(file):
            yield from _tarred(file)
        else:
            yield path.name, file


def _zipped(file: io.BufferedIOBase) -> Iterator[tuple[str, io.BufferedIOBase]]:
    with zipfile.ZipFile(file) as archive:
        for info in archive.infolist()[:_MOST_FILES]:
            name = PurePosixPath(info.filename).name
            if name.endswith((".onnx", ".tflite")) and info.file_size <= MAX_BYTES:
                with archive.open(info) as member:
                    yield name, cast(io.BufferedIOBase, member)


def _tarred(file: io.BufferedIOBase) -> Iterator[tuple[str, io.BufferedIOBase]]:
    file.seek(0)
    with tarfile.open(fileobj=file) as archive:
        for info in archive:
            if info.offset_data + info.size > _MOST_UNPACKED:
                raise tarfile.TarError(f"it unpacks to more than {_MOST_UNPACKED >> 30} GB")
            name = PurePosixPath(info.name).name
            if info.isfile() and name.endswith((".onnx", ".tflite")) and info.size <= MAX_BYTES:
                member = archive.extractfile(info)
                assert member is not None
                yield name, cast(io.BufferedIOBase, member)


@contextmanager
def _told(path: Path) -> Iterator[None]:
    """What readers of archives raise becomes an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except _UNREADABLE as error:
        raise InputError(
            f"{path}: cannot be read as a wheel, a zip or a tar archive ({error}); get it again"
        ) from None
