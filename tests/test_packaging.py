"""What somebody gets who installs: the files of the wheel and of the sdist, and what they say."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.message import Message
from email.parser import BytesParser
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def build(folder: Path, out: Path, target: str) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(out)]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    (made,) = out.glob("*.whl" if target == "wheel" else "*.tar.gz")
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return build(ROOT, tmp_path_factory.mktemp("wheel"), "wheel")


def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as files:
        return {name for name in files.namelist() if ".dist-info/" not in name}


def read(wheel: Path, name: str) -> bytes:
    with zipfile.ZipFile(wheel) as files:
        (path,) = (n for n in files.namelist() if n.endswith(f".dist-info/{name}"))
        return files.read(path)


@pytest.fixture
def about(wheel) -> Message:
    return BytesParser().parsebytes(read(wheel, "METADATA"))


def test_the_wheel_has_every_file_of_the_package_and_nothing_else(wheel):
    package = ROOT / "src" / "fusecap"
    files = (path for path in package.rglob("*") if path.is_file() and path.suffix != ".pyc")
    # Numba keeps what it compiled beside the bytecode.
    assert names(wheel) == {
        path.relative_to(package.parent).as_posix()
        for path in files
        if "__pycache__" not in path.parts
    }
    assert b"fusecap = fusecap.cli:main" in read(wheel, "entry_points.txt")
    assert b"BSD 3-Clause" in read(wheel, "licenses/LICENSE")


def test_the_sdist_is_the_repository_and_makes_the_same_wheel(wheel, tmp_path):
    with tarfile.open(build(ROOT, tmp_path / "sdist", "sdist")) as files:
        files.extractall(tmp_path, filter="data")
    (folder,) = (path.parent for path in tmp_path.glob("*/PKG-INFO"))
    top = {path.name for path in folder.iterdir()}
    assert {"src", "tests", "docs", "examples", "benchmarks", "check", "uv.lock"} <= top
    assert not top & {".ci", ".git", ".venv", ".uv", "dist", "demo"}
    assert not list(folder.rglob("*.pyc"))
    assert names(build(folder, tmp_path / "again", "wheel")) == names(wheel)


def test_metadata_say_whose_it_is_what_it_needs_and_where_to_read(about):
    assert about["Author"] == "the fusecap authors"
    assert about["License-Expression"] == "BSD-3-Clause"
    assert [url.partition(", ")[0] for url in about.get_all("Project-URL") or ()] == ["Paper"]
    assert set(about.get_all("Provides-Extra") or ()) == set(PROJECT["optional-dependencies"])
    assert about["Description-Content-Type"] == "text/markdown"
    assert str(about.get_payload()).startswith("# fusecap")


def test_pythons_named_are_those_allowed(about):
    """The oldest that is allowed, and each that is named."""
    prefix = "Programming Language :: Python :: 3."
    named = [c.removeprefix(prefix) for c in about.get_all("Classifier") if c.startswith(prefix)]
    assert about["Requires-Python"] == f">=3.{named[0]}"
