"""What sending costs: one instant of two people per protocol, and receivers that do not read.

uv run pytest benchmarks/test_streams_speed.py --benchmark-only
"""

from __future__ import annotations

import contextlib
import socket
import time

import pytest

from fusecap.evaluate.demo_scene import demo_scene
from fusecap.streams.person_pose import StreamFrame, pose_of_take
from fusecap.streams.play_take import TakePlayer
from fusecap.streams.protocols.livelink import livelink_datagrams
from fusecap.streams.protocols.lsl import lsl_sample
from fusecap.streams.protocols.osc import osc_datagrams
from fusecap.streams.protocols.rokoko import rokoko_datagrams
from fusecap.streams.protocols.vmc import vmc_datagrams
from fusecap.streams.protocols.ws import frame_bytes, frame_text
from fusecap.streams.stream import open_stream
from fusecap.streams.target import parse_target
from fusecap.streams.transports import Counts, UdpSender

ENCODERS = {
    "vmc": lambda frame: [vmc_datagrams(pose, 0.0) for pose in frame.tracked],
    "livelink": livelink_datagrams,
    "rokoko": lambda frame: rokoko_datagrams(frame, 60.0),
    "osc": osc_datagrams,
    "ws text": frame_text,
    "ws binary": frame_bytes,
    "lsl": lambda frame: [lsl_sample(pose, pose.skeleton) for pose in frame.tracked],
}


@pytest.fixture(scope="module")
def take():
    return demo_scene(seconds=2.0).truth


@pytest.mark.parametrize("protocol", ENCODERS)
def test_encode_two_people(benchmark, take, protocol):
    """Poses are built anew each time, as in a live run."""

    def fresh():
        poses = [pose_of_take(take, subject, 60) for subject in (0, 1)]
        people = {pose.name: pose for pose in poses if pose is not None}
        return (StreamFrame(time_s=1.0, timestamp_ns=0, people=people),), {}

    benchmark.pedantic(ENCODERS[protocol], setup=fresh, rounds=1000)


@pytest.mark.parametrize("receiver", ["reads nothing", "absent"])
def test_send_a_datagram(benchmark, receiver):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
        if receiver == "absent":
            bound.close()
        sender = UdpSender("127.0.0.1", port, Counts())
        benchmark(sender.send, bytes(1400))
        sender.close()


@pytest.mark.parametrize("client", ["none", "reads nothing"])
def test_send_to_websocket(benchmark, take, client):
    player = TakePlayer(take)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    stream = open_stream(parse_target(f"ws://127.0.0.1:{port}"), player.cast, 60.0)
    frame = player.frame(60)
    assert frame is not None
    with contextlib.ExitStack() as closing:
        closing.callback(stream.close)
        if client == "reads nothing":
            stalled = closing.enter_context(socket.create_connection(("127.0.0.1", port)))
            stalled.sendall(
                b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
                b"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            )
            stalled.recv(20)
            while "no client" in stream.remark():
                time.sleep(0.01)
        benchmark.pedantic(stream.send, args=(frame,), rounds=1000, warmup_rounds=200)
