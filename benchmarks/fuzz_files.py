"""Spoilt files through every reader, as many as one has time for.

    uv run --frozen python benchmarks/fuzz_files.py [--files 100000] [--seed 0] [--processes 2]

The sound files and the blows are those of tests/test_fuzz.py. Every kind is read in processes of
its own, a thousand files each, so that a crash or a file that takes for ever is counted and the
next thousand goes on. Prints a line per kind, in seconds of the processor, and each fault once;
exits with 1 where there was any.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fusecap.errors import FusecapError
from hostile_files import seeds, spoilt

AT_ONCE = 1000
SLOW_S = 300.0
"""After which a file is said to take for ever; of the clock, which a busy machine slows."""


def read_some(kind: str, first: int, count: int, seed: int, told: Connection) -> None:
    """In a process of its own; says before each file that it is on its way."""
    with tempfile.TemporaryDirectory() as folder:
        content, read = seeds(Path(folder) / "sound")[kind]
        path = Path(folder) / kind
        for number in range(first, first + count):
            path.write_bytes(spoilt(content, Random(f"{seed} {kind} {number}")))
            told.send(number)
            began, fault = time.process_time(), ""
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    read(path)
                outcome = "read"
            except FusecapError:
                outcome = "refused"
            except Exception as error:
                outcome, fault = "fault", f"{type(error).__name__}: {str(error)[:100]}"
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            told.send((outcome, fault, time.process_time() - began, peak_mb))


class Kind:
    """What has been seen of one kind."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.outcomes, self.faults = Counter[str](), Counter[str]()
        self.slowest_s = self.peak_mb = 0.0

    def run(self, files: int, seed: int) -> None:
        number = 0
        while number < files:
            number = self._some(number, min(AT_ONCE, files - number), seed)

    def _some(self, first: int, count: int, seed: int) -> int:
        """The number of the file to go on with."""
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=read_some, args=(self.name, first, count, seed, theirs))
        process.start()
        theirs.close()
        number = first - 1
        try:
            while number < first or ours.poll(SLOW_S):
                told = ours.recv()
                if isinstance(told, int):
                    number = told
                    continue
                outcome, fault, took_s, peak_mb = told
                self.outcomes[outcome] += 1
                self.faults.update([fault] if fault else [])
                self.slowest_s = max(self.slowest_s, took_s)
                self.peak_mb = max(self.peak_mb, peak_mb)
            process.kill()
            self._fault(f"file {number}: not read within {SLOW_S:.0f} s")
        except EOFError:
            process.join()
            if process.exitcode == 0:
                return first + count
            if number < first:
                raise SystemExit(f"{self.name}: no file could be read") from None
            self._fault(f"file {number}: the process ended with {process.exitcode}")
        process.join()
        return number + 1

    def _fault(self, text: str) -> None:
        self.outcomes["fault"] += 1
        self.faults[text] += 1

    def __str__(self) -> str:
        counts = " | ".join(str(self.outcomes[name]) for name in ("read", "refused", "fault"))
        return f"| {self.name} | {counts} | {self.slowest_s:.1f} | {self.peak_mb:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=100_000, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--kinds", help="names with commas; without, all")
    told = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        names = list(seeds(Path(folder)))
    names = told.kinds.split(",") if told.kinds else names
    kinds = [Kind(name) for name in names]
    each = -(-told.files // len(kinds))
    print("| kind | read | refused | faults | slowest s | peak MB |\n|---|---|---|---|---|---|")
    with ThreadPoolExecutor(told.processes) as pool:
        for kind, _ in zip(kinds, pool.map(lambda k: k.run(each, told.seed), kinds), strict=True):
            print(kind, flush=True)
    for kind in kinds:
        for text, count in kind.faults.most_common():
            print(f"{kind.name}: {count} x {text}")
    sys.exit(any(kind.faults for kind in kinds))


if __name__ == "__main__":
    main()
