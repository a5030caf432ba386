"""Detection of two people in four views of 1088x1920: at least 18 instants/s with a small network.

"two" has two people in each view: the two cameras that see nobody else, each twice (for images
once mirrored). "three" are the four cameras, two of which see a bystander as well.

    uv run pytest benchmarks/test_detection_speed.py --benchmark-only --jaxtyping-packages= -s

Needs the demo videos and the networks of the data folders; skips without them. The machine's load
is in extra_info with the figures: other work slows the clock more than `cpu_ms`, the processor time
of all threads per instant, and ratios come from runs in turn.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from fusecap.batch.detect import detect_videos, session_videos, video_setup
from fusecap.detect.build import build_detector
from fusecap.detect.detector import DetectorOptions
from fusecap.detect.packing import PackedPersonDetector
from fusecap.detect.person import PersonDetector
from fusecap.detect.pose import PoseNetwork
from fusecap.detect.runtimes.choice import open_network
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.calibration_files.writer import write_rig
from fusecap.sources.session_file import load_session

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


def decoded(people: str = "three") -> Iterator[list[np.ndarray]]:
    """The views' images, instant by instant."""
    views = ("cam03", "cam04") if people == "two" else ("cam01", "cam02", "cam03", "cam04")
    videos = [av.open(str(VIDEOS / f"{view}.mp4")) for view in views]
    streams = [video.decode(video=0) for video in videos]
    for frames in itertools.islice(zip(*streams, strict=False), INSTANTS + WARM_UP):
        images = [frame.to_ndarray(format="bgr24") for frame in frames]
        mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in images]
        yield images + mirrored if people == "two" else images
    for video in videos:
        video.close()


def record(benchmark, **figures: float) -> None:
    figures |= {"load": os.getloadavg()[0]}
    benchmark.extra_info.update({name: round(value, 2) for name, value in figures.items()})
    print(f"\n{benchmark.name}: {benchmark.extra_info}")


@pytest.mark.parametrize("size", ["128_96", "256_192"])
@pytest.mark.parametrize("people", ["two", "three"])
def test_instants_per_second_from_images(benchmark, size, people):
    """Person detector every 10 instants, crops, keypoints, clean-up; images are decoded before."""
    detector = build_detector(options(size), threads=THREADS)
    images = iter(list(decoded(people)))
    found, took, worked = [], [], []

    def instant() -> None:
        start, start_cpu = time.perf_counter(), time.process_time()
        found.append(sum(map(len, detector.detect(next(images), NOBODY))))
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
        people=float(np.mean(found[WARM_UP:])),
    )


@pytest.mark.parametrize("size", ["128_96", "256_192"])
@pytest.mark.parametrize("people", ["two", "three"])
def test_instants_per_second_from_videos_to_files(benchmark, tmp_path, size, people):
    """What `fusecap detect` does once its networks are loaded, checksums of the videos included."""
    session = load_session(session_file(tmp_path, people))
    detector = build_detector(options(size), threads=THREADS)
    cameras = session_videos(session)
    setup = video_setup(session, cameras, detector.landmarks)
    start_cpu = time.process_time()
    found = benchmark.pedantic(
        lambda: detect_videos(cameras, detector, setup=setup), rounds=1, iterations=1
    )
    instants = found.frames_detected / len(cameras)
    record(
        benchmark,
        instants_per_s=found.frames_per_s / len(cameras),
        cpu_ms=1e3 * (time.process_time() - start_cpu) / instants,
        people=sum(camera.people_per_frame for camera in found.cameras.values()),
    )


def options(size: str) -> DetectorOptions:
    return DetectorOptions(model=str(tinypose(size)), person_model=str(PERSON))


def session_file(folder: Path, people: str) -> Path:
    rig = load_rig(VIDEOS.parent / "calibration" / "Calib.qca.txt", up="z")
    cameras = rig.cameras
    if people == "two":
        cameras = tuple(
            replace(rig[name], name=name + again) for again in "ab" for name in ("cam03", "cam04")
        )
    write_rig(folder / "calibration.toml", Rig(cameras=cameras))
    text = '[session]\nname = "speed"\ncalibration = "calibration.toml"\nmax_subjects = 2\n'
    for camera in cameras:
        video = VIDEOS / f"{camera.name[:5]}.mp4"
        text += f'\n[[camera]]\nname = "{camera.name}"\nvideo = "{video}"\n'
    (folder / "session.toml").write_text(text)
    return folder / "session.toml"


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
