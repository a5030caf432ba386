"""Examples run as they are."""

from __future__ import annotations

import re
import runpy
import socket
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def last_numbers(said: str) -> list[float]:
    """Of the last line."""
    return [float(number) for number in re.findall(r"\d+\.?\d*", said.splitlines()[-1])]


@pytest.fixture
def said_by(monkeypatch, capsys):
    """What an example prints; in this process, where the kernels are loaded."""

    def run(name: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run


def test_own_detections_become_poses_on_a_websocket(said_by):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    said = said_by("1_own_detections.py", f"ws://127.0.0.1:{port}")
    assert len(said.splitlines()) == 2
    assert last_numbers(said)[-1] < 40  # mm


def test_own_detector_finds_people_in_pictures(said_by):
    poses, error_mm = last_numbers(said_by("2_own_detector.py"))
    assert poses > 100 and error_mm < 40


def test_own_source_feeds_a_live_run(said_by):
    said = said_by("3_own_source.py")
    assert "anna: a pose in" in said and "ben: a pose in" in said


def test_own_sink_hears_every_instant(said_by):
    said = said_by("4_own_sink.py")
    assert '"who": "anna"' in said


def test_own_cost_term_moves_the_pose(said_by):
    bent_deg, straight_deg = last_numbers(said_by("5_own_cost_term.py"))
    assert bent_deg > 20 and straight_deg < 8


def test_the_solver_alone_is_a_library(said_by):
    assert last_numbers(said_by("6_solver_as_a_library.py"))[-1] < 40  # mm


def test_every_numbered_example_is_run_here_and_told_of_in_the_docs():
    numbered = sorted(path.name for path in EXAMPLES.glob("[0-9]*.py"))
    run_here = re.findall(r'said_by\("(\d\w+\.py)"', Path(__file__).read_text(encoding="utf-8"))
    page = (EXAMPLES.parent / "docs" / "examples.md").read_text(encoding="utf-8")
    assert sorted(run_here) == numbered
    assert all(f"`{name}`" in page for name in numbered)
