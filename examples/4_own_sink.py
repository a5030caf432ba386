"""Own sink: what a live run solves, in the hands of one's own program.

    python examples/4_own_sink.py

A listener hears of every event, every solved instant, every picture and the status once a second,
and must return at once. This one sends a datagram whenever somebody's hand goes above or below
their head, as a lighting desk would want it. A session that was recorded is played as if it were
live.
"""

import json
import socket
import tempfile
from pathlib import Path

import fusecap
from fusecap.engine.engine import LiveStep
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.live.devices.playback_sources import PlaybackOptions, playback_sources
from fusecap.live.devices.source import SessionClock
from fusecap.live.run import LiveRun
from fusecap.live.status import LiveStatus
from fusecap.setup import session_setup
from fusecap.types import CameraImage, Event


class HandsUp:
    """One datagram per change."""

    def __init__(self, address: tuple[str, int]) -> None:
        self.instants = 0
        self._address = address
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._up: dict[str, bool] = {}

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        """Everybody, solved; None where there is no pose to send."""
        self.instants += 1
        for name, estimate in step.people.items():
            if estimate is None:
                continue
            skeleton, place_m = estimate.shape.skeleton, estimate.bone_position_in_world_m
            hands_m = [place_m[skeleton.bone(f"{side}_hand"), 1] for side in ("left", "right")]
            up = bool(max(hands_m) > place_m[skeleton.bone("head"), 1])
            if self._up.get(name) != up:
                self._up[name] = up
                message = json.dumps({"who": name, "hand_up": up, "time_ns": step.timestamp_ns})
                self._socket.sendto(message.encode(), self._address)

    def on_event(self, event: Event, arrival_ns: int) -> None:
        """Samples, in the order in which they were taken."""

    def on_image(self, image: CameraImage) -> None:
        """Pictures, as they go to the detector."""

    def on_status(self, status: LiveStatus) -> None:
        """Once a second."""

    def close(self) -> None:
        """The run is over."""
        self._socket.close()


with (
    tempfile.TemporaryDirectory() as folder,
    socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as desk,
):
    desk.bind(("127.0.0.1", 0))
    desk.settimeout(1.0)
    session = fusecap.load_session(write_session(demo_scene(seconds=1.5), Path(folder)))
    clock = SessionClock()
    sink = HandsUp(desk.getsockname())
    sources = playback_sources(session, clock, PlaybackOptions())
    setup = session_setup(session, simulated=True)
    LiveRun(setup, sources, None, listeners=[sink], clock=clock).run()
    print(f"{sink.instants} instants heard; the first datagram: {desk.recv(4096).decode()}")
