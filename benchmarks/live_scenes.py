"""Sessions, detectors and receivers for the live benchmarks."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.build import build_detector
from fusecap.detect.detector import Detector, DetectorOptions
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulator import CameraTiming, Simulation, simulate
from fusecap.live.devices.source import Deliver, Delivery, Source, SourceCounts
from fusecap.live.run import LiveRun
from fusecap.live.streaming import Streaming
from fusecap.streams.target import Target
from fusecap.types import CameraImage, CameraSample

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
DATA = Path(os.environ.get("FUSECAP_DATA", SHARED / "data"))
MODELS = Path(os.environ.get("FUSECAP_MODELS", SHARED / "models"))
CLIP = DATA / "pose2sim_demo" / "HEAD_Demo_MultiPerson"
POSE_MODEL = MODELS / "tinypose_ir" / "tinypose_128_96_fp16.xml"
PERSON_MODEL = MODELS / "rtmdet_nano" / "rtmdet_nano_person_320.onnx"

OFFSETS_S = (0.0, 0.0041, 0.0083, 0.0125)
"""Of the simulated cameras, which expose at 60 Hz, none with another."""
_COST_S = 0.057
_SEEN = 1024
_LOOK = """
import sys
from websockets.sync.client import connect
with connect(sys.argv[1], max_size=None) as socket:
    for _ in socket:
        pass
"""


def simulation(seconds: float | None = None) -> Simulation:
    """The demo's people before four cameras of 60 Hz that are not in step, 13 IMUs each."""
    demo = demo_scene(seconds=seconds)
    return simulate(
        demo.people,
        demo.rig,
        demo.landmark_set,
        rate_hz=demo.rate_hz,
        seed=demo.seed,
        name="live",
        volume_m=demo.volume_m,
        timing=[CameraTiming(rate_hz=60.0, offset_s=offset_s) for offset_s in OFFSETS_S],
    )


def simulated_session(folder: Path, seconds: float | None = None) -> Path:
    """`simulation` as a session with keypoints from outside."""
    return write_session(simulation(seconds), folder)


def clip_session(folder: Path, videos: Sequence[Path]) -> Path:
    """Pose2Sim's two people (one of them computer-made) and a bystander, before four cameras."""
    text = (
        '[session]\nname = "pose2sim"\nrate_hz = 60\n'
        f'calibration = "{CLIP / "calibration" / "Calib.qca.txt"}"\nup = "z"\nmax_subjects = 2\n'
    )
    for number, video in enumerate(videos, start=1):
        text += f'\n[[camera]]\nname = "cam{number:02d}"\nvideo = "{video}"\n'
    for name in ("first", "second"):
        text += f'\n[[subject]]\nname = "{name}"\n'
    path = folder / "session.toml"
    path.write_text(text)
    return path


def clip_videos() -> list[Path]:
    """60 Hz, 100 frames, 1088 x 1920."""
    return [CLIP / "videos" / f"cam{number:02d}.mp4" for number in range(1, 5)]


def round_trip(video: Path, folder: Path, rate_hz: float = 30.0) -> Path:
    """The clip at half its rate, forwards and then backwards: it can be looped without a jump."""
    with av.open(str(video)) as container:
        pictures = [
            frame.to_ndarray(format="yuv420p")
            for number, frame in enumerate(container.decode(video=0))
            if number % 2 == 0
        ]
    path = folder / video.name
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate_hz))
        stream.height, stream.width = pictures[0].shape[0] * 2 // 3, pictures[0].shape[1]
        stream.pix_fmt = "yuv420p"
        stream.options = {"g": "15", "bf": "0", "preset": "veryfast", "crf": "20"}
        for picture in (*pictures, *reversed(pictures)):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="yuv420p")))
        container.mux(stream.encode(None))
    return path


def networks(threads: int) -> Detector:
    """The small pose network and the person detector."""
    return build_detector(
        DetectorOptions(model=str(POSE_MODEL), person_model=str(PERSON_MODEL)),
        threads=threads,
        follow_others=False,
    )


class AsPictures:
    """A camera whose keypoints become pictures with a number; `seen` has what is on them."""

    def __init__(
        self, source: Source, seen: dict[int, np.ndarray], size_px: tuple[int, int] = (64, 48)
    ) -> None:
        self.first_ns: int | None = None
        """Time of its first picture."""
        self._source = source
        self._seen = seen
        self._size_px = size_px

    @property
    def name(self) -> str:
        return self._source.name

    @property
    def counts(self) -> SourceCounts:
        return self._source.counts

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        def show(sample: Delivery) -> None:
            assert isinstance(sample, CameraSample)
            if self.first_ns is None:
                self.first_ns = sample.timestamp_ns
            number = sample.timestamp_ns * 16 + sample.camera
            self._seen[number] = sample.people
            if len(self._seen) > _SEEN:
                self._seen.pop(next(iter(self._seen)), None)
            image = np.empty((self._size_px[1], self._size_px[0], 3), np.uint8)
            image[0, :8, 0] = np.frombuffer(np.int64(number).tobytes(), np.uint8)
            deliver(
                CameraImage(camera=sample.camera, timestamp_ns=sample.timestamp_ns, image=image)
            )

        self._source.run(show, stopping)


class SimulatedDetector:
    """Knows who is on numbered pictures, and takes as long as it is told to."""

    identity = "simulated detector"

    def __init__(
        self, landmarks: LandmarkSet, seen: dict[int, np.ndarray], work: Callable[[], None]
    ) -> None:
        self.landmarks = landmarks
        self._seen = seen
        self._work = work

    def detect(
        self, images: Sequence[np.ndarray | None], predicted: Sequence[np.ndarray]
    ) -> tuple[np.ndarray, ...]:
        self._work()
        return tuple(self._people(image) for image in images)

    def reset(self) -> None:
        pass

    def _people(self, image: np.ndarray | None) -> np.ndarray:
        nobody = np.empty((0, len(self.landmarks.landmark_names), 3))
        if image is None:
            return nobody
        number = int(np.frombuffer(image[0, :8, 0].tobytes(), np.int64)[0])
        return self._seen.get(number, nobody)


def work_like_networks() -> None:
    """57 ms for four views, of which about 100 ms of processor time on two cores, as measured."""
    other = threading.Thread(target=_work, args=(0.75 * _COST_S,))
    other.start()
    _work(_COST_S)
    other.join()


def _work(seconds: float) -> None:
    """Keeps a core busy without Python, as networks do."""
    matrix = np.random.default_rng(0).random((64, 64))
    until_s = time.perf_counter() + seconds
    while time.perf_counter() < until_s:
        for _ in range(20):
            matrix = np.tanh(matrix @ matrix)


@contextlib.contextmanager
def receivers(*protocols: str) -> Iterator[list[Target]]:
    """Where to send to: sockets that are never read, and for WebSocket a client that reads."""
    sockets: list[socket.socket] = []
    targets = []
    for protocol in protocols:
        one = socket.socket(
            socket.AF_INET, socket.SOCK_STREAM if protocol == "ws" else socket.SOCK_DGRAM
        )
        one.bind(("127.0.0.1", 0))
        targets.append(Target(protocol=protocol, host="127.0.0.1", port=one.getsockname()[1]))
        if protocol == "ws":
            one.close()
        else:
            sockets.append(one)
    try:
        yield targets
    finally:
        for one in sockets:
            one.close()


@contextlib.contextmanager
def reading_client(url: str) -> Iterator[None]:
    """A WebSocket client in a process of its own."""
    process = subprocess.Popen([sys.executable, "-c", _LOOK, url], stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def send_to(run: LiveRun, targets: Sequence[Target]) -> None:
    """Streams of a run, in a process of their own."""
    run.add_listener(
        Streaming(targets, run.setup, run.rate_hz, run.clock, run.latency, run.incidents.add)
    )
