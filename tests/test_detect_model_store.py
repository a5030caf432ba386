"""The model store against a server on this machine."""

from __future__ import annotations

import hashlib
import io
import socket
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from urllib.parse import urlparse

import numpy as np
import pytest

from fusecap.detect.detector import DEFAULT_MODEL, DEFAULT_PERSON_MODEL
from fusecap.detect.model_store import MODELS, StoredModel, cache_dir, model_path
from fusecap.detect.runtimes.choice import open_network
from fusecap.errors import InputError
from tiny_networks import constant_network


@pytest.fixture
def network(tmp_path) -> bytes:
    path = constant_network(tmp_path / "made.onnx", (1, 3, 8, 8), {"a": np.zeros((1, 2))})
    return path.read_bytes()


class Server:
    """Files by path; `requests` counts what was asked for."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.promised: dict[str, int] = {}
        self.silent: set[str] = set()
        self.requests: list[str] = []
        self.stop = threading.Event()
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.requests.append(self.path)
                if self.path in server.silent:
                    server.stop.wait(5.0)
                    return
                body = server.files.get(self.path)
                if body is None:
                    self.send_error(404)
                    return
                self.send_response(200)
                length = server.promised.get(self.path, len(body))
                self.send_header("Content-Length", str(length))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.http = HTTPServer(("127.0.0.1", 0), Handler)
        self.thread = threading.Thread(target=self.http.serve_forever, args=(0.01,), daemon=True)
        self.thread.start()

    def url(self, path: str) -> str:
        return f"http://127.0.0.1:{self.http.server_port}{path}"

    def close(self) -> None:
        self.stop.set()
        self.http.shutdown()
        self.thread.join()
        self.http.server_close()


@pytest.fixture
def server():
    server = Server()
    yield server
    server.close()


def zipped(**members: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def store(server: Server, path: str = "/m.zip", **changes) -> dict[str, StoredModel]:
    fields = {"url": server.url(path), "sha256": None} | changes
    return {"tiny": StoredModel(**fields)}


def left_behind(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.rglob("*") if path.is_file())


def test_interrupted_download_leaves_nothing(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"m/end2end.onnx": network})

    def interrupt(*step):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        model_path("tiny", interrupt, models=store(server), cache=tmp_path / "cache")
    assert left_behind(tmp_path / "cache") == []


def test_network_is_downloaded_once_and_runs(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"20230605/m/end2end.onnx": network, "detail.json": b"{}"})
    steps = []
    models = store(server, sha256=hashlib.sha256(network).hexdigest())
    cache = tmp_path / "cache"
    path = model_path("tiny", lambda *step: steps.append(step), models=models, cache=cache)
    assert path == cache / "tiny.onnx" and path.read_bytes() == network
    size = len(server.files["/m.zip"])
    assert steps[-1] == ("download tiny", size, size)
    assert model_path("tiny", models=models, cache=cache) == path
    assert server.requests == ["/m.zip"]
    assert left_behind(cache) == ["tiny.onnx"]
    assert open_network(path).outputs[0].name == "a"


def test_plain_file_needs_no_archive(server, network, tmp_path):
    server.files["/m.onnx"] = network
    path = model_path(
        "tiny", models=store(server, "/m.onnx", member=None), cache=tmp_path / "cache"
    )
    assert path.read_bytes() == network


def test_wrong_checksum_keeps_nothing(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"end2end.onnx": network})
    with pytest.raises(InputError, match=r"SHA-256 of 'tiny' is .* expected 00; nothing was kept"):
        model_path("tiny", models=store(server, sha256="00"), cache=tmp_path / "cache")
    assert left_behind(tmp_path / "cache") == []


def test_unknown_checksum_is_recorded_and_a_later_change_noticed(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"end2end.onnx": network})
    cache = tmp_path / "cache"
    path = model_path("tiny", models=store(server), cache=cache)
    assert left_behind(cache) == ["tiny.onnx", "tiny.onnx.sha256"]
    model_path("tiny", models=store(server), cache=cache)
    path.write_bytes(network + b"x")
    with pytest.raises(InputError, match="delete the file, then fetch or import it again"):
        model_path("tiny", models=store(server), cache=cache)


def test_file_put_there_by_hand_is_taken(server, network, tmp_path):
    (tmp_path / "tiny.onnx").write_bytes(network)
    model_path("tiny", models=store(server), cache=tmp_path)
    assert server.requests == []


def test_truncated_download_is_not_kept(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"end2end.onnx": network})
    server.promised["/m.zip"] = 10**6
    with pytest.raises(InputError, match=r"ended after \d+ of 1000000 bytes"):
        model_path("tiny", models=store(server), cache=tmp_path / "cache")
    assert left_behind(tmp_path / "cache") == []


def test_not_found_says_how_to_help_oneself(server, tmp_path):
    cache = tmp_path / "cache"
    with pytest.raises(InputError) as caught:
        model_path("tiny", models=store(server), cache=cache)
    text = str(caught.value)
    assert "404" in text and server.url("/m.zip") in text
    assert str(cache / "tiny.onnx") in text and "path of any network file" in text


def test_unreachable_server_is_one_error(server, tmp_path):
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
    models = {"tiny": StoredModel(url=f"http://127.0.0.1:{port}/m.zip", sha256=None)}
    with pytest.raises(InputError, match="cannot download the network 'tiny'"):
        model_path("tiny", models=models, cache=tmp_path)


def test_silent_server_times_out(server, tmp_path):
    server.silent.add("/m.zip")
    with pytest.raises(InputError, match="timed out"):
        model_path("tiny", models=store(server), cache=tmp_path, timeout_s=0.2)


def test_archive_cannot_write_outside_the_cache(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"../../evil/end2end.onnx": network})
    cache = tmp_path / "deep" / "cache"
    assert model_path("tiny", models=store(server), cache=cache).parent == cache
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"<html>sign in</html>", "not a zip archive"),
        (zipped(readme=b""), "found 0: readme"),
        (zipped(**{"a/end2end.onnx": b"1", "b/end2end.onnx": b"2"}), "found 2"),
    ],
)
def test_archive_without_the_one_network_is_refused(server, tmp_path, body, message):
    server.files["/m.zip"] = body
    with pytest.raises(InputError, match=message):
        model_path("tiny", models=store(server), cache=tmp_path / "cache")
    assert left_behind(tmp_path / "cache") == []


def test_folder_that_cannot_be_written_is_named(server, network, tmp_path):
    server.files["/m.zip"] = zipped(**{"end2end.onnx": network})
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="set FUSECAP_CACHE"):
        model_path("tiny", models=store(server), cache=tmp_path / "file" / "cache")


def test_paths_and_names(tmp_path, network):
    (tmp_path / "own.onnx").write_bytes(network)
    assert model_path(str(tmp_path / "own.onnx")) == tmp_path / "own.onnx"
    with pytest.raises(InputError, match="no such file"):
        model_path(str(tmp_path / "none.onnx"))
    with pytest.raises(InputError, match="did you mean 'rtmpose-m-halpe26'"):
        model_path("rtmpose-m-halpe2")


def test_known_networks_are_whole():
    assert {DEFAULT_MODEL, DEFAULT_PERSON_MODEL} <= set(MODELS)
    for name, model in MODELS.items():
        assert (model.url is None) == bool(model.package), name
        if model.url is None:
            assert model.sha256 and model.suffix == ".tflite", name
            continue
        url = urlparse(model.url)
        assert url.scheme == "https" and url.path.endswith(".zip"), name
        assert "{" not in model.url and model.member == "end2end.onnx"
        assert model.sha256 is None or len(bytes.fromhex(model.sha256)) == 32
        assert model.about


def test_cache_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.delenv("FUSECAP_CACHE", raising=False)
    assert cache_dir() == tmp_path / "xdg" / "fusecap" / "models"
    monkeypatch.setenv("FUSECAP_CACHE", str(tmp_path / "own"))
    assert cache_dir() == tmp_path / "own" / "models"
    monkeypatch.delenv("FUSECAP_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_dir() == tmp_path / ".cache" / "fusecap" / "models"
