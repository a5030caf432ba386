"""Examples run as they are."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.mark.parametrize("name", ["own_detections.py", "solver_as_a_library.py"])
def test_example_runs_and_says_what_it_did(name):
    result = subprocess.run(
        [sys.executable, EXAMPLES / name], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    assert "mean joint position error" in result.stdout
