"""Who is who by clothes: re-entry, strangers and an occluder, with and without pictures. Simulated.

uv run python benchmarks/clothes.py [TRIALS]
"""

from __future__ import annotations

import sys

from fusecap.evaluate.clothes_trials import TRIALS, occluder, re_entry

FIRST_SEED = 1000
"""Faults and thresholds were looked for on those from 0."""


def main(trials: int) -> None:
    seeds = range(FIRST_SEED, FIRST_SEED + trials)
    for name, trial in TRIALS.items():
        for clothes in (True, False):
            report(name, [trial(seed, clothes=clothes) for seed in seeds], clothes)
    report("re-entry, all dressed alike", [re_entry(s, alike=True) for s in seeds], True)
    report("occluder, both dressed alike", [occluder(s, alike=True) for s in seeds], True)


def report(name: str, trials: list, clothes: bool) -> None:
    right, people = sum(t.right for t in trials), sum(t.people for t in trials)
    moved = sum(t.moved for t in trials)
    how = "pictures" if clothes else "keypoints alone"
    print(f"{name}, {how}: {right} of {people} ({right / people:.0%}), {moved} moved", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
