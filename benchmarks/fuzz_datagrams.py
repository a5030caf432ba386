"""Spoilt datagrams of sensors through every parser, as many as one has time for.

    uv run --frozen python benchmarks/fuzz_datagrams.py [--datagrams 1000000] [--seed 0]

The sound datagrams, the blows and what is held of every sample are those of
tests/test_imu_streams.py; the first that is not held ends the run with its error. Prints what came
of them, and how much memory the process took at its end more than after the first thousand.
"""

from __future__ import annotations

import argparse
import random
import resource
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fusecap.sources.imu_streams.mvn import mvn_packet
from fusecap.sources.imu_streams.osc import osc_packet
from test_imu_streams import MVN, OSC, is_usable, mutations

WARM_UP = 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--datagrams", type=int, default=1_000_000, help="of all together")
    parser.add_argument("--seed", type=int, default=0)
    told = parser.parse_args()
    print("| protocol | datagrams | samples | refusals | slowest ms | CPU s | MB more |")
    print("|---|---|---|---|---|---|---|")
    for name, parse, sound in (("osc", osc_packet, OSC), ("mvn", mvn_packet, MVN)):
        blows = random.Random(f"{told.seed} {name}")
        samples = refusals = 0
        slowest_s = before_kb = 0.0
        began_s = time.process_time()
        for number in range(told.datagrams // 2):
            datagram = mutations(sound, blows)
            started_s = time.process_time()
            packet = parse(datagram)
            slowest_s = max(slowest_s, time.process_time() - started_s)
            assert is_usable(packet)
            samples += len(packet.samples)
            refusals += len(packet.refused)
            if number == WARM_UP:
                before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        more_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024
        print(
            f"| {name} | {told.datagrams // 2} | {samples} | {refusals} | {1e3 * slowest_s:.1f} "
            f"| {time.process_time() - began_s:.0f} | {more_mb:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
