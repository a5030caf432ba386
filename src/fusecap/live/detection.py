"""Images to keypoints, as fast as the detector goes: of every camera always the newest image.

Cameras may be faster than the detector. Each has one slot; a new image takes the place of one that
the detector has not come to, so the detector never works on the past. When it is free it takes all
cameras that have something new, and waits a few milliseconds for those that are about to: networks
are cheaper per image in a batch.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np

from fusecap.detect.clothes import ClothesReader
from fusecap.detect.detector import Detector
from fusecap.live.devices.source import SessionClock
from fusecap.live.health import Incidents, Meter
from fusecap.live.latency import CAMERA, DETECTION, WAIT_FOR_DETECTOR, LatencyBook
from fusecap.types import CameraImage, CameraSample

GATHER_NS = 8_000_000
"""How long the detector waits for the other cameras once it has an image."""
_ALIVE_NS = 500_000_000
"""Who has not sent an image for so long is not waited for."""
_PAUSE_AFTER_FAILURE_S = 0.1


class DetectionLoop:
    """The detector in a thread of its own."""

    def __init__(
        self,
        detector: Detector,
        cameras: int,
        *,
        emit: Callable[[CameraSample], None],
        show: Callable[[CameraImage], None],
        clock: SessionClock,
        latency: LatencyBook,
        incidents: Incidents,
    ) -> None:
        """`emit` takes what was found, `show` every image that went to the detector."""
        self.rounds = Meter()
        self.images = 0
        self.failures = 0
        self.overtaken = [0] * cameras
        """Per camera the images that made room for newer ones."""
        self._detector = detector
        self._clothes = ClothesReader(detector.landmarks)
        self._emit = emit
        self._show = show
        self._clock = clock
        self._latency = latency
        self._incidents = incidents
        self._expected: Sequence[np.ndarray] = self._nobody(cameras)
        self._curious = True
        """It has not been told where to look since it last looked."""
        self._slots: list[tuple[CameraImage, int] | None] = [None] * cameras
        self._last_ns = [-_ALIVE_NS] * cameras
        self._changed = threading.Condition()
        self._stopping = False
        self.name = "the detector"
        self._thread = threading.Thread(target=self._run, name="fusecap-detector", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """End after the images at hand; does not wait."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()

    def join(self, timeout_s: float) -> bool:
        """Whether the thread has ended by then."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def offer(self, image: CameraImage) -> None:
        """The newest image of a camera; never waits."""
        now_ns = self._clock.now_ns()
        self._latency.add(CAMERA, now_ns - image.timestamp_ns)
        with self._changed:
            self.overtaken[image.camera] += self._slots[image.camera] is not None
            self._slots[image.camera] = (image, now_ns)
            self._last_ns[image.camera] = now_ns
            self._changed.notify()

    def expect(self, people: Callable[[], Sequence[np.ndarray]]) -> None:
        """Where people are expected from now on, per camera (m, k, 3).

        `people` is called only where the detector has used what it was told before.
        """
        if self._curious:
            self._curious = False
            self._expected = people()

    @property
    def idle(self) -> bool:
        """Nothing waits to be looked at."""
        return not any(self._slots)

    def _run(self) -> None:
        while (images := self._gather()) is not None:
            try:
                self._look(images)
            except Exception as error:  # a network that fails on one image goes on with the next
                self.failures += 1
                if self.failures == 1 or self.failures % 100 == 0:
                    self._incidents.add(
                        f"the detector failed ({self.failures} times so far): "
                        f"{type(error).__name__}: {error}"
                    )
                self._detector.reset()
                self._sleep(_PAUSE_AFTER_FAILURE_S)

    def _gather(self) -> list[tuple[CameraImage, int]] | None:
        """New images of as many cameras as come within the time; None at the end."""
        with self._changed:
            while not self._stopping and not any(self._slots):
                self._changed.wait()
            deadline_ns = self._clock.now_ns() + GATHER_NS
            while not self._stopping and (left_ns := deadline_ns - self._clock.now_ns()) > 0:
                if all(slot or self._is_dead(i) for i, slot in enumerate(self._slots)):
                    break
                self._changed.wait(1e-9 * left_ns)
            if self._stopping:
                return None
            taken = [slot for slot in self._slots if slot is not None]
            self._slots = [None] * len(self._slots)
            return taken

    def _is_dead(self, camera: int) -> bool:
        return self._clock.now_ns() - self._last_ns[camera] > _ALIVE_NS

    def _look(self, taken: list[tuple[CameraImage, int]]) -> None:
        start_ns = self._clock.now_ns()
        images: list[np.ndarray | None] = [None] * len(self._slots)
        for image, arrival_ns in taken:
            images[image.camera] = image.image
            self._latency.add(WAIT_FOR_DETECTOR, start_ns - arrival_ns)
            self._show(image)
        expected, self._curious = self._expected, True
        found = self._detector.detect(images, expected)
        looks = {i.camera: self._clothes.read(i.image, found[i.camera]) for i, _ in taken}
        end_ns = self._clock.now_ns()
        self._latency.add(DETECTION, end_ns - start_ns)
        self.rounds.add(end_ns)
        self.images += len(taken)
        for image, _ in taken:
            self._emit(
                CameraSample(
                    camera=image.camera,
                    timestamp_ns=image.timestamp_ns,
                    people=found[image.camera],
                    appearance=looks[image.camera],
                )
            )

    def _nobody(self, cameras: int) -> list[np.ndarray]:
        return [np.empty((0, len(self._detector.landmarks.landmark_names), 3))] * cameras

    def _sleep(self, seconds: float) -> None:
        with self._changed:
            if not self._stopping:
                self._changed.wait_for(lambda: self._stopping, seconds)
