"""Spoilt files through every reader: words or values, never another error, never for ever."""

from __future__ import annotations

import os
import time
import warnings
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from fusecap.errors import FusecapError
from hostile_files import seeds, spoilt

PER_KIND = int(os.environ.get("FUSECAP_FUZZ", "40"))
"""Spoilt files of each kind; thousands by hand."""
SLOW_S = 20.0
PROCESSES = ("gt.mat",)
"""Read by a process each, half a second: a tenth as many."""


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return seeds(tmp_path_factory.mktemp("sound"))


KINDS = (
    *("session.toml", "rig.toml", "rig.json", "rig.qca.txt", "sync.toml", "imu.toml", "off.toml"),
    *("board.toml", "points.csv", "stamps.csv", "take.npz", "prior.npz", "run.mcap", "video.mp4"),
    *("record.json", "motion.bvh", "gt.txt", "gt.mat", "data.pkl", "csv.csv", "xsens-dot.csv"),
    *("xsens-mt.csv", "sto.csv", "grey.png"),
)


def test_all_kinds_are_spoilt(sound):
    assert set(sound) - set(KINDS) == {name for name in sound if name.endswith("_keypoints.json")}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, "keypoints"])
def test_spoilt_files_end_in_words_or_values(sound, kind, tmp_path, capfd):
    name = kind if kind in sound else next(n for n in sound if n.endswith("_keypoints.json"))
    content, read = sound[name]
    path: Path = tmp_path / name
    path.write_bytes(content)
    read(path)
    random, faults, slowest_s = Random(kind), Counter[str](), 0.0
    for _ in range(PER_KIND // (10 if kind in PROCESSES else 1)):
        path.write_bytes(spoilt(content, random))
        started_s = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read(path)
        except FusecapError:
            pass
        except Exception as error:
            faults[f"{type(error).__name__}: {str(error)[:100]}"] += 1
        slowest_s = max(slowest_s, time.perf_counter() - started_s)
    assert faults == {}
    assert slowest_s < SLOW_S
