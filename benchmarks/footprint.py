"""What fusecap costs before and beside solving: imports, help, first compilation, memory.

    uv run python benchmarks/footprint.py [--times 10]

Prints Markdown. Every figure is of fresh processes, with bytecode in place as an installed package
has it; compilation goes to a cache of its own. The process that starts them imports nothing large,
because a child's peak memory counts the moment before it becomes another program.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

FUSECAP = [sys.executable, "-m", "fusecap"]
CALLS = 7


class Run(NamedTuple):
    """A finished process."""

    seconds: float
    cpu_s: float
    """User and system; what a busy machine changes least."""
    peak_mb: float
    output: str


def run(command: list[str], **environment: str) -> Run:
    """Run a command to its end; raises `SystemExit` with its output when it fails."""
    variables = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        started = time.perf_counter()
        process = subprocess.Popen(
            command, stdout=output, stderr=errors, env=variables | environment
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - started
        process.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        errors.seek(0)
        if process.returncode:
            sys.exit(f"{command} failed:\n{errors.read()}")
        # Kilobytes on Linux, bytes on macOS.
        unit = 1e-6 if sys.platform == "darwin" else 1024e-6
        return Run(seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * unit, output.read())


def start_up(bytecode: str) -> None:
    """Median seconds of commands that do no work."""
    commands = {
        "`python -c pass`": [sys.executable, "-c", "pass"],
        "`python -c 'import numpy'`": [sys.executable, "-c", "import numpy"],
        "`import fusecap`": [sys.executable, "-c", "import fusecap"],
        "`from fusecap import Estimator`": [sys.executable, "-c", "from fusecap import Estimator"],
        "`fusecap --help`": [*FUSECAP, "--help"],
    }
    runs: dict[str, list[Run]] = {name: [] for name in commands}
    for call in range(CALLS + 1):
        for name, command in commands.items():
            finished = run(command, PYTHONPYCACHEPREFIX=bytecode)
            if call:  # the first writes the bytecode
                runs[name].append(finished)
    bare = statistics.median(r.seconds for r in runs["`python -c pass`"])
    print(f"| process (median of {CALLS}) | seconds | less interpreter start | least | CPU |")
    print("|---|---|---|---|---|")
    for name, finished in runs.items():
        median = statistics.median(r.seconds for r in finished)
        least = min(r.seconds for r in finished)
        cpu = statistics.median(r.cpu_s for r in finished)
        print(f"| {name} | {median:.2f} | {median - bare:.2f} | {least:.2f} | {cpu:.2f} |")


def compilation(bytecode: str) -> None:
    """Seconds of the first import of all kernels, and of the second."""
    every = "import fusecap.batch.solve"
    with tempfile.TemporaryDirectory() as cache:
        first, second = (
            run(
                [sys.executable, "-c", every],
                NUMBA_CACHE_DIR=cache,
                PYTHONPYCACHEPREFIX=bytecode,
            )
            for _ in range(2)
        )
    print("\n| all kernels | seconds | CPU | peak MB |\n|---|---|---|---|")
    print(
        f"| compiled, cold cache | {first.seconds:.1f} | {first.cpu_s:.1f} | {first.peak_mb:.0f} |"
    )
    print(f"| from the cache | {second.seconds:.2f} | {second.cpu_s:.2f} | {second.peak_mb:.0f} |")


def solving(bytecode: str, times: int) -> None:
    """Peak memory of `fusecap solve` on the demo as a session, once and `times` as long."""
    print("\n| `fusecap solve` | instants | seconds | peak MB | solve ms median | p99 |")
    print("|---|---|---|---|---|---|")
    for repeats in (1, times):
        with tempfile.TemporaryDirectory() as folder:
            session = Path(folder) / "session"
            run([sys.executable, __file__, "--write", str(session), "--times", str(repeats)])
            done = run([*FUSECAP, "solve", str(session), "--json"], PYTHONPYCACHEPREFIX=bytecode)
            report = json.loads(done.output)
        length = "the demo" if repeats == 1 else f"{repeats} times as long"
        print(
            f"| {length} | {report['instants']} | {done.seconds:.1f} | {done.peak_mb:.0f} "
            f"| {report['solve_ms_median']:.2f} | {report['solve_ms_p99']:.2f} |"
        )


def write(folder: Path, times: int) -> None:
    """The demo's scene as a session; longer ones go forth and back, so that nobody jumps."""
    import numpy as np

    from fusecap.evaluate.demo_scene import demo_scene
    from fusecap.evaluate.simulated_session import write_session
    from fusecap.evaluate.simulator import simulate

    demo = demo_scene()
    people = [
        replace(
            person,
            theta=np.concatenate([person.theta[:: 1 if i % 2 == 0 else -1] for i in range(times)]),
        )
        for person in demo.people
    ]
    simulation = simulate(
        people,
        demo.rig,
        demo.landmark_set,
        rate_hz=demo.rate_hz,
        seed=demo.seed,
        name=demo.name,
        volume_m=demo.volume_m,
    )
    write_session(simulation, folder)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=10, help="length of the longer session")
    parser.add_argument("--write", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.write:
        write(arguments.write, arguments.times)
        return
    with tempfile.TemporaryDirectory() as bytecode:
        start_up(bytecode)
        compilation(bytecode)
        solving(bytecode, arguments.times)


if __name__ == "__main__":
    main()
