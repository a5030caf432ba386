"""A live run by its numbers: from exposure to packet, per stage, on this machine.

    uv run python benchmarks/live_latency.py [--seconds 60] [--only outside] [--json FILE]

Four cameras, two people, and streams to VMC, WebSocket, OSC and Live Link at once while everything
is recorded:

    outside     simulated: keypoints at 60 Hz from cameras that are not in step, 13 IMUs each
    memory      Pose2Sim's videos at 30 Hz, decoded before the run as if a camera delivered
                pictures; networks in the loop
    decoding    the same, decoded in the loop
    simulated   numbered pictures and a simulated detector of measured cost; in place of the two
                above where videos or networks are missing

Prints Markdown. Times are of the whole run, its first seconds included. UDP receivers do not read,
the WebSocket client reads in a process of its own; processor time is of fusecap's process alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from live_scenes import (
    CLIP,
    PERSON_MODEL,
    POSE_MODEL,
    AsPictures,
    SimulatedDetector,
    clip_session,
    clip_videos,
    networks,
    reading_client,
    receivers,
    round_trip,
    send_to,
    simulated_session,
    work_like_networks,
)

from fusecap.live.devices.playback_sources import PlaybackOptions, playback_sources
from fusecap.live.devices.source import SessionClock
from fusecap.live.recorder import Recorder
from fusecap.live.report import LiveReport
from fusecap.live.run import LiveOptions, LiveRun
from fusecap.setup import session_setup
from fusecap.sources.session_file import load_session

Prepare = Callable[[Path, argparse.Namespace], LiveRun]


def outside(folder: Path, arguments: argparse.Namespace) -> LiveRun:
    session, clock = load_session(simulated_session(folder)), SessionClock()
    sources = playback_sources(session, clock, PlaybackOptions(there_and_back=True))
    return LiveRun(
        session_setup(session, simulated=True), sources, None, LiveOptions(), clock=clock
    )


def memory(folder: Path, arguments: argparse.Namespace) -> LiveRun:
    options = PlaybackOptions(there_and_back=True, in_memory=True, image_rate_hz=30.0)
    return _clip(clip_session(folder, clip_videos()), options, arguments)


def decoding(folder: Path, arguments: argparse.Namespace) -> LiveRun:
    videos = [round_trip(video, folder) for video in clip_videos()]
    return _clip(clip_session(folder, videos), PlaybackOptions(loop=True), arguments)


def _clip(path: Path, options: PlaybackOptions, arguments: argparse.Namespace) -> LiveRun:
    session, clock = load_session(path), SessionClock()
    detector = networks(arguments.threads)
    sources = playback_sources(session, clock, options)
    setup = session_setup(session, detector.landmarks)
    delay = LiveOptions(delay_s=arguments.delay)
    return LiveRun(setup, sources, detector, delay, clock=clock)


def simulated(folder: Path, arguments: argparse.Namespace) -> LiveRun:
    session, clock = load_session(simulated_session(folder)), SessionClock()
    subjects = tuple(subject.model_copy(update={"imus": ()}) for subject in session.subjects)
    session = session.model_copy(update={"subjects": subjects})
    setup = session_setup(session, simulated=True)
    seen: dict[int, np.ndarray] = {}
    sources = [
        AsPictures(source, seen, (1920, 1080))
        for source in playback_sources(session, clock, PlaybackOptions(there_and_back=True))
    ]
    detector = SimulatedDetector(setup.landmarks, seen, work_like_networks)
    return LiveRun(setup, sources, detector, LiveOptions(delay_s=arguments.delay), clock=clock)


MODES: dict[str, Prepare] = {
    "outside": outside,
    "memory": memory,
    "decoding": decoding,
    "simulated": simulated,
}


def measured(mode: str, arguments: argparse.Namespace) -> LiveReport:
    with (
        tempfile.TemporaryDirectory() as name,
        receivers("vmc", "ws", "osc", "livelink") as targets,
    ):
        run = MODES[mode](Path(name), arguments)
        send_to(run, targets)
        run.add_listener(Recorder(Path(name) / "run.mcap", run.setup, run.clock))
        with reading_client(str(targets[1])):
            return run.run(arguments.seconds)


def table(mode: str, report: LiveReport) -> str:
    """The report as Markdown."""
    inputs = [source for source in report.inputs if source.kind == "camera"]
    seen = {
        name: f"{100 * subject.measured_share:.1f} % (bones +- {subject.bone_sigma_deg:.1f} deg)"
        for name, subject in report.subjects.items()
    }
    rows = [
        f"\n### {mode}{' (simulated)' if report.simulated else ''}, {report.elapsed_s:.0f} s\n",
        "| | p50 ms | p95 ms | p99 ms | count |\n|---|---|---|---|---|",
        *(
            f"| {stage.stage} | {stage.p50_ms:.2f} | {stage.p95_ms:.2f} | {stage.p99_ms:.2f} "
            f"| {stage.count} |"
            for stage in report.latency
        ),
        "\n| | |\n|---|---|",
        f"| delay from exposure to solve | {1e3 * report.delay_s:.0f} ms"
        f"{', sooner where all is there' if report.eager else ''} |",
        f"| detections per second | {report.detections_per_s:.1f} |",
        f"| solves per second | {report.solves_per_s:.2f} |",
        f"| packets per second and person | {report.packets_per_s:.2f} |",
        f"| instants late or skipped | {100 * report.late_share:.2f} % "
        f"({report.skipped} skipped) |",
        f"| instants with samples on both sides in every camera "
        f"| {100 * report.complete_share:.1f} % |",
        f"| images overtaken by newer ones | {sum(source.dropped for source in inputs)} of "
        f"{sum(source.received for source in inputs)} |",
        f"| samples dropped | {report.events_dropped} |",
        *(f"| {name} measured | {share} |" for name, share in seen.items()),
        f"| recorded | {sum(recording.megabytes for recording in report.recordings):.1f} MB |",
        f"| processor | {report.cpu_share:.2f} cores |",
        f"| memory at the end, largest | {report.memory_mb:.0f}, {report.memory_peak_mb:.0f} MB |",
        f"| load of the machine | {os.getloadavg()[0]:.1f} |",
    ]
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--only", choices=MODES, nargs="+", help="default: all that can be run")
    parser.add_argument("--threads", type=int, default=2, help="of the networks")
    parser.add_argument("--delay", type=float, default=None, metavar="S")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    real = CLIP.is_dir() and POSE_MODEL.is_file() and PERSON_MODEL.is_file()
    modes = arguments.only or ["outside", *(["memory", "decoding"] if real else ["simulated"])]
    reports = {}
    for mode in modes:
        report = measured(mode, arguments)
        reports[mode] = report.as_json()
        print(table(mode, report), flush=True)
        for incident in report.incidents:
            print(f"    {incident.time_s:7.2f} s  {incident.what}", file=sys.stderr)
    if arguments.json:
        arguments.json.write_text(json.dumps(reports, indent=1))


if __name__ == "__main__":
    main()
