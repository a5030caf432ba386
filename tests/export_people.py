"""Two people for tests of exports, and what readers must find."""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.take import Take
from motions import person, take_of, walk

READERS = Path(__file__).parent / "readers"
NEAR_M, NEAR_DEG = 1e-3, 0.1
"""What every reader finds lies within these of the take."""


def two_walkers(
    frames: int = 40, *, skeleton: Skeleton = PAPER21, names: tuple[str, str] = ("anna", "ben")
) -> Take:
    """A short and a tall one who move every joint."""
    rng = np.random.default_rng(5)
    shapes = [person(1.5, skeleton), person(1.9, skeleton)]
    theta = np.stack([walk(shapes[0], frames), walk(shapes[1], frames, phase_rad=1.0)])
    swing = np.sin(np.linspace(0, 3, frames))[None, :, None]
    theta[:, :, 3:] += swing * rng.uniform(-0.4, 0.4, (2, 1, theta.shape[2] - 3))
    theta[1, :, 0] += 1.5
    return take_of(theta, shapes, names=names)


def with_gap(take: Take, gap, subject: int = 0) -> Take:
    """The same take, in which somebody is not tracked for a while."""
    tracked = take.tracked.copy()
    tracked[subject, gap] = False
    hole = {}
    for name in ("theta", "bone_position_in_world_m", "bone_rotation_in_world_wxyz"):
        values = getattr(take, name).copy()
        values[subject, gap] = np.nan
        hole[name] = values
    return replace(take, tracked=tracked, **hole)


def degrees_apart(one: np.ndarray, other: np.ndarray) -> float:
    """The largest angle between unit quaternions of one order (..., 4)."""
    cosine = np.abs((one * other).sum(axis=-1)).clip(0, 1)
    return float(np.degrees(2 * np.arccos(cosine)).max())


def environment(variable: str, module: str) -> str:
    """A Python that has `module`, in an environment of its own."""
    python = os.environ.get(variable)
    if not python:
        pytest.skip(f"{variable} does not name a Python with {module}")
    return python


def run_reader(python: str, script: str, *arguments: object) -> dict:
    """The last line a reader prints, as JSON."""
    run = subprocess.run(
        [python, str(READERS / script), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout.splitlines()[-1])
