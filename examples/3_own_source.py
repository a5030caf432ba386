"""Own source: a live run fed by a device of one's own.

    python examples/3_own_source.py

A source is any object with a name, counts and `run`, which delivers until it is told to stop:
pictures for the detector (`CameraImage`), keypoints (`CameraSample`) or sensors (`ImuSample`),
each stamped on the run's clock. This one delivers the keypoints of the simulated demo as a network
camera that detects by itself would.
"""

import tempfile
import threading
from pathlib import Path

import fusecap
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.live.devices.source import Deliver, SessionClock, SourceCounts
from fusecap.live.run import LiveRun
from fusecap.setup import session_setup
from fusecap.types import CameraSample, Detections


class KeypointCameras:
    """All cameras of a session; where a device is gone raise `SourceLost`: `run` comes again."""

    name = "keypoint cameras"

    def __init__(self, instants: tuple[Detections, ...], clock: SessionClock) -> None:
        self.counts = SourceCounts()
        self._instants = instants
        self._clock = clock

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """On a thread of its own; `deliver` never waits."""
        start_ns = self._clock.now_ns()
        for seen in self._instants:
            now_ns = start_ns + seen.timestamp_ns
            if stopping.wait(max(0.0, 1e-9 * (now_ns - self._clock.now_ns()))):
                return
            for camera, people in enumerate(seen.people):
                deliver(CameraSample(camera=camera, timestamp_ns=now_ns, people=people))
                self.counts.received += 1


scene = demo_scene(seconds=1.5)
with tempfile.TemporaryDirectory() as folder:
    session = fusecap.load_session(write_session(scene, Path(folder)))
    clock = SessionClock()
    source = KeypointCameras(scene.detections, clock)
    run = LiveRun(session_setup(session, simulated=True), [source], None, clock=clock)
    report = run.run()
print(f"{source.counts.received} samples, {report.instants} instants solved")
for name, subject in report.subjects.items():
    print(f"{name}: a pose in {100 * subject.tracked_share:.0f} % of them")
