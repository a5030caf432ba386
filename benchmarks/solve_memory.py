"""Whether the memory of `fusecap solve` grows with the length of a session.

    uv run --frozen python benchmarks/solve_memory.py --minutes 2 8 30 [--recording]

The demo's two people with 13 sensors each in four cameras, simulated, to and fro for so many
minutes, as a session or as the recording of a live run; prints peak memory (Linux), seconds and how
many times real time.
"""

from __future__ import annotations

import argparse
import heapq
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.recording.setup_json import setup_values
from fusecap.recording.writer import RecordingWriter
from fusecap.setup import SessionSetup
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.types import CameraSample, ImuSample, Tick

Timed = CameraSample | ImuSample | Tick
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


def as_recording(folder: Path) -> Path:
    """What a live run of the session leaves, without poses."""
    data = open_session(load_session(folder))
    assert data.landmarks is not None
    setup = SessionSetup(
        session=data.session, rig=data.rig, landmarks=data.landmarks, simulated=True
    )

    def seen(camera: int) -> Iterator[Timed]:
        track = data.keypoints[camera]
        for row, time_s in enumerate(track.times_s):
            at_ns = round(1e9 * time_s)
            yield CameraSample(camera=camera, timestamp_ns=at_ns, people=track.people[row])

    def worn(subject: str, bone: str, track: ImuTrack) -> Iterator[Timed]:
        for row, time_s in enumerate(track.times_s):
            yield ImuSample(
                subject=subject,
                bone=bone,
                timestamp_ns=round(1e9 * time_s),
                orientation_wxyz=track.orientation_wxyz[row],
                accel_m_s2=track.accel_m_s2[row],
            )

    sources = [seen(camera) for camera in range(len(data.keypoints))]
    for subject in data.session.subjects:
        for imu, track in zip(subject.imus, data.samples[subject.name], strict=True):
            assert track is not None
            sources.append(worn(subject.name, imu.bone, track))
    ticks = (Tick(timestamp_ns=ns) for ns in data.timestamps_ns.tolist())
    path = folder / "run.mcap"
    with path.open("wb") as file:
        writer = RecordingWriter(
            file, setup_values(setup), cameras=setup.rig.names, unix_minus_session_ns=10**18
        )
        in_order = heapq.merge(*sources, ticks, key=lambda event: event.timestamp_ns)
        for number, event in enumerate(in_order):
            writer.event(event, event.timestamp_ns)
            if number % 900 == 899:  # half a second
                writer.flush()
        writer.finish()
    return path


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
    parser.add_argument("--recording", action="store_true")
    told = parser.parse_args()
    for minutes in told.minutes:
        with tempfile.TemporaryDirectory() as name:
            session = write_session(demo_scene(seconds=SECONDS), Path(name))
            lengthen(Path(name), minutes)
            solved = as_recording(Path(name)) if told.recording else session
            peak_mb, seconds = solve(solved)
        print(
            f"{minutes:5.1f} min  peak {peak_mb:6.0f} MB  {seconds:6.0f} s  "
            f"{minutes * 60 / seconds:.1f} times real time (two people)",
            flush=True,
        )


if __name__ == "__main__":
    main()
