"""Detection of two people and a bystander in four views of 1080x1920: at least 18 instants/s.

    uv run pytest benchmarks/test_detection_speed.py --benchmark-only --jaxtyping-packages= -s

Needs the demo videos and the networks of the data folders; skips without them. Another load on the
machine is in extra_info with the figures: it slows the clock more than `cpu_ms`, the processor time
of all threads, and ratios come from runs in turn.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import numpy as np
import pytest

from fusecap.detect.build import build_detector
from fusecap.detect.detector import DetectorOptions
from fusecap.detect.packing import PackedPersonDetector
from fusecap.detect.person import PersonDetector
from fusecap.detect.pose import PoseNetwork
from fusecap.detect.runtimes.network import open_network

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
DATA = Path(os.environ.get("FUSECAP_DATA", SHARED / "data"))
MODELS = Path(os.environ.get("FUSECAP_MODELS", SHARED / "models"))
VIDEOS = DATA / "pose2sim_demo" / "HEAD_Demo_MultiPerson" / "videos"
PERSON = MODELS / "rtmdet_nano" / "rtmdet_nano_person_320.onnx"
NOBODY = [np.empty((0, 17, 3))] * 4
INSTANTS, WARM_UP = 60, 12
THREADS = 2

pytestmark = pytest.mark.skipif(
    not (VIDEOS.is_dir() and MODELS.is_dir()), reason=f"needs {VIDEOS} and {MODELS}"
)


def tinypose(size: str) -> Path:
    return MODELS / "tinypose_ir" / f"tinypose_{size}_fp16.xml"


def decoded() -> Iterator[list[np.ndarray]]:
    """The views' images, instant by instant."""
    videos = [av.open(str(path)) for path in sorted(VIDEOS.glob("cam*.mp4"))]
    streams = [video.decode(video=0) for video in videos]
    for frames in itertools.islice(zip(*streams, strict=False), INSTANTS + WARM_UP):
        yield [frame.to_ndarray(format="bgr24") for frame in frames]
    for video in videos:
        video.close()


def record(benchmark, **figures: float) -> None:
    figures |= {"load": os.getloadavg()[0]}
    benchmark.extra_info.update({name: round(value, 2) for name, value in figures.items()})
    print(f"\n{benchmark.name}: {benchmark.extra_info}")


@pytest.mark.parametrize("size", ["128_96", "256_192"])
@pytest.mark.parametrize("decode", [False, True], ids=["images", "videos"])
def test_instants_per_second(benchmark, size, decode):
    """Person detector every 10 instants, crops, keypoints, clean-up; with or without decoding."""
    detector = build_detector(
        DetectorOptions(model=str(tinypose(size)), person_model=str(PERSON)), threads=THREADS
    )
    images = decoded() if decode else iter(list(decoded()))
    people, took, worked = [], [], []

    def instant() -> None:
        start, start_cpu = time.perf_counter(), time.process_time()
        people.append(sum(map(len, detector.detect(next(images), NOBODY))))
        took.append(time.perf_counter() - start)
        worked.append(time.process_time() - start_cpu)

    benchmark.pedantic(instant, rounds=INSTANTS, iterations=1, warmup_rounds=WARM_UP)
    took_ms = 1e3 * np.array(took[WARM_UP:])
    record(
        benchmark,
        instants_per_s=1e3 / float(took_ms.mean()),
        median_ms=float(np.median(took_ms)),
        p95_ms=float(np.percentile(took_ms, 95)),
        cpu_ms=1e3 * float(np.mean(worked[WARM_UP:])),
        people=float(np.mean(people[WARM_UP:])),
    )


def in_turn(benchmark, first: Callable[[], object], second: Callable[[], object]) -> None:
    """Median times of both [ms] and how much faster the first is."""
    took_ms: list[list[float]] = [[], []]

    def both() -> None:
        for run, times in zip((first, second), took_ms, strict=True):
            start = time.perf_counter()
            run()
            times.append(1e3 * (time.perf_counter() - start))

    benchmark.pedantic(both, rounds=20, iterations=1, warmup_rounds=3)
    a, b = (float(np.median(times[3:])) for times in took_ms)
    record(benchmark, first_ms=a, second_ms=b, times_faster=b / a)


@pytest.mark.parametrize("size", ["128_96", "256_192"])
def test_eight_crops_in_one_batch_or_one_by_one(benchmark, size):
    pose = PoseNetwork(open_network(tinypose(size), threads=THREADS))
    images = next(decoded())
    boxes = [np.array([[200.0 + 9 * i, 300.0, 600.0, 1300.0]] * 2) for i in range(4)]

    def one_by_one() -> None:
        for image, those in zip(images, boxes, strict=True):
            for box in those:
                pose.keypoints([image], [box[None]])

    in_turn(benchmark, lambda: pose.keypoints(images, boxes), one_by_one)


def test_person_detector_on_four_views_in_one_image_or_one_by_one(benchmark):
    person = PersonDetector(open_network(PERSON, threads=THREADS))
    packed = PackedPersonDetector(person)
    images = next(decoded())
    in_turn(benchmark, lambda: packed.find(images), lambda: person.find(images))
