"""The pages: links hold, commands exist, the first steps run as they are printed."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from doc_commands import PAGES, ROOT, blocks, commands, commands_in, words
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.motion_model import load_demo_motion
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.cli import app
from fusecap.evaluate.imu_noise import IMUS_6
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulator import Person, camera_ring, simulate

STARTS = [page for page in PAGES if page.name.startswith("start_")]


def test_the_site_builds_with_every_link_and_page(tmp_path):
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert built.returncode == 0, built.stderr
    assert len(list(tmp_path.glob("*.html"))) >= len(PAGES) - 1


@cache
def command_line() -> Any:
    """As typer makes it for its parser."""
    return typer.main.get_command(app)


def misuse(command: str) -> str:
    """What the command line would say of options and commands that it does not have."""
    here, rest = command_line(), words(command)
    while rest and hasattr(here, "commands") and not rest[0].startswith("-"):
        if rest[0].isupper():  # stands for several
            return ""
        if rest[0] not in here.commands:
            return f"no command {rest[0]}"
        here = here.commands[rest.pop(0)]
    context = here.context_class(here, info_name=command)
    try:
        _, left, _ = here.make_parser(context).parse_args(rest)
    except Exception as error:  # of click, which typer keeps to itself
        # A sentence may name an option without its value.
        return "" if "requires an argument" in str(error) else str(error)
    return f"more than it takes: {left}" if left and not hasattr(here, "commands") else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_of_a_page_are_those_of_the_command_line(page):
    wrong = {command: said for command in commands(page) if (said := misuse(command))}
    assert not wrong


def test_misuse_is_seen():
    assert "hurry" in misuse("fusecap solve duo --hurry")
    assert misuse("fusecap resolve duo") == "no command resolve"
    assert "more" in misuse("fusecap view duo trio")
    assert not misuse("fusecap calibrate --help") and not misuse("fusecap solve duo --anyway")


def own_recording(folder: Path) -> None:
    """Keypoints for videos, cameras, and sensors of which nothing is known but their files."""
    motion = load_demo_motion()
    shape = BodyShape.from_height(PAPER21, REFERENCE_HEIGHT_M)
    anna = Person(name="anna", shape=shape, theta=motion.theta[0, :400], imu_bones=IMUS_6)
    made = simulate(
        [anna], camera_ring(4), landmark_set_named("body25"), rate_hz=motion.rate_hz, seed=0
    )
    write_session(made, folder)
    (folder / "session.toml").unlink()


def test_the_first_steps_run_as_printed(tmp_path_factory, monkeypatch):
    """Every command and every piece of Python of the three pages, one after the other."""
    monkeypatch.chdir(tmp_path_factory.mktemp("first"))
    own_recording(Path("trial"))
    done: set[str] = set()
    for page in STARTS:
        for block in blocks(page):
            if block.language == "python" and not block.text.startswith("# needs"):
                exec(compile(block.text, page.name, "exec"), {})
            for command, said in commands_in(block.text) if block.language == "sh" else ():
                if said.startswith("needs") or command in done:
                    continue
                done.add(command)
                ended = CliRunner().invoke(app, words(command))
                assert ended.exit_code == 0, (page.name, command, ended.output, ended.exception)
    made = {path.name for path in Path("scene").iterdir()}
    assert {"demo.glb", "demo_anna.trc", "demo_angles.csv", "demo_angles_anna.png"} <= made
    assert "imu_calibration.toml" in Path("trial/session.toml").read_text()
    assert {"trial_angles.csv", "trial_subject.c3d"} <= {
        path.name for path in Path("trial").iterdir()
    }
    assert len(done) == 16
