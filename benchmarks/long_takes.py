"""What looking at half an hour costs: a take and a recording of two people, at 60 Hz.

    uv run --frozen python benchmarks/long_takes.py --minutes 30 [--folder FOLDER]

The motion is made up (simulated). Prints seconds until `fusecap view` says where its page is, its
processor seconds and peak memory (Linux), and what a frame costs that somebody scrubs to. Files
stay in FOLDER where one is named, and are used again.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from exports import long_take

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.recording.setup_json import setup_values
from fusecap.recording.writer import RecordingWriter
from fusecap.setup import SessionSetup
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.stored_take import StoredTake
from fusecap.take import save_take
from fusecap.types import CameraSample, Estimate, ImuSample, Status, Tick
from fusecap.viewer.page import Page
from fusecap.viewer.take import TakePage

RATE_HZ = 60
SCRUBS = 300


def write_recording(path: Path, minutes: float) -> None:
    """As a live run with 4 cameras at 30 Hz and 26 sensors at 60 leaves it, all digits random."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        data = open_session(load_session(write_session(demo_scene(seconds=1.0), Path(folder))))
    assert data.landmarks is not None
    setup = SessionSetup(
        session=data.session, rig=data.rig, landmarks=data.landmarks, simulated=True
    )
    sensors = [(s.name, imu.bone) for s in setup.session.subjects for imu in s.imus]
    take = long_take(0.5)
    shapes = [BodyShape.from_height(PAPER21, height) for height in (1.65, 1.85)]
    with path.open("wb") as file:
        writer = RecordingWriter(
            file, setup_values(setup), cameras=setup.rig.names, unix_minus_session_ns=10**18
        )
        for frame in range(round(minutes * 60 * RATE_HZ)):
            now_ns = round(frame * 1e9 / RATE_HZ)
            for camera in range(len(setup.rig) if frame % 2 else 0):
                people = rng.uniform(0, 1000, (3, len(setup.landmarks.landmark_names), 3))
                writer.event(
                    CameraSample(camera=camera, timestamp_ns=now_ns, people=people), now_ns
                )
            for (subject, bone), numbers in zip(sensors, rng.normal(size=(26, 7)), strict=True):
                sample = ImuSample(
                    subject=subject,
                    bone=bone,
                    timestamp_ns=now_ns,
                    orientation_wxyz=numbers[:4] / np.linalg.norm(numbers[:4]),
                    accel_m_s2=numbers[4:],
                )
                writer.event(sample, now_ns)
            writer.event(Tick(timestamp_ns=now_ns, ahead=False), now_ns)
            row = frame % len(take.timestamps_ns)
            writer.poses(
                [
                    Estimate(
                        track_id=person,
                        name=setup.session.subjects[person].name,
                        timestamp_ns=now_ns,
                        theta=take.theta[person, row],
                        bone_position_in_world_m=take.bone_position_in_world_m[person, row],
                        bone_rotation_in_world=np.tile(np.eye(3), (21, 1, 1)),
                        bone_sigma_deg=rng.uniform(1, 9, 21),
                        position_sigma_m=rng.uniform(0.01, 0.05, 21),
                        shape=shape,
                        status=Status.CONVERGED,
                        iterations=3,
                        cost=1.0,
                        solve_s=1e-3,
                        views=np.ones(len(setup.rig), dtype=bool),
                        measured=True,
                    )
                    for person, shape in enumerate(shapes)
                ],
                now_ns,
            )
            if frame % 30 == 0:
                writer.flush()
        writer.finish()


def look(path: Path) -> str:
    """Starts `fusecap view` and ends it once its page is there."""
    began = time.perf_counter()
    command = [sys.executable, "-m", "fusecap", "view", str(path), "--no-browser", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    text = ""
    for line in process.stdout:
        text += line
        if line.startswith("}"):
            break
    up_s = time.perf_counter() - began
    json.loads(text)
    time.sleep(1)
    status = Path(f"/proc/{process.pid}/status").read_text()
    peak_kb = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM"))
    process.send_signal(signal.SIGINT)
    _, code, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(code)
    cpu_s = usage.ru_utime + usage.ru_stime
    return f"{up_s:.1f} | {cpu_s:.1f} | {int(peak_kb) / 1024:.0f}"


def scrubs_ms(path: Path) -> str:
    """Of a page without a browser: frames from anywhere, drawn and put into messages."""
    rng = np.random.default_rng(0)
    with StoredTake(path) as take:
        page = Page("benchmark")
        try:
            shown = TakePage(page, take)
            took_ms = []
            for frame in rng.integers(0, len(take.timestamps_ns), SCRUBS):
                began = time.perf_counter()
                shown._draw(int(frame), float(take.time_s[frame]), plots=True)
                took_ms.append(1e3 * (time.perf_counter() - began))
        finally:
            page.stop()
    return f"{np.median(took_ms):.1f} | {np.percentile(took_ms, 95):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--folder", type=Path)
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = told.folder or Path(scratch)
        take, recording = folder / "long.npz", folder / "long.mcap"
        if not take.exists():
            save_take(long_take(told.minutes), take)
        if not recording.exists():
            write_recording(recording, told.minutes)
        print("| `fusecap view` of | MB | up after s | CPU s | peak MB |\n|---|---|---|---|---|")
        for path in (take, recording):
            print(f"| {path.name} | {path.stat().st_size / 1e6:.0f} | {look(path)} |", flush=True)
        print("\n| scrubbing | median ms | p95 |\n|---|---|---|")
        print(f"| {take.name} | {scrubs_ms(take)} |")


if __name__ == "__main__":
    main()
