"""How long exports take and how big they are: two people who walk, at 60 Hz.

    uv run --frozen python benchmarks/exports.py --minutes 30 [--formats glb,csv]

The motion is made up (simulated), every joint moves. Prints seconds, those of them that processors
worked (Blender's too), megabytes and the peak memory of each format, each in a process of its own
that reads the take from its file; then of one person's motion onto a character.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.exports.characters.retarget import retarget
from fusecap.exports.formats import FORMATS
from fusecap.exports.take_files import export_take
from fusecap.exports.take_format import ExportOptions
from fusecap.stored_take import StoredTake
from fusecap.take import Take, save_take, take_from_theta


def long_take(minutes: float, rate_hz: float = 60.0) -> Take:
    frames = round(minutes * 60 * rate_hz)
    time_s = np.arange(frames) / rate_hz
    shapes = [BodyShape.from_height(PAPER21, height) for height in (1.65, 1.85)]
    rng = np.random.default_rng(0)
    theta = np.empty((2, frames, PAPER21.pose_size))
    for person, shape in enumerate(shapes):
        size, speed, phase = rng.uniform(0.1, 1.0, (3, PAPER21.pose_size))
        theta[person] = 0.5 * size * np.sin(6 * speed * time_s[:, None] + 6 * phase)
        theta[person, :, 1] = shape.standing_root_height_m
    return take_from_theta(
        theta,
        shapes,
        timestamps_ns=np.round(time_s * 1e9).astype(np.int64),
        rate_hz=rate_hz,
        subject_names=("anna", "ben"),
        skeleton=PAPER21,
        provenance={"simulated": True},
    )


def write(name: str, stored: Path, folder: str) -> list[Path]:
    """What is written in a format, or for "onto.glb" and "onto.fbx" of one person's motion."""
    with StoredTake(stored) as take:
        take.check()
        if name.startswith("onto."):
            still = take.of_frames(0, 1)
            (avatar,) = export_take(still, folder, format="glb", stem="c", rig="mixamo")
            return [retarget(take, avatar, Path(folder) / name, subject="anna").path]
        options = ExportOptions()
        if name == "openpose":
            options = ExportOptions(cameras=demo_scene(0, seconds=0.1).rig)
        return export_take(take, folder, format=name, stem="t", options=options)


def measure(name: str, stored: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        began, worked_before_s = time.perf_counter(), _worked_s()
        paths = write(name, stored, folder)
        took_s = time.perf_counter() - began
        worked_s = _worked_s() - worked_before_s
        files = [f for path in paths for f in (path.rglob("*") if path.is_dir() else [path])]
        size_mb = sum(f.stat().st_size for f in files if f.is_file()) / 1e6
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name:9} {took_s:7.1f} s {worked_s:7.1f} s worked {size_mb:8.1f} MB "
        f"{memory_mb:8.0f} MB memory",
        flush=True,
    )


def _worked_s() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def store(minutes: float, path: Path) -> None:
    save_take(long_take(minutes), path)


def in_a_process(work: Callable[..., None], *arguments: object) -> bool:
    """Of its own, so that its peak memory is its own too; whether it ended well."""
    child = multiprocessing.get_context("spawn").Process(target=work, args=arguments)
    child.start()
    child.join()
    return child.exitcode == 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--formats", default=",".join([*FORMATS, "onto.glb", "onto.fbx"]))
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / "t.npz"
        in_a_process(store, told.minutes, stored)
        for name in told.formats.split(","):
            if not in_a_process(measure, name, stored):
                print(f"{name:9} failed", file=sys.stderr)


if __name__ == "__main__":
    main()
