"""Streams in a process of their own."""

from __future__ import annotations

import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.live.devices.source import SessionClock
from fusecap.live.latency import EXPOSURE_TO_PACKET, LatencyBook
from fusecap.streams.person_pose import PersonPose
from fusecap.streams.process import QUEUE, StreamProcess
from fusecap.streams.target import Target

SHAPE = BodyShape.from_height(PAPER21, 1.7)
PATIENCE_S = 30.0


def anna_at(timestamp_ns: int, x_m: float) -> dict[str, PersonPose | None]:
    """In the rest pose, at x."""
    bones = len(PAPER21.bone_names)
    anna = PersonPose(
        name="anna",
        timestamp_ns=timestamp_ns,
        shape=SHAPE,
        bone_position_in_world_m=np.tile([x_m, 0.0, 0.0], (bones, 1)),
        bone_rotation_in_world=np.tile(np.eye(3), (bones, 1, 1)),
        bone_quality=np.ones(bones),
    )
    return {"anna": anna}


def send(streams: StreamProcess, timestamp_ns: int, x_m: float) -> None:
    streams.send(anna_at(timestamp_ns, x_m), timestamp_ns, timestamp_ns)


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(PATIENCE_S)
        yield one


def streams_to(
    *targets: Target,
    latency: LatencyBook | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> StreamProcess:
    cast, sent = {"anna": SHAPE}, (latency or LatencyBook()).sent
    return StreamProcess(targets, cast, 60.0, SessionClock().now_ns, sent, report)


def livelink(receiver: socket.socket) -> Target:
    return Target(protocol="livelink", host="127.0.0.1", port=receiver.getsockname()[1])


def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.01)


@pytest.mark.slow
def test_every_instant_is_sent_reported_and_timed(receiver):
    latency = LatencyBook()
    streams = streams_to(livelink(receiver), latency=latency)
    for number in range(1, 11):
        send(streams, number * 16_666_667, 0.1 * number)
        pelvis = json.loads(receiver.recv(8192))["anna"][0]
        assert pelvis["Name"] == "pelvis" and pelvis["Location"][0] == pytest.approx(10.0 * number)
    until(lambda: streams.poses == (10,))
    (status,) = streams.statuses()
    assert status.sent == 10 and status.to.startswith("livelink")
    times = {stage.stage: stage.count for stage in latency.total()}
    assert times[EXPOSURE_TO_PACKET] == 10
    streams.close()
    assert streams._child.end() == 0


@pytest.mark.slow
def test_instants_before_the_end_are_sent_and_the_last_report_comes(receiver):
    streams = streams_to(livelink(receiver))
    send(streams, 1, 0.5)
    streams.close()
    assert json.loads(receiver.recv(8192))["anna"] and streams.poses == (1,)


@pytest.mark.slow
def test_child_that_lies_behind_loses_the_oldest_instants_and_sends_the_newest(receiver):
    streams = streams_to(livelink(receiver))
    os.kill(streams._child.pid, signal.SIGSTOP)
    for number in range(1, 101):
        send(streams, number, 0.01 * number)
    os.kill(streams._child.pid, signal.SIGCONT)
    streams.close()
    sent_cm = [
        round(json.loads(receiver.recv(8192))["anna"][0]["Location"][0])
        for _ in range(streams.poses[0])
    ]
    assert sent_cm == sorted(sent_cm) and sent_cm[-QUEUE:] == [98, 99, 100]
    assert streams.statuses()[0].dropped == 100 - streams.poses[0] > 0


@pytest.mark.slow
def test_address_that_cannot_be_had_is_refused_as_without_a_process():
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=str(port)):
            streams_to(Target(protocol="ws", host="127.0.0.1", port=port))


@pytest.mark.slow
def test_killed_process_is_told_of_holds_up_nobody_and_is_started_again(receiver):
    told: list[str] = []
    streams = streams_to(livelink(receiver), livelink(receiver), report=told.append)
    send(streams, 1, 0.0)
    until(lambda: streams.poses == (1, 1))
    os.kill(streams._child.pid, signal.SIGKILL)
    until(lambda: streams.gone)
    for number in range(2, 102):
        send(streams, number, 0.0)
    assert "process has ended" in streams.statuses()[1].remark
    until(lambda: not streams.gone)
    assert "killed by signal 9" in told[0] and told[-1] == "streams: sent again"
    send(streams, 102, 0.25)
    until(lambda: streams.poses[0] > 1)
    streams.close()
    status = streams.statuses()[0]
    assert status.sent == streams.poses[0] and status.sent + status.dropped == 102
    assert status.remark == ""


@pytest.mark.slow
def test_process_that_is_closed_while_it_is_gone_ends_at_once(receiver):
    streams = streams_to(livelink(receiver))
    os.kill(streams._child.pid, signal.SIGKILL)
    until(lambda: streams.gone)
    started_s = time.monotonic()
    streams.close()
    assert time.monotonic() - started_s < 3.0
    assert not any(thread.is_alive() for thread in streams._threads)


def test_a_system_without_room_for_the_process_is_told_as_a_stream_that_cannot_be_opened(
    monkeypatch,
):
    def refuse(*_, **__):
        raise OSError(12, "Cannot allocate memory")

    monkeypatch.setattr("fusecap.streams.process.subprocess.Popen", refuse)
    with pytest.raises(InputError, match="cannot be started: Cannot allocate memory"):
        StreamProcess(
            [], {"anna": SHAPE}, 60.0, SessionClock().now_ns, LatencyBook().sent, lambda _: None
        )
