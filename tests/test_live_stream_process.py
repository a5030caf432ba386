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
from fusecap.engine.engine import LiveStep
from fusecap.errors import InputError
from fusecap.live.devices.source import SessionClock
from fusecap.live.latency import EXPOSURE_TO_PACKET, LatencyBook
from fusecap.live.stream_process import QUEUE, StreamProcess
from fusecap.pipeline import Step
from fusecap.streams.target import Target
from fusecap.types import Detections, Estimate, Status

SHAPE = BodyShape.from_height(PAPER21, 1.7)
PATIENCE_S = 30.0


def step_at(timestamp_ns: int, x_m: float) -> LiveStep:
    """Anna in the rest pose, at x."""
    bones = len(PAPER21.bone_names)
    position_m = np.cumsum(SHAPE.offsets_m, axis=0) * 0.0
    position_m[:, 0] = x_m
    anna = Estimate(
        track_id=0,
        name="anna",
        timestamp_ns=timestamp_ns,
        theta=np.zeros(PAPER21.pose_size),
        bone_position_in_world_m=position_m,
        bone_rotation_in_world=np.tile(np.eye(3), (bones, 1, 1)),
        bone_quality=np.ones(bones),
        shape=SHAPE,
        status=Status.CONVERGED,
        iterations=1,
        cost=0.0,
        solve_s=0.0,
        views=np.ones(1, dtype=np.bool_),
    )
    return LiveStep(
        timestamp_ns=timestamp_ns,
        detections=Detections(timestamp_ns=timestamp_ns, people=()),
        readings={},
        step=Step(updates=(), estimates=(anna,)),
        people={"anna": anna},
    )


@pytest.fixture
def receiver() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        one.settimeout(PATIENCE_S)
        yield one


def streams_to(*targets: Target, latency: LatencyBook | None = None) -> StreamProcess:
    cast = {"anna": SHAPE}
    return StreamProcess(targets, cast, 60.0, SessionClock(), latency or LatencyBook())


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
    (output,) = streams.outputs
    for number in range(1, 11):
        streams.on_step(step_at(number * 16_666_667, 0.1 * number), number * 16_666_667)
        pelvis = json.loads(receiver.recv(8192))["anna"][0]
        assert pelvis["Name"] == "pelvis" and pelvis["Location"][0] == pytest.approx(10.0 * number)
    until(lambda: output.poses == 10)
    assert output.stream_status().sent == 10 and output.stream_status().to.startswith("livelink")
    times = {stage.stage: stage.count for stage in latency.total()}
    assert times[EXPOSURE_TO_PACKET] == 10
    streams.close()
    assert streams._process.returncode == 0


@pytest.mark.slow
def test_instants_before_the_end_are_sent_and_the_last_report_comes(receiver):
    streams = streams_to(livelink(receiver))
    streams.on_step(step_at(1, 0.5), 1)
    streams.close()
    assert json.loads(receiver.recv(8192))["anna"] and streams.outputs[0].poses == 1


@pytest.mark.slow
def test_child_that_lies_behind_loses_the_oldest_instants_and_sends_the_newest(receiver):
    streams = streams_to(livelink(receiver))
    os.kill(streams._process.pid, signal.SIGSTOP)
    for number in range(1, 101):
        streams.on_step(step_at(number, 0.01 * number), number)
    os.kill(streams._process.pid, signal.SIGCONT)
    streams.close()
    (output,) = streams.outputs
    sent_cm = [
        round(json.loads(receiver.recv(8192))["anna"][0]["Location"][0])
        for _ in range(output.poses)
    ]
    assert sent_cm == sorted(sent_cm) and sent_cm[-QUEUE:] == [98, 99, 100]
    assert output.stream_status().dropped == 100 - output.poses > 0


@pytest.mark.slow
def test_address_that_cannot_be_had_is_refused_as_without_a_process():
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=str(port)):
            streams_to(Target(protocol="ws", host="127.0.0.1", port=port))


@pytest.mark.slow
def test_killed_process_is_told_of_and_holds_up_nobody(receiver):
    streams = streams_to(livelink(receiver), livelink(receiver))
    os.kill(streams._process.pid, signal.SIGKILL)
    until(lambda: all(output.gone for output in streams.outputs))
    for number in range(100):
        streams.on_step(step_at(number, 0.0), number)
    assert "process has ended" in streams.outputs[1].stream_status().remark
    streams.close()
