"""Blender's own opinion on our BVH files; needs a Python with bpy, in its own environment.

uv venv bpy-env --python 3.11 && uv pip install --python bpy-env "bpy==4.5.*"
FUSECAP_BPY_PYTHON=bpy-env/bin/python uv run pytest tests/test_bvh_blender.py
"""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.exports.take_files import export_take
from motions import any_poses, person, take_of, walk

SCRIPT = Path(__file__).parent / "blender" / "check_bvh.py"


@pytest.fixture
def bpy_python() -> str:
    python = os.environ.get("FUSECAP_BPY_PYTHON")
    if not python:
        pytest.skip("FUSECAP_BPY_PYTHON does not name a Python with bpy")
    return python


@pytest.mark.slow
@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
def test_blender_puts_every_joint_where_the_take_has_it(tmp_path, rng, bpy_python, skeleton):
    shapes = [person(1.6, skeleton), person(1.9, skeleton)]
    theta = np.stack([any_poses(rng, skeleton, 200), walk(shapes[1], 200)])
    take = take_of(theta, shapes, names=("anna", "ben"))
    expected = {}
    for subject, path in enumerate(export_take(take, tmp_path, format="bvh", stem="take")):
        expected[f"path_{subject}"] = str(path)
        expected[f"bones_{subject}"] = np.array(take.bone_names)
        expected[f"position_m_{subject}"] = take.bone_position_in_world_m[subject]
    np.savez(tmp_path / "expected.npz", **expected)
    run = subprocess.run(
        [bpy_python, str(SCRIPT), str(tmp_path / "expected.npz")],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    reports = [json.loads(line) for line in run.stdout.splitlines() if line.startswith("{")]
    assert len(reports) == 2
    for report in reports:
        assert report["frames"] == 200
        assert report["max_error_mm"] < 1.0, report
