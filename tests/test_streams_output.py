"""Streams of a live run: receivers that stall or are not there, people who come and go."""

from __future__ import annotations

import json
import socket

import numpy as np
import pytest
from pythonosc.osc_bundle import OscBundle
from websockets.sync.client import connect

from fusecap.errors import InputError
from fusecap.live.devices.source import SessionClock
from fusecap.live.latency import LatencyBook
from fusecap.live.streaming import first_cast
from fusecap.streams.output import StreamOutput
from fusecap.streams.person_pose import pose_of_estimate
from fusecap.streams.protocols.vmc import VmcStream
from fusecap.streams.stream import open_stream
from fusecap.streams.target import Target, parse_target
from fusecap.streams.transports import Counts
from fusecap.types import Estimate
from live_fakes import estimate_of, live_setup, step_of, wait_for
from motions import person
from scenes import ring

HOST = "127.0.0.1"


class KeepingStream:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.target, self.counts = Target(protocol="osc", host=HOST, port=9), Counts()
        self.frames, self.casts = [], []
        self.closed = False

    def send(self, frame) -> None:
        self.frames.append(frame)

    def set_cast(self, cast) -> None:
        self.casts.append(cast)

    def remark(self) -> str:
        return ""

    def where(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        self.closed = True


def output_to(stream, cast=None) -> StreamOutput:
    return StreamOutput(lambda cast: stream, cast or {}, SessionClock().now_ns, LatencyBook().sent)


def free_port(kind=socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


def step_with(number: int, *people: Estimate):
    return step_of(number, people or [estimate_of(number)])


def send(output, step, now_ns) -> None:
    poses = {name: each and pose_of_estimate(each) for name, each in step.people.items()}
    output.send(poses, step.timestamp_ns, now_ns)


def test_a_stream_that_raises_says_so_and_goes_on():
    class Failing(KeepingStream):
        def send(self, frame):
            self.frames.append(frame)
            if len(self.frames) == 1:
                raise ValueError("no such packet")

    stream = Failing()
    output = output_to(stream)
    send(output, step_with(0), 0)
    wait_for(lambda: stream.counts.failed)
    assert output.status().remark == "ValueError: no such packet"
    send(output, step_with(1), 0)
    wait_for(lambda: output.poses == 1)
    assert output.status().remark == ""
    output.close()


def test_latency_is_that_of_the_packet():
    clock, book, stream = SessionClock(), LatencyBook(), KeepingStream()
    output = StreamOutput(lambda cast: stream, {}, clock.now_ns, book.sent)
    now_ns = clock.now_ns()
    book.solved(now_ns - 50_000_000, now_ns - 20_000_000)
    send(output, step_with(now_ns - 50_000_000), now_ns)
    output.close()
    stages = {stage.stage: stage for stage in book.total()}
    assert stages["exposure to packet"].p50_ms >= 48
    assert 19 <= stages["last sample to packet"].p50_ms < stages["exposure to packet"].p50_ms
    assert stages["encode and send"].count == 1


def test_the_cast_begins_with_the_session_and_follows_who_comes_and_goes():
    stream = KeepingStream()
    setup = live_setup(ring(0))
    cast = first_cast(setup)
    assert list(cast) == ["anna"]
    output = output_to(stream, cast)
    send(output, step_with(0, estimate_of(0)), 0)
    send(output, step_with(1, estimate_of(1), estimate_of(1, "guest")), 0)
    send(output, step_with(2, estimate_of(2, "guest")), 0)
    output.close()
    assert [list(cast) for cast in stream.casts] == [["anna", "guest"], ["guest"]]
    assert [list(frame.people) for frame in stream.frames] == [
        ["anna"],
        ["anna", "guest"],
        ["guest"],
    ]


def test_a_body_that_is_measured_is_told_once_a_second_at_most():
    class Clock(SessionClock):
        now = 0

        def now_ns(self):
            return self.now

    clock, stream = Clock(), KeepingStream()
    output = StreamOutput(lambda cast: stream, {"anna": person()}, clock.now_ns, LatencyBook().sent)
    for number in range(4):
        clock.now = number * 600_000_000
        send(output, step_with(number, estimate_of(number, shape=person(1.6 + 0.01 * number))), 0)
        wait_for(lambda number=number: output.poses == number + 1)
    output.close()
    assert [cast["anna"].height_m for cast in stream.casts] == pytest.approx([1.62])


def test_vmc_keeps_ports_and_gives_free_ones_to_who_comes():
    cast = {name: person() for name in ("anna", "ben")}
    port = 40000 + free_port() % 10000
    stream = VmcStream(parse_target(f"vmc://{HOST}:{port}"), cast)
    stream.set_cast({"ben": person(), "cleo": person()})
    assert stream.where() == {
        "ben": f"vmc://{HOST}:{port + 10}",
        "cleo": f"vmc://{HOST}:{port}",
    }
    stream.close()


def test_vmc_without_room_for_someone_says_so_and_serves_the_others():
    stream = VmcStream(parse_target(f"vmc://{HOST}:65530"), {"anna": person()})
    with pytest.raises(InputError, match="2 people need ports up to 65540"):
        stream.set_cast({"anna": person(), "ben": person()})
    output = StreamOutput(
        lambda cast: stream, {"anna": person()}, SessionClock().now_ns, LatencyBook().sent
    )
    send(output, step_with(0, estimate_of(0), estimate_of(0, "ben")), 0)
    wait_for(lambda: output.status().remark)
    send(output, step_with(1, estimate_of(1), estimate_of(1, "ben")), 0)
    wait_for(lambda: stream.counts.sent + stream.counts.refused > 1)
    output.close()


def test_clients_of_the_websocket_hear_of_a_new_person():
    target = parse_target(f"ws://{HOST}:{free_port()}")
    output = StreamOutput(
        lambda cast: open_stream(target, cast, 60.0),
        {"anna": person()},
        SessionClock().now_ns,
        LatencyBook().sent,
    )
    with connect(str(target), compression=None) as client:
        assert [p["name"] for p in json.loads(client.recv(10))["people"]] == ["anna"]
        wait_for(lambda: not output.status().remark)
        send(output, step_with(1, estimate_of(1), estimate_of(1, "guest")), 0)
        message = json.loads(client.recv(10))
        assert message["type"] == "cast"
        assert [p["name"] for p in message["people"]] == ["anna", "guest"]
        assert list(json.loads(client.recv(10))["people"]) == ["anna", "guest"]
    output.close()


@pytest.mark.slow
def test_a_websocket_client_that_never_reads_and_a_port_without_a_listener_hold_nobody():
    """Three streams of one run; the one whose receiver is well gets every instant."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as well, socket.socket() as deaf:
        well.bind((HOST, 0))
        well.settimeout(10)
        targets = [
            parse_target(f"ws://{HOST}:{free_port()}"),
            parse_target(f"osc://{HOST}:{free_port(socket.SOCK_DGRAM)}"),
            parse_target(f"osc://{HOST}:{well.getsockname()[1]}"),
        ]
        clock, book = SessionClock(), LatencyBook()
        outputs = [
            StreamOutput(
                lambda cast, target=target: open_stream(target, cast, 60.0),
                {"anna": person()},
                clock.now_ns,
                book.sent,
            )
            for target in targets
        ]
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect((HOST, targets[0].port))
        deaf.sendall(
            b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
        wait_for(lambda: not outputs[0].status().remark)
        number = -1
        while number < 300 or not outputs[0].status().dropped:
            number += 1
            assert number < 20_000, "the system's buffers take more than any client has"
            for output in outputs:
                send(output, step_with(number), 0)
            wait_for(lambda number=number: outputs[2].poses == number + 1)
            first = well.recv(65536)
            well.recv(65536)
        assert outputs[1].status().failed == 0
        addresses = [message.address for message in OscBundle(first)]
        assert addresses[0] == "/fusecap/time"
        for output in outputs:
            output.close()
    assert np.all([output.status().sent > 0 for output in outputs])
