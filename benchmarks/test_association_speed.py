"""Association on one core: 8 views x 6 people x 25 keypoints at most 1 ms at p95, 8 views x 8
people and 4 bystanders at most 2 ms.

    uv run pytest benchmarks/test_association_speed.py --benchmark-only --jaxtyping-packages=

Shape checks are for the tests: `--jaxtyping-packages=` leaves them out here. The percentiles are in
extra_info and printed, of wall time and of this thread's processor time; the two agree where
nothing else runs.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from fusecap.associate.options import TrackerOptions
from fusecap.associate.paper import PaperSorter
from fusecap.associate.subjects import Subject
from fusecap.associate.tracker import Tracker
from people_scene import BODY25, circle, observe, ring_of_cameras, straight, walker

TIMES_S = np.arange(300) / 30.0


def people(count: int) -> list[np.ndarray]:
    return [
        walker(circle(0.7 + 0.35 * i, 2.0 * i, 0.5 if i % 2 else -0.5), TIMES_S, 1.6 + 0.05 * i)
        for i in range(count)
    ]


def record(benchmark, update, detections, skip: int) -> None:
    """Time every update of a recording after the first `skip`."""
    wall_ms, thread_ms = [], []
    stream = iter(detections[skip:])

    def one_update():
        frame = next(stream)
        wall, thread = time.perf_counter(), time.thread_time()
        update(frame)
        thread_ms.append(1e3 * (time.thread_time() - thread))
        wall_ms.append(1e3 * (time.perf_counter() - wall))

    benchmark.pedantic(one_update, rounds=len(detections) - skip, iterations=1, warmup_rounds=0)
    for name, taken in (("wall", wall_ms), ("thread", thread_ms)):
        for percent in (50, 95, 99):
            figure = float(np.percentile(taken, percent))
            benchmark.extra_info[f"{name}_p{percent}_ms"] = round(figure, 3)
    print(f"\n{benchmark.name}: {benchmark.extra_info}")


@pytest.mark.parametrize(("cameras", "count"), [(8, 12), (8, 6), (4, 2), (4, 6), (8, 2)])
def test_tracker_in_steady_state(benchmark, cameras, count):
    """Everyone is tracked; 5 % of detections missing, a spurious one in every tenth view."""
    rig = ring_of_cameras(cameras)
    scene = observe(rig, people(count), np.random.default_rng(1))
    tracker = Tracker(rig, BODY25)
    for detections in scene.detections[:10]:
        tracker.update(detections, {}, detections.timestamp_ns)
    record(
        benchmark,
        lambda detections: tracker.update(detections, {}, detections.timestamp_ns),
        scene.detections,
        skip=10,
    )


def test_four_bystanders_beside_eight_subjects(benchmark):
    """Who has no place is tracked too, and looked for again whenever two views lose them."""
    rig = ring_of_cameras(8)
    scene = observe(rig, people(12), np.random.default_rng(1))
    tracker = Tracker(rig, BODY25, TrackerOptions(max_subjects=8))
    for detections in scene.detections[:10]:
        tracker.update(detections, {}, detections.timestamp_ns)
    record(
        benchmark,
        lambda detections: tracker.update(detections, {}, detections.timestamp_ns),
        scene.detections,
        skip=10,
    )


def test_birth_of_six_people_in_eight_views(benchmark):
    """Nobody is known yet: the search over all pairs of all views."""
    rig = ring_of_cameras(8)
    scene = observe(rig, people(6), np.random.default_rng(1))
    fresh = [Tracker(rig, BODY25) for _ in range(100)]
    record(
        benchmark,
        lambda detections: fresh.pop().update(detections, {}, detections.timestamp_ns),
        scene.detections[:100],
        skip=0,
    )


def test_algorithm_1_with_two_people_in_four_views(benchmark):
    rig = ring_of_cameras(4)
    two = [
        walker(straight((-3, 0.75), (0.6, 0)), TIMES_S),
        walker(straight((3, -0.75), (-0.6, 0)), TIMES_S),
    ]
    scene = observe(rig, two, np.random.default_rng(1))
    subjects = [
        Subject(name="ann", start_m=(-3.0, 0.75)),
        Subject(name="bob", start_m=(3.0, -0.75)),
    ]
    sorter = PaperSorter(rig, BODY25, subjects)
    record(
        benchmark,
        lambda detections: sorter.update(detections, {}, detections.timestamp_ns),
        scene.detections,
        skip=0,
    )
