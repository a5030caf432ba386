"""Blender, where there is one: for FBX, which no library writes as well.

It is the one that FUSECAP_BLENDER names, else `blender` on the PATH, else this Python where it has
`bpy`.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from fusecap.errors import InputError

VARIABLE = "FUSECAP_BLENDER"


def run_in_blender(script: str, told: Mapping[str, Any], makes: Path) -> None:
    """Runs a script that knows `told`; raises `InputError` unless it made a file."""
    command = blender_command()
    text = f"import bpy, json\ntold = json.loads({json.dumps(dict(told))!r})\n{script}"
    try:
        run = subprocess.run([*command, text], capture_output=True, text=True, check=False)
    except OSError as error:
        raise InputError(f"cannot run {command[0]}: {error.strerror or error}") from error
    if not makes.exists():
        last = (run.stderr.strip() or run.stdout.strip() or "no word").splitlines()[-1]
        raise InputError(f"{command[0]} wrote no {makes.suffix.upper()[1:]}: {last}")


def blender_command() -> list[str]:
    """What runs a script that follows as the last argument."""
    named = os.environ.get(VARIABLE) or shutil.which("blender")
    if not named and find_spec("bpy") is not None:
        named = sys.executable
    if not named:
        raise InputError(
            "FBX needs Blender, and there is none: install Blender 4.2 or newer so that `blender` "
            f"runs, or set {VARIABLE} to its program or to a Python that has bpy (pip install "
            "bpy); GLB needs neither"
        )
    if Path(named).name.startswith("python"):
        return [named, "-c"]
    return [named, "--background", "--factory-startup", "--python-expr"]
