"""A long live run in which everything goes wrong that can, and what became of it.

    uv run python benchmarks/live_soak.py --minutes 30 [--seed 0] [--json FILE]

Simulated: two people with 13 IMUs each before four cameras of 60 Hz, a bystander, and a detector
that knows the truth and sleeps 20 ms. One after the other a camera or all of them stall or die, IMU
packets are lost, doubled and out of order, sensors fall silent, nothing at all arrives, clocks jump
forwards and backwards, values are not numbers, the detector raises or takes long. All the while a
WebSocket client does not read and nobody listens to one of the UDP streams; at some time the disk
of the recording is full, and another recording begins.

Checks, and ends with exit code 1 where one fails: people are measured again, at their place and
with four fifths of the quality before, within 2 s of a fault's end; nobody whom two views see is
followed wrongly for longer; nothing that is sent is NaN, nobody jumps; memory, threads and open
files do not grow; the engine never raised.
"""

from __future__ import annotations

import argparse
import errno
import io
import json
import os
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from live_faults import Fault, FaultKind, FaultyDetector, with_faults
from live_scenes import AsPictures, SimulatedDetector, receivers, send_to, simulated_session

from fusecap.engine.engine import LiveStep
from fusecap.live.devices.playback_sources import PlaybackOptions, playback_sources
from fusecap.live.devices.source import SessionClock
from fusecap.live.recorder import Recorder
from fusecap.live.report import LiveReport
from fusecap.live.run import LiveOptions, LiveRun
from fusecap.live.status import LiveStatus
from fusecap.setup import session_setup
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take
from fusecap.take import Take
from fusecap.types import CameraImage, Event

RATE_HZ = 60
FIRST_FAULT_S = 10.0
QUIET_S = 4.0
"""Between the end of a fault and the next one."""
STEADY_S = 0.25
"""For how long a person must be well to count as recovered."""
AT_ITS_PLACE_M = 0.15
QUALITY_SHARE = 0.8
JUMP_M = 0.25
"""Of the hips from one instant to the next: 15 m/s."""
WARM_UP_SHARE = 0.2
"""Of the run, before memory is compared."""
MOST_GROWTH = 0.1


def schedule(seconds: float, seed: int) -> list[Fault]:
    """Faults one after the other until shortly before the end, every kind in each round."""
    rng = np.random.default_rng(seed)
    faults: list[Fault] = []
    start_s = FIRST_FAULT_S
    while True:
        camera = f"camera 'cam{rng.integers(1, 5)}'"
        sensor = f"{rng.choice(['anna', 'ben'])}/{rng.choice(['left_forearm', 'right_shank'])}"
        imus = f"imus of '{rng.choice(['anna', 'ben'])}'"
        kinds: list[tuple[FaultKind, str, float, float]] = [
            (FaultKind.STALL, camera, 3.0, 1.0),
            (FaultKind.DEATH, camera, 3.0, 1.0),
            (FaultKind.LOSS, imus, 3.0, 0.3),
            (FaultKind.DOUBLE, imus, 2.0, 0.5),
            (FaultKind.DISORDER, imus, 3.0, 0.5),
            (FaultKind.STALL, sensor, 3.0, 1.0),
            (FaultKind.DEATH, imus, 3.0, 1.0),
            (FaultKind.CLOCK_JUMP, camera, 3.0, 5.0),
            (FaultKind.CLOCK_JUMP, camera, 3.0, -3.0),
            (FaultKind.CLOCK_JUMP, imus, 3.0, 5.0),
            (FaultKind.CLOCK_JUMP, imus, 3.0, -3.0),
            (FaultKind.NOT_A_NUMBER, "", 2.0, 0.5),
            (FaultKind.RAISE, "detector", 2.0, 1.0),
            (FaultKind.SLOW, "detector", 3.0, 0.3),
            (FaultKind.DEATH, "cameras", 2.0, 1.0),
            (FaultKind.STALL, "", 2.0, 1.0),
        ]
        for number in rng.permutation(len(kinds)):
            kind, where, length_s, amount = kinds[number]
            if start_s + length_s + QUIET_S > seconds:
                return faults
            faults.append(
                Fault(kind=kind, where=where, start_s=start_s, length_s=length_s, amount=amount)
            )
            start_s += length_s + QUIET_S


class Watch:
    """A listener that keeps what is sent of each person, in arrays made before."""

    def __init__(self, names: list[str], seconds: float) -> None:
        count = round((seconds + 60) * RATE_HZ)
        self.names = names
        self.count = 0
        self.times_ns = np.zeros(count, np.int64)
        self.measured = np.zeros((count, len(names)), np.bool_)
        self.seen = np.zeros((count, len(names)), np.bool_)
        """By two views or more."""
        self.quality = np.zeros((count, len(names)))
        self.hips_m = np.full((count, len(names), 3), np.nan)
        self.not_finite = 0

    def on_event(self, event: Event, arrival_ns: int) -> None:
        pass

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        row = self.count
        if row == len(self.times_ns):
            return
        solved = {estimate.name: estimate for estimate in step.step.estimates}
        self.times_ns[row] = step.timestamp_ns
        for place, name in enumerate(self.names):
            estimate = step.people.get(name)
            if estimate is None:
                continue
            self.measured[row, place] = name in solved
            self.seen[row, place] = name in solved and solved[name].views.sum() > 1
            self.quality[row, place] = estimate.bone_quality.mean()
            self.hips_m[row, place] = estimate.bone_position_in_world_m[0]
            self.not_finite += not (
                np.isfinite(estimate.bone_position_in_world_m).all()
                and np.isfinite(estimate.bone_rotation_in_world).all()
                and np.isfinite(estimate.bone_quality).all()
            )
        self.count += 1

    def on_image(self, image: CameraImage) -> None:
        pass

    def on_status(self, status: LiveStatus) -> None:
        pass

    def worst_jump_m(self) -> float:
        """The longest way of anybody's hips from one instant to the next, at an even pace."""
        instants = np.diff(self.times_ns[: self.count])[:, None] * 1e-9 * RATE_HZ
        way_m = np.linalg.norm(np.diff(self.hips_m[: self.count], axis=0), axis=2)
        return float(np.nanmax(way_m / instants))

    def close(self) -> None:
        pass


@dataclass
class Resources:
    """Of the process, second by second."""

    times_s: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)
    files: list[int] = field(default_factory=list)

    def look(self, now_s: float) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        self.times_s.append(now_s)
        self.memory_mb.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
        self.threads.append(threading.active_count())
        self.files.append(len(os.listdir("/proc/self/fd")))

    def growth(self) -> float:
        """Of memory after the warm-up, by a straight line through it, as a share."""
        first = int(WARM_UP_SHARE * len(self.times_s))
        times_s, memory_mb = np.array(self.times_s[first:]), np.array(self.memory_mb[first:])
        slope = np.polyfit(times_s - times_s[0], memory_mb, 1)[0]
        return float(slope * (times_s[-1] - times_s[0]) / memory_mb.mean())


class FullDisk(io.FileIO):
    """A file on a disk that has room for so many bytes."""

    def __init__(self, path: Path, room_bytes: int) -> None:
        super().__init__(path, "xb")
        self._room_bytes = room_bytes

    def write(self, data: Any, /) -> int:
        if self.tell() + len(data) > self._room_bytes:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


@dataclass(frozen=True, kw_only=True)
class Recovery:
    """How a fault went."""

    fault: Fault
    worst_quality: float
    """Of the share before, while it lasted and until recovery; the worst of the people."""
    recovered_s: float | None
    """After its end, when everyone was well again; None: not before the next fault."""


def recoveries(watch: Watch, faults: list[Fault], error_m: np.ndarray) -> list[Recovery]:
    times_s = 1e-9 * watch.times_ns[: watch.count]
    measured, quality = watch.measured[: watch.count], watch.quality[: watch.count]
    result = []
    for fault in faults:
        before = (times_s > fault.start_s - 3.0) & (times_s < fault.start_s)
        usual = np.median(quality[before], axis=0)
        until = (times_s >= fault.start_s) & (times_s < fault.end_s + QUIET_S)
        well = measured[until] & (quality[until] >= QUALITY_SHARE * usual)
        well = (well & (error_m[until] < AT_ITS_PLACE_M)).all(axis=1)
        after_s = times_s[until] - fault.end_s
        recovered_s = None
        steady = round(STEADY_S * RATE_HZ)
        for row in np.flatnonzero(after_s >= 0):
            if well[row : row + steady].all() and len(well[row:]) >= steady:
                recovered_s = float(after_s[row])
                break
        share = (quality[until] / np.maximum(usual, 1e-9)).min()
        result.append(Recovery(fault=fault, worst_quality=float(share), recovered_s=recovered_s))
    return result


def truth_error_m(watch: Watch, truth: Take, first_ns: int) -> np.ndarray:
    """(T, S) distance of the hips that were sent from the true ones; large where nothing was."""
    own_s = truth.timestamps_ns * 1e-9
    span_s, period_s = own_s[-1], 1.0 / truth.rate_hz
    since_s = 1e-9 * (watch.times_ns[: watch.count] - first_ns)
    phase_s = np.mod(since_s, 2 * (span_s + period_s))
    back = phase_s > span_s
    phase_s[back] = np.clip(span_s - (phase_s[back] - span_s - period_s), 0.0, span_s)
    errors = []
    for place, name in enumerate(watch.names):
        hips_m = truth.bone_position_in_world_m[truth.subject(name), :, 0]
        true_m = np.stack([np.interp(phase_s, own_s, hips_m[:, axis]) for axis in range(3)], axis=1)
        errors.append(np.linalg.norm(watch.hips_m[: watch.count, place] - true_m, axis=1))
    return np.nan_to_num(np.stack(errors, axis=1), nan=np.inf)


def longest_wrong_s(watch: Watch, error_m: np.ndarray) -> float:
    """For how long two views at least followed somebody who was not at their place."""
    longest = 0
    for seen, off_m in zip(watch.seen[: watch.count].T, error_m.T, strict=True):
        wrong = 0
        for is_seen, is_off in zip(seen, off_m > AT_ITS_PLACE_M, strict=True):
            wrong = wrong + int(is_seen) if is_off else 0
            longest = max(longest, wrong)
    return longest / RATE_HZ


@dataclass(frozen=True, kw_only=True)
class SoakReport:
    """What happened."""

    live: LiveReport
    recoveries: list[Recovery]
    resources: Resources
    well_at_the_end: bool
    """For most of the last second everybody was where they are."""
    worst_jump_m: float
    longest_wrong_s: float
    usual_error_m: float
    """Median over people and instants."""
    not_finite: int
    engine_failures: list[str]

    def failed(self, recover_s: float, *, lasting: bool = True) -> list[str]:
        """What is not as it should be; with `lasting` also who was not back before a next fault."""
        problems = [
            f"{r.fault.kind.value} of {r.fault.where or 'everything'} at {r.fault.start_s:.0f} s: "
            + ("lasts" if r.recovered_s is None else f"recovered after {r.recovered_s:.2f} s")
            for r in self.recoveries
            if (lasting and r.recovered_s is None) or (r.recovered_s or 0.0) > recover_s
        ]
        if self.longest_wrong_s > recover_s:
            problems.append(f"somebody is followed wrongly for {self.longest_wrong_s:.2f} s")
        if self.not_finite:
            problems.append(f"{self.not_finite} poses are not finite")
        if self.worst_jump_m > JUMP_M:
            problems.append(f"somebody jumps by {self.worst_jump_m:.2f} m")
        if self.resources.growth() > MOST_GROWTH:
            problems.append(f"memory grows by {100 * self.resources.growth():.0f} %")
        first = int(WARM_UP_SHARE * len(self.resources.threads))
        for name in ("threads", "files"):
            counts = getattr(self.resources, name)[first:]
            if counts[-1] > counts[0] + 1:
                problems.append(f"{name} grow from {counts[0]} to {counts[-1]}")
        if self.live.threads_left:
            problems.append(f"threads do not end: {', '.join(self.live.threads_left)}")
        if len(self.live.recordings) != 2 or not self.live.recordings[0].problem:
            problems.append("the disk did not fill, or no second recording was made")
        elif self.live.recordings[1].problem:
            problems.append(f"the second recording: {self.live.recordings[1].problem}")
        return problems + self.engine_failures


def soak(seconds: float, *, seed: int = 0, room_bytes: int | None = None) -> SoakReport:
    """Runs for so long; `room_bytes` on the first recording's disk: for a part of the run."""
    faults = schedule(seconds, seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session, clock = load_session(simulated_session(folder)), SessionClock()
        truth = load_take(folder / "truth.npz")
        setup = session_setup(session, simulated=True)
        seen: dict[int, np.ndarray] = {}
        cameras = len(setup.rig)
        played = playback_sources(session, clock, PlaybackOptions(there_and_back=True))
        pictures = [AsPictures(source, seen) for source in played[:cameras]]
        sources = with_faults([*pictures, *played[cameras:]], for_sources(faults), clock, seed)
        detector = FaultyDetector(
            SimulatedDetector(setup.landmarks, seen, lambda: time.sleep(0.02)),
            [fault for fault in faults if fault.where == "detector"],
            clock,
        )
        watch = Watch([subject.name for subject in session.subjects], seconds)
        run = LiveRun(setup, sources, detector, LiveOptions(), [watch], clock)
        resources = Resources()
        room = room_bytes or round(seconds * 150_000)
        with receivers("vmc", "ws", "osc", "livelink") as targets, _absent(targets):
            send_to(run, targets)
            with _stalled_client(targets[1].port):
                recorders = _Recorders(run, folder, seconds, room)
                beside = threading.Thread(target=recorders.attend, args=(resources,))
                beside.start()
                try:
                    live = run.run(seconds)
                finally:
                    recorders.stop()
                    beside.join()
        assert pictures[0].first_ns is not None
        error_m = truth_error_m(watch, truth, pictures[0].first_ns)
    return SoakReport(
        live=live,
        recoveries=recoveries(watch, faults, error_m),
        resources=resources,
        worst_jump_m=watch.worst_jump_m(),
        longest_wrong_s=longest_wrong_s(watch, error_m),
        well_at_the_end=bool((error_m[-RATE_HZ:] < AT_ITS_PLACE_M).mean() > 0.5),
        usual_error_m=float(np.median(error_m)),
        not_finite=watch.not_finite,
        engine_failures=[i.what for i in live.incidents if "internal error" in i.what],
    )


def for_sources(faults: list[Fault]) -> list[Fault]:
    """ "cameras" is each of them, and the detector's own are left out."""
    result = []
    for fault in faults:
        if fault.where == "cameras":
            result += [
                Fault(
                    kind=fault.kind,
                    where=f"camera 'cam{number}'",
                    start_s=fault.start_s,
                    length_s=fault.length_s,
                )
                for number in range(1, 5)
            ]
        elif fault.where != "detector":
            result.append(fault)
    return result


class _Recorders:
    """Begins a recording on a disk that fills, and after its end another one."""

    def __init__(self, run: LiveRun, folder: Path, seconds: float, room_bytes: int) -> None:
        self._run = run
        self._until_ns = round((seconds - 1.0) * 1e9)
        self._folder = folder
        self._stopping = threading.Event()

        def full_disk(path: Path) -> BinaryIO:
            return io.BufferedWriter(FullDisk(path, room_bytes))

        self._recorder = self._record("first.mcap", full_disk)

    def _record(self, name: str, open_file: Callable[[Path], BinaryIO] | None = None) -> Recorder:
        recorder = Recorder(
            self._folder / name,
            self._run.setup,
            self._run.clock,
            from_start=open_file is not None,
            report=self._run.incidents.add,
            open_file=open_file,
        )
        self._run.add_listener(recorder)
        return recorder

    def attend(self, resources: Resources) -> None:
        another = False
        while not self._stopping.wait(1.0) and self._run.clock.now_ns() < self._until_ns:
            resources.look(1e-9 * self._run.clock.now_ns())
            if not another and self._recorder.status().problem:
                another = True
                self._run.remove_listener(self._recorder)
                self._record("second.mcap")

    def stop(self) -> None:
        self._stopping.set()


@contextmanager
def _absent(targets: list) -> Iterator[None]:
    """Nobody listens to the last of the targets."""
    probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    probe.bind(("127.0.0.1", 0))
    port = probe.getsockname()[1]
    probe.close()
    targets[-1] = type(targets[-1])(protocol=targets[-1].protocol, host="127.0.0.1", port=port)
    yield


@contextmanager
def _stalled_client(port: int) -> Iterator[None]:
    """A WebSocket client that says hello and never reads."""
    hello = (
        f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        client.connect(("127.0.0.1", port))
        client.sendall(hello.encode())
        yield


def as_text(report: SoakReport) -> str:
    live, resources = report.live, report.resources
    first = int(WARM_UP_SHARE * len(resources.memory_mb))
    lines = [
        "| fault | of | from s | for s | least quality | recovered after s |",
        "|---|---|---|---|---|---|",
    ]
    for r in report.recoveries:
        after = "not" if r.recovered_s is None else f"{r.recovered_s:.2f}"
        lines.append(
            f"| {r.fault.kind.value} {r.fault.amount:g} | {r.fault.where or 'everything'} "
            f"| {r.fault.start_s:.0f} | {r.fault.length_s:.0f} | {100 * r.worst_quality:.0f} % "
            f"| {after} |"
        )
    after_s = np.array([r.recovered_s for r in report.recoveries if r.recovered_s is not None])
    lines.append(
        f"\n{live.elapsed_s:.0f} s (simulated), {live.instants} instants at "
        f"{live.solves_per_s:.2f} per second, {live.packets_per_s:.2f} packets per second and "
        f"person\n{len(report.recoveries)} faults, {len(after_s)} recovered"
    )
    if len(after_s):
        lines.append(f"after {np.median(after_s):.2f} s (median), {after_s.max():.2f} s (slowest)")
    lines += [
        f"hips off the truth by {1e3 * report.usual_error_m:.0f} mm (median), somebody followed "
        f"wrongly for {report.longest_wrong_s:.2f} s at the longest; largest step from "
        f"one instant to the next {1e3 * report.worst_jump_m:.0f} mm; {report.not_finite} poses "
        "not finite",
        f"memory {resources.memory_mb[first]:.0f} MB after the warm-up, "
        f"{resources.memory_mb[-1]:.0f} MB at the end, growth {100 * resources.growth():+.1f} %",
        f"threads {resources.threads[first]} to {resources.threads[-1]}, open files "
        f"{resources.files[first]} to {resources.files[-1]}",
        f"processor {live.cpu_share:.2f} cores; load of the machine {os.getloadavg()[2]:.1f}; "
        f"{live.detector_failures} failures of the detector, {live.incident_count} incidents",
    ]
    lines += [f"recording: {r.megabytes:.1f} MB; {r.problem or 'whole'}" for r in live.recordings]
    lines += [
        f"{s.to}: {s.sent} sent, {s.dropped} dropped, {s.refused} refused, {s.failed} failed"
        for s in live.streams
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--recover", type=float, default=2.0, metavar="S", help="at the latest")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    report = soak(60 * arguments.minutes, seed=arguments.seed)
    print(as_text(report))
    for incident in report.live.incidents:
        print(f"    {incident.time_s:8.2f} s  {incident.what}")
    problems = report.failed(arguments.recover)
    print("\n".join(f"FAILED: {problem}" for problem in problems) or "all well")
    if arguments.json:
        plain = {
            "live": report.live.as_json(),
            "recoveries": [
                {**asdict(r.fault), "kind": r.fault.kind.value, "recovered_s": r.recovered_s}
                for r in report.recoveries
            ],
            "resources": asdict(report.resources),
            "problems": problems,
        }
        arguments.json.write_text(json.dumps(plain, indent=1))
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
