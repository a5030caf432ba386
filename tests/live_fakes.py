"""Sources, detectors and engines for tests of live runs, under the test's control."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.engine.engine import LiveStep
from fusecap.geometry.camera import Rig
from fusecap.live.devices.source import Deliver, SessionClock, SourceCounts
from fusecap.pipeline import Step
from fusecap.setup import SessionSetup
from fusecap.sources.session import Session
from fusecap.types import (
    CameraImage,
    CameraSample,
    Detections,
    Estimate,
    Event,
    ImuSample,
    Status,
    Tick,
)
from motions import person

BODY25 = LANDMARK_SETS["body25"]
SHAPE = person()


def wait_for(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Until it is so; a test that waits in vain fails."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.002)


def live_setup(
    rig: Rig, *, rate_hz: float = 60.0, sensors: Sequence[str] = ("head",)
) -> SessionSetup:
    """A session of the rig's cameras and of anna, who wears sensors."""
    session = Session.model_validate(
        {
            "session": {"name": "test", "rate_hz": rate_hz},
            "camera": [{"name": f"cam{i}", "keypoints": "k"} for i in range(len(rig))],
            "subject": [{"name": "anna", "imu": [{"bone": b, "live": "lsl:x"} for b in sensors]}],
        },
        context={"file": Path("session.toml")},
    )
    return SessionSetup(session=session, rig=rig, landmarks=BODY25)


def imu_sample(timestamp_ns: int, bone: str = "head") -> ImuSample:
    return ImuSample(
        subject="anna",
        bone=bone,
        timestamp_ns=timestamp_ns,
        orientation_wxyz=np.array([1.0, 0, 0, 0]),
        accel_m_s2=np.array([0, 0, 9.8]),
    )


def camera_sample(timestamp_ns: int, camera: int = 0, people: int = 0) -> CameraSample:
    return CameraSample(camera=camera, timestamp_ns=timestamp_ns, people=np.zeros((people, 25, 3)))


def image(timestamp_ns: int, camera: int = 0) -> CameraImage:
    return CameraImage(
        camera=camera, timestamp_ns=timestamp_ns, image=np.zeros((4, 4, 3), np.uint8)
    )


def estimate_of(timestamp_ns: int, name: str = "anna", shape=SHAPE) -> Estimate:
    bones = shape.skeleton.bone_count
    return Estimate(
        track_id=0,
        name=name,
        timestamp_ns=timestamp_ns,
        theta=np.zeros(shape.skeleton.pose_size),
        bone_position_in_world_m=np.zeros((bones, 3)),
        bone_rotation_in_world=np.tile(np.eye(3), (bones, 1, 1)),
        bone_sigma_deg=np.zeros(bones),
        position_sigma_m=np.zeros(bones),
        shape=shape,
        status=Status.CONVERGED,
        iterations=1,
        cost=0.0,
        solve_s=0.0,
        views=np.zeros(0, dtype=bool),
        measured=True,
    )


def step_of(
    timestamp_ns: int, people: Sequence[Estimate | None] = (), cameras: int = 0
) -> LiveStep:
    """One instant; who has no estimate is not in it."""
    solved = tuple(one for one in people if one is not None)
    return LiveStep(
        timestamp_ns=timestamp_ns,
        detections=Detections(timestamp_ns=timestamp_ns, people=(np.zeros((0, 25, 3)),) * cameras),
        readings={},
        step=Step(updates=(), estimates=solved),
        people={one.name: one for one in solved},
    )


class FakeEngine:
    """Notes what it takes; its person stands still."""

    def __init__(self, cameras: int = 0, on_take: Callable[[Event], None] | None = None) -> None:
        self.taken: list[Event] = []
        self.notes: deque[str] = deque()
        self._cameras = cameras
        self._on_take = on_take

    def take(self, event: Event) -> LiveStep | None:
        self.taken.append(event)
        if self._on_take is not None:
            self._on_take(event)
        if not isinstance(event, Tick):
            return None
        return step_of(event.timestamp_ns, [estimate_of(event.timestamp_ns)], self._cameras)

    def ready(self, timestamp_ns: int, *, ahead: bool = False) -> bool:
        samples = [e for e in self.taken[-50:] if isinstance(e, CameraSample | ImuSample)]
        return any(sample.timestamp_ns >= timestamp_ns for sample in samples)

    def expected(self, timestamp_ns: int) -> list[np.ndarray]:
        return [np.zeros((0, 25, 3))] * self._cameras

    @property
    def ticks(self) -> list[int]:
        return [event.timestamp_ns for event in self.taken if isinstance(event, Tick)]


class FakeSource:
    """Runs `script(deliver, stopping)` each time it is opened."""

    def __init__(self, name: str, script: Callable[[Deliver, threading.Event], None]) -> None:
        self.name = name
        self.counts = SourceCounts()
        self.opened = 0
        self._script = script

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        self.opened += 1
        self._script(deliver, stopping)


def steady(clock: SessionClock, make: Callable[[int], object], rate_hz: float = 60.0) -> Callable:
    """A script that delivers `make(now_ns)` at a rate until it is stopped."""

    def script(deliver, stopping) -> None:
        while not stopping.wait(1 / rate_hz):
            deliver(make(clock.now_ns()))

    return script


class FakeDetector:
    """Finds nobody, in its own time."""

    identity = "fake"
    landmarks = BODY25

    def __init__(self, on_detect: Callable[[Sequence[np.ndarray | None]], None]) -> None:
        self.resets = 0
        self._on_detect = on_detect

    def detect(self, images, predicted) -> tuple[np.ndarray, ...]:
        self._on_detect(images)
        return tuple(np.zeros((0, 25, 3)) for _ in images)

    def reset(self) -> None:
        self.resets += 1


class Notes:
    """A listener that keeps everything."""

    def __init__(self) -> None:
        self.events: list[tuple[Event, int]] = []
        self.steps: list[LiveStep] = []
        self.images: list[CameraImage] = []
        self.statuses = []
        self.closed = 0

    def on_event(self, event: Event, arrival_ns: int) -> None:
        self.events.append((event, arrival_ns))

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        self.steps.append(step)

    def on_image(self, image: CameraImage) -> None:
        self.images.append(image)

    def on_status(self, status) -> None:
        self.statuses.append(status)

    def close(self) -> None:
        self.closed += 1
