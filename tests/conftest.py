"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

settings.register_profile("fusecap", deadline=None, derandomize=True)
settings.load_profile("fusecap")
# A shell lets what it puts into the background ignore Ctrl-C, which tests and their children press.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real recordings; tests that ask for it skip where it is absent."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("FUSECAP_DATA", root.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder} (set FUSECAP_DATA)")
    return folder
