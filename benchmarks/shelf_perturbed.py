"""Whether the same take, perturbed, gives the same people: Shelf, 48 runs.

    uv run python benchmarks/shelf_perturbed.py FOLDER [--frames 301] [--max-subjects 3]

Keypoints get 1.5 or 2.5 px of noise, 2 or 5 % of the detections are dropped, the run starts at
frame 0, 20 or 40; four seeds each. Sorted and solved as in the first pass of a solve, each instant
alone. A run falls when, against the unperturbed one, somebody is lost for 1.5 s or changes name.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.associate.options import TrackerOptions
from fusecap.body.prior import load_prior
from fusecap.body.skeleton import PAPER21
from fusecap.evaluate.datasets.recording import DatasetSequence
from fusecap.evaluate.datasets.shelf import RATE_HZ, load_shelf
from fusecap.evaluate.metrics import match_people
from fusecap.pipeline import Pipeline
from fusecap.setup import Setup
from fusecap.solve.options import SolverOptions
from fusecap.types import Detections

NOISE_PX, DROPPED, STARTS, SEEDS = (1.5, 2.5), (0.02, 0.05), (0, 20, 40), range(4)
LOST_S = 1.5
SETTLING_FRAMES = 15
"""After the start, in which people are found."""
MOST_PEOPLE = 12

Run = tuple[float, float, int, int]
"""Noise [px], share dropped, first frame, seed."""
UNPERTURBED: Run = (0.0, 0.0, 0, 0)
RUNS: tuple[Run, ...] = tuple(product(NOISE_PX, DROPPED, STARTS, SEEDS))


def perturbed(sequence: DatasetSequence, run: Run, frames: int) -> Iterator[tuple[int, Detections]]:
    noise_px, dropped, start, seed = run
    rng = np.random.default_rng([seed, int(noise_px * 10), int(dropped * 100), start])
    nobody = np.empty((0, len(sequence.landmarks.landmark_names), 3))
    for frame in range(start, frames):
        people = []
        for view in sequence.views:
            found = view.get(frame, nobody).copy()
            kept = rng.random(len(found)) >= dropped
            found[:, :, :2] += noise_px * rng.standard_normal(found[:, :, :2].shape)
            people.append(found[kept])
        yield (
            frame,
            Detections(timestamp_ns=round(frame * 1e9 / RATE_HZ), people=tuple(people)),
        )


def joints_of(
    sequence: DatasetSequence, run: Run, frames: int, max_subjects: int | None = None
) -> Float[np.ndarray, "e t b 3"]:
    """Everyone's joints [m] over all frames, in order of appearance; NaN where not followed."""
    pipeline = Pipeline(
        Setup(
            rig=sequence.rig,
            landmarks=sequence.landmarks,
            skeleton=PAPER21,
            prior=load_prior(PAPER21),
            rate_hz=RATE_HZ,
            options=SolverOptions(window=1),
            tracker=TrackerOptions(max_subjects=max_subjects),
        )
    )
    rows: dict[str, int] = {}
    joints = np.full((MOST_PEOPLE, frames, PAPER21.bone_count, 3), np.nan)
    for frame, detections in perturbed(sequence, run, frames):
        for estimate in pipeline.step(detections, {}).estimates:
            row = rows.setdefault(estimate.name, len(rows))
            if row < MOST_PEOPLE:
                joints[row, frame] = estimate.bone_position_in_world_m
    return joints[: max(len(rows), 1)]


def falls(
    joints: Float[np.ndarray, "e t b 3"], reference: Float[np.ndarray, "g t b 3"], start: int
) -> list[str]:
    """Who of the reference was lost or exchanged, in words."""
    said = []
    for person, match in enumerate(match_people(joints, reference)):
        there = np.isfinite(reference[person, :, 0, 0])
        there[: start + SETTLING_FRAMES] = False
        seen = match[there]
        named = seen[seen >= 0]
        changes = int((np.diff(named) != 0).sum())
        longest = max((len(gap) for gap in _gaps(seen)), default=0) / RATE_HZ
        if changes or longest >= LOST_S:
            said.append(f"person {person}: {changes} changes of name, lost for {longest:.1f} s")
    return said


def _gaps(match: np.ndarray) -> list[np.ndarray]:
    """Stretches in which nobody matched."""
    edges = np.flatnonzero(np.diff(match < 0)) + 1
    return [part for part in np.split(match, edges) if len(part) and part[0] < 0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=301)
    parser.add_argument("--max-subjects", type=int)
    arguments = parser.parse_args()
    sequence = load_shelf(arguments.folder)
    reference = joints_of(sequence, UNPERTURBED, arguments.frames, arguments.max_subjects)
    fallen = 0
    for run in RUNS:
        joints = joints_of(sequence, run, arguments.frames, arguments.max_subjects)
        said = falls(joints, reference, run[2])
        fallen += bool(said)
        if said:
            noise_px, dropped, start, seed = run
            print(f"{noise_px} px, {dropped:.0%} dropped, from {start}, seed {seed}: {said}")
    print(f"{fallen} of {len(RUNS)} runs fall; {len(reference)} people unperturbed")


if __name__ == "__main__":
    main()
