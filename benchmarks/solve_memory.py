"""Whether the memory of `fusecap solve` grows with the length of a session.

    uv run --frozen python benchmarks/solve_memory.py --minutes 2 8 30

The demo's two people with 13 sensors each in four cameras, simulated, to and fro for so many
minutes; prints peak memory (Linux), seconds and how many times real time.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session

SECONDS, RATE_HZ = 10.0, 60


def lengthen(folder: Path, minutes: float) -> None:
    """More frames, as links, and samples of every sensor: backwards, forwards, ..."""
    for file in sorted((folder / "imus").glob("*.csv")):
        head, *rows = file.read_text().splitlines()
        cells = [row.split(",", 1) for row in rows]
        there = {round(float(time_s) * RATE_HZ): rest for time_s, rest in cells}
        last = round(SECONDS * RATE_HZ) - 1
        with file.open("w") as out:
            print(head, file=out)
            for number in range(round(RATE_HZ * minutes * 60)):
                turn, row = divmod(number, last)
                row = last - row if turn % 2 else row
                if row in there:
                    print(f"{number / RATE_HZ:.6f},{there[row]}", file=out)
    for camera in sorted((folder / "keypoints").iterdir()):
        frames = sorted(camera.glob("*.json"))
        last = len(frames) - 1
        for number in range(last + 1, round(len(frames) * minutes * 60 / SECONDS)):
            turn, row = divmod(number, last)
            source = frames[last - row if turn % 2 else row]
            os.link(source, camera / f"frame_{number:012d}_keypoints.json")


def solve(session: Path) -> tuple[float, float]:
    """Peak memory [MB] and seconds."""
    began = time.perf_counter()
    run = subprocess.Popen(
        [sys.executable, "-m", "fusecap", "solve", str(session), "--json", "--anyway"],
        stdout=subprocess.DEVNULL,
    )
    _, status, usage = os.wait4(run.pid, 0)
    if status:
        raise SystemExit(f"fusecap solve failed with {os.waitstatus_to_exitcode(status)}")
    return usage.ru_maxrss / 1024, time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, nargs="+", default=[1.0, 4.0])
    for minutes in parser.parse_args().minutes:
        with tempfile.TemporaryDirectory() as name:
            session = write_session(demo_scene(seconds=SECONDS), Path(name))
            lengthen(Path(name), minutes)
            peak_mb, seconds = solve(session)
        print(
            f"{minutes:5.1f} min  peak {peak_mb:6.0f} MB  {seconds:6.0f} s  "
            f"{minutes * 60 / seconds:.1f} times real time (two people)",
            flush=True,
        )


if __name__ == "__main__":
    main()
