"""Sockets, threads and the clock: received by python-osc, websockets and pylsl on this machine."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import BlockingOSCUDPServer
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from fusecap.errors import InputError, TakeError
from fusecap.streams.door import Door
from fusecap.streams.play_take import TakePlayer, play
from fusecap.streams.protocols.ws import WebSocketStream
from fusecap.streams.stream import open_stream
from fusecap.streams.target import Target, parse_target
from fusecap.streams.transports import CLIENT_QUEUE, Counts, UdpSender, WebSocketServer
from fusecap.take import save_take
from motions import person, take_of, walk

RATE_HZ = 50.0
HOST = "127.0.0.1"


@pytest.fixture(scope="module")
def take():
    """Half a second of two walkers."""
    walks = [walk(person(), 25, rate_hz=RATE_HZ, phase_rad=phase) for phase in (0.0, 1.0)]
    return take_of(np.stack(walks), [person()] * 2, names=("anna", "ben"), rate_hz=RATE_HZ)


@pytest.fixture
def receiver():
    """A bound UDP socket that nobody reads unless the test does."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind((HOST, 0))
        bound.settimeout(5)
        yield bound


def free_port(kind=socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind((HOST, 0))
        return probe.getsockname()[1]


class FakeTime:
    """A clock that only sleeping and sending move."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def clock(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds + 0.0004
        """Sleeps always last too long."""


class Recorder:
    """A stream that notes when it got what."""

    def __init__(self, time: FakeTime, send_s: float = 0.0) -> None:
        self.target, self.counts = Target(protocol="osc"), Counts()
        self.got: list[tuple[float, float]] = []
        self._time, self._send_s = time, send_s

    def send(self, frame) -> None:
        self.got.append((self._time.now_s - 100.0, frame.time_s))
        self._time.now_s += self._send_s

    def remark(self) -> str:
        return ""

    def where(self) -> dict[str, str]:
        return {}

    def close(self) -> None: ...


# The clock


def test_playback_does_not_drift(take):
    time = FakeTime()
    recorder = Recorder(time)

    class Ended(Recorder):
        def send(self, frame):
            if len(recorder.got) == 3000:
                raise KeyboardInterrupt

    state = play(
        TakePlayer(take, loop=True), [recorder, Ended(time)], clock=time.clock, sleep=time.sleep
    )
    sent_s, recorded_s = np.array(recorder.got).T
    assert np.allclose(recorded_s, np.arange(3000) / RATE_HZ, atol=1e-6)
    assert np.abs(sent_s - recorded_s).max() < 0.001, "as late at the end as at the start"
    assert state.interrupted
    assert state.skipped == 0


def test_speed_scales_time(take):
    time = FakeTime()
    recorder = Recorder(time)
    state = play(TakePlayer(take, speed=2.0), [recorder], clock=time.clock, sleep=time.sleep)
    sent_s, recorded_s = np.array(recorder.got).T
    assert np.abs(sent_s - recorded_s / 2).max() < 0.001
    assert state.frames == 25
    assert state.rate_hz == pytest.approx(100, rel=0.01)


def test_who_is_slow_skips_frames_and_stays_on_time(take):
    time = FakeTime()
    recorder = Recorder(time, send_s=0.045)
    state = play(TakePlayer(take), [recorder], clock=time.clock, sleep=time.sleep)
    sent_s, recorded_s = np.array(recorder.got).T
    assert (sent_s - recorded_s).max() < 1.5 / RATE_HZ
    assert state.frames + state.skipped == 25
    assert 10 <= state.frames <= 14


def test_untracked_people_are_sent_as_such(take):
    tracked = np.array([[True] * 25, [True] * 10 + [False] * 15])
    player = TakePlayer(replace(take, tracked=tracked))
    frame = player.frame(12)
    assert frame is not None and frame.people["ben"] is None
    assert [pose.name for pose in frame.tracked] == ["anna"]


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({}, {"subjects": ["benn"]}, "no subject 'benn'; did you mean 'ben'"),
        ({}, {"speed": 0.0}, "--speed 0: expected 0.01 to 100"),
        ({}, {"speed": float("nan")}, "--speed nan"),
        ({"tracked": np.zeros((2, 25), dtype=bool)}, {}, "never tracks anybody"),
        (
            {"tracked": np.zeros((2, 25), dtype=bool)},
            {"subjects": ["ben"]},
            "never tracks 'ben': nothing to stream",
        ),
    ],
)
def test_what_cannot_be_played_is_refused(take, change, options, message):
    with pytest.raises(InputError, match=message):
        TakePlayer(replace(take, **change), **options)


def test_take_without_frames_is_refused(take):
    empty = take_of(np.zeros((1, 0, 66)), [person()], names=("anna",))
    with pytest.raises(TakeError, match="no frame"):
        TakePlayer(empty)


# Targets


@pytest.mark.parametrize(
    ("text", "full"),
    [
        ("vmc", "vmc://127.0.0.1:39539"),
        ("livelink://10.0.0.5", "livelink://10.0.0.5:54321"),
        ("rokoko://studio.local", "rokoko://studio.local:14043"),
        ("osc://:7000", "osc://127.0.0.1:7000"),
        ("ws://[::1]:9001", "ws://[::1]:9001"),
        ("lsl", "lsl"),
        ("lsl://", "lsl"),
    ],
)
def test_target_fills_in_the_usual_port(text, full):
    assert str(parse_target(text)) == full


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("vcm://127.0.0.1", "no protocol 'vcm', expected .*; did you mean 'vmc'"),
        ("127.0.0.1:39539", "no protocol '127.0.0.1:39539'"),
        ("vmc://", "a host is missing"),
        ("osc://127.0.0.1:port", "the port must be a number"),
        ("osc://127.0.0.1:70000", "the port must be a number"),
        ("osc://127.0.0.1:0", "the port must be a number"),
        ("ws://127.0.0.1:8765/binary", "only a host and a port"),
        ("lsl://127.0.0.1", "finds its receivers by itself"),
    ],
)
def test_wrong_target_says_what_is_wrong(text, message):
    with pytest.raises(InputError, match=message):
        parse_target(text)


# UDP


def test_vmc_arrives_at_a_dispatcher_one_port_per_person(take):
    """Servers of python-osc on two ports ten apart."""
    heard: dict[str, list] = {}
    servers = []
    with contextlib.ExitStack() as closing:
        for _ in range(20):
            port = free_port(socket.SOCK_DGRAM)
            try:
                for name, number in (("anna", port), ("ben", port + 10)):
                    dispatcher = Dispatcher()
                    heard[name] = []
                    dispatcher.set_default_handler(
                        lambda address, *values, name=name: heard[name].append((address, values))
                    )
                    servers.append(BlockingOSCUDPServer((HOST, number), dispatcher))
                    closing.callback(servers[-1].server_close)
                break
            except OSError:
                servers.clear()
        player = TakePlayer(take)
        stream = open_stream(parse_target(f"vmc://{HOST}:{port}"), player.cast, RATE_HZ)
        frame = player.frame(0)
        assert frame is not None
        stream.send(frame)
        for server in servers:
            server.timeout = 5
            server.handle_request()
            server.handle_request()
        stream.close()
    for messages in heard.values():
        assert [address for address, _ in messages[:3]] == [
            "/VMC/Ext/T",
            "/VMC/Ext/OK",
            "/VMC/Ext/Root/Pos",
        ]
        assert len(messages) == 3 + 22
    hips = [{v[0]: v[1:] for _, v in heard[name][2:]}["Hips"] for name in ("anna", "ben")]
    assert hips[0][1] == pytest.approx(person().standing_root_height_m, abs=1e-5)
    assert stream.counts.sent == 4 and stream.counts.refused == 0


@pytest.mark.parametrize("protocol", ["livelink", "rokoko"])
def test_json_protocols_arrive_whole(take, receiver, protocol):
    player = TakePlayer(take)
    target = parse_target(f"{protocol}://{HOST}:{receiver.getsockname()[1]}")
    stream = open_stream(target, player.cast, RATE_HZ)
    frame = player.frame(3)
    assert frame is not None
    stream.send(frame)
    packet = json.loads(receiver.recv(65536))
    stream.close()
    if protocol == "livelink":
        assert list(packet) == ["anna", "ben"]
    else:
        assert [actor["name"] for actor in packet["scene"]["actors"]] == ["anna", "ben"]


def test_receiver_that_reads_nothing_does_not_hold_the_sender(receiver):
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    counts = Counts()
    sender = UdpSender(HOST, receiver.getsockname()[1], counts)
    for _ in range(5000):
        sender.send(bytes(1400))
    sender.close()
    assert counts.sent + counts.dropped == 5000
    assert counts.failed == counts.refused == 0


def test_absent_receiver_is_noticed_and_every_packet_still_sent(take):
    port = free_port(socket.SOCK_DGRAM)
    player = TakePlayer(take)
    stream = open_stream(parse_target(f"osc://{HOST}:{port}"), player.cast, RATE_HZ)
    for index in range(10):
        frame = player.frame(index)
        assert frame is not None
        stream.send(frame)
    assert stream.counts.sent == 30
    assert stream.counts.failed == 0
    if stream.counts.refused:
        assert "nobody listens there" in stream.remark()
    stream.close()


def test_packet_beyond_what_udp_holds_is_counted_not_raised(receiver):
    counts = Counts()
    sender = UdpSender(HOST, receiver.getsockname()[1], counts)
    sender.send(bytes(70_000))
    sender.send(b"next")
    sender.close()
    assert (counts.failed, counts.sent) == (1, 1)
    assert counts.last_failure


@pytest.mark.parametrize("host", ["no-such-host.invalid", "a..b", "x" * 70])
def test_host_that_is_none_is_named(host):
    with pytest.raises(InputError, match=f"cannot send to {re.escape(host)}:9000"):
        UdpSender(host, 9000, Counts())
    with pytest.raises(InputError, match=f"ws://{re.escape(host)}:9000: the port cannot be opened"):
        WebSocketServer(host, 9000, Counts(), Door(token=""))


def test_people_beyond_the_last_port_are_refused(take):
    with pytest.raises(InputError, match="2 people need ports up to 65540"):
        open_stream(parse_target(f"vmc://{HOST}:65530"), TakePlayer(take).cast, RATE_HZ)


# WebSocket


HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


@pytest.fixture
def served(take):
    player = TakePlayer(take)
    target = parse_target(f"ws://{HOST}:{free_port()}")
    stream = WebSocketStream(target, player.cast, RATE_HZ)
    yield stream, player
    stream.close()


def send_until(stream, player, arrived: threading.Event) -> None:
    index = 0
    while not arrived.wait(0.01):
        stream.send(player.frame(index % 25))
        index += 1


@pytest.mark.parametrize("path", ["", "/binary"])
def test_websocket_client_gets_the_cast_then_frames(served, path):
    stream, player = served
    arrived = threading.Event()
    sending = threading.Thread(target=send_until, args=(stream, player, arrived))
    with connect(f"{stream.target}{path}") as client:
        sending.start()
        cast, first, second = (client.recv(timeout=5) for _ in range(3))
        arrived.set()
        sending.join()
    assert [p["name"] for p in json.loads(cast)["people"]] == ["anna", "ben"]
    if path:
        assert isinstance(first, bytes) and isinstance(second, bytes)
        assert first[:4] == second[:4] == b"FCS1"
    else:
        times = [json.loads(message)["time_s"] for message in (first, second)]
        assert times[0] < times[1]
    assert stream.counts.sent >= 2
    assert stream.remark() == ""


def test_websocket_without_clients_says_where_to_connect(served):
    stream, player = served
    stream.send(player.frame(0))
    assert stream.counts.sent == 0
    assert "no client has connected; open ws://127.0.0.1:" in stream.remark()


def test_stalled_client_loses_its_oldest_frames_and_holds_nobody():
    counts = Counts()
    port = free_port()
    server = WebSocketServer(HOST, port, counts, Door(token=""))
    with socket.create_connection((HOST, port)) as stalled:
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.sendall(HANDSHAKE)
        stalled.recv(20)
        with connect(f"ws://{HOST}:{port}", max_size=None) as reading:
            received = []

            def read():
                with contextlib.suppress(ConnectionClosed):
                    while True:
                        received.append(reading.recv())

            reader = threading.Thread(target=read)
            reader.start()
            while server.clients < 2:
                threading.Event().wait(0.005)
            for number in range(200):
                server.publish(f"{number:06d}" + "x" * 200_000, None)
                threading.Event().wait(0.001)
            server.close()
            reader.join()
    assert counts.dropped > 100
    assert received[-1][:6] == "000199"


def test_client_that_lies_behind_gets_the_newest_frames_once_it_reads_again():
    counts = Counts()
    port = free_port()
    server = WebSocketServer(HOST, port, counts, Door(token=""))
    with socket.create_connection((HOST, port)) as client:
        client.sendall(HANDSHAKE)
        client.recv(20)
        while not server.clients:
            threading.Event().wait(0.005)
        for number in range(100):
            server.publish(f"<{number:03d}>" + "x" * 200_000, None)
            threading.Event().wait(0.001)
        client.settimeout(2.0)
        heard = bytearray()
        with contextlib.suppress(TimeoutError):
            while b"<099>" not in heard[-300_000:]:
                heard += client.recv(1 << 20)
        server.close()
    assert counts.dropped > 50
    assert re.findall(rb"<(\d+)>", heard)[-CLIENT_QUEUE:] == [b"096", b"097", b"098", b"099"]


def test_noise_on_the_port_is_not_answered_with_a_traceback(served, capfd):
    stream, player = served
    with socket.create_connection((HOST, stream.target.port)) as noise:
        noise.sendall(b"\x00\xff" * 2000 + b"\r\n\r\n")
        with contextlib.suppress(OSError):
            noise.recv(100)
    stream.send(player.frame(0))
    assert capfd.readouterr().err == ""


def test_port_in_use_is_said():
    with socket.socket() as other:
        other.bind((HOST, 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(InputError, match=rf"ws://127.0.0.1:{port}: the port is in use"):
            WebSocketServer(HOST, port, Counts(), Door(token=""))


# LSL

LSL_PROGRAM = """
import sys
sys.path[:0] = {paths}
import numpy as np, pylsl, test_streams_live as t
from fusecap.streams.play_take import TakePlayer
from fusecap.streams.stream import open_stream
from fusecap.streams.target import parse_target
from motions import person, take_of, walk
take = take_of(walk(person(), 25)[None], [person()], names=("anna",), rate_hz=50.0)
player = TakePlayer(take)
stream = open_stream(parse_target("lsl"), player.cast, 50.0)
found = pylsl.resolve_byprop("name", "fusecap anna", timeout=5.0)
if not found:
    sys.exit("no stream resolved")
inlet = pylsl.StreamInlet(found[0])
info = inlet.info(timeout=5.0)
channel = info.desc().child("channels").child("channel")
inlet.open_stream(timeout=5.0)
for _ in range(50):
    stream.send(player.frame(4))
    sample, stamp = inlet.pull_sample(timeout=0.2)
    if sample:
        break
expected = take.bone_position_in_world_m[0, 4]
got = np.array(sample).reshape(-1, 8)[:, :3]
print(info.type(), info.channel_count(), info.nominal_srate(), channel.child_value("label"),
      channel.child_value("unit"), bool(np.allclose(got, expected, atol=1e-5)), stream.remark())
"""


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pylsl") is None, reason="the extra 'lsl' is not installed")
def test_lsl_inlet_gets_labelled_samples(tmp_path):
    """In a process of its own: the library reads its settings once, when it is loaded."""
    settings = tmp_path / "lsl_api.cfg"
    settings.write_text("[multicast]\nResolveScope = machine\n[log]\nlevel = -2\n")
    program = LSL_PROGRAM.format(paths=[p for p in sys.path if p])
    result = subprocess.run(
        [sys.executable, "-c", program],
        env=os.environ | {"LSLAPICFG": str(settings)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if "no stream resolved" in result.stderr:
        pytest.skip("LSL cannot find streams on this machine: no multicast on the loopback")
    assert result.stdout.split() == [
        "MoCap",
        "168",
        "50.0",
        "hips_PositionX",
        "meters",
        "True",
    ], result.stderr


def test_lsl_without_its_library_names_the_extra(take, monkeypatch):
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(InputError, match="pip install 'pylsl>="):
        open_stream(parse_target("lsl"), TakePlayer(take).cast, RATE_HZ)


# The command


@pytest.fixture
def take_file(take, tmp_path):
    save_take(take, tmp_path / "take.npz")
    return tmp_path / "take.npz"


def fusecap(*arguments, **options):
    command = [sys.executable, "-m", "fusecap", "stream", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **options)


@pytest.mark.slow
def test_command_plays_and_reports(take_file, receiver):
    port = receiver.getsockname()[1]
    result = fusecap(take_file, "--to", f"osc://{HOST}:{port}", "--json")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["frames"] + report["skipped"] == 25
    assert report["elapsed_s"] >= 0.5
    assert report["subjects"] == ["anna", "ben"]
    assert report["simulated"] is False
    (osc,) = report["streams"]
    assert osc["to"] == f"osc://{HOST}:{port}"
    assert osc["sent"] == 3 * report["frames"]
    assert osc["refused"] == osc["failed"] == 0


@pytest.mark.slow
def test_ctrl_c_ends_a_loop_cleanly(take_file, receiver):
    port = receiver.getsockname()[1]
    command = [sys.executable, "-m", "fusecap", "stream", str(take_file), "--loop", "--json"]
    with subprocess.Popen(
        [*command, "--to", f"rokoko://{HOST}:{port}", "--to", f"ws://{HOST}:{free_port()}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as playing:
        receiver.settimeout(60)
        for _ in range(30):
            receiver.recv(65536)
        playing.send_signal(signal.SIGINT)
        out, error = playing.communicate(timeout=30)
    assert playing.returncode == 0, error
    report = json.loads(out)
    assert report["interrupted"] and report["frames"] >= 29
    assert error == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "vcm"], "did you mean 'vmc'"),
        (["--to", "ws://0.0.0.0:8765"], "add --host 0.0.0.0"),
        (["--to", "osc", "--host", "0.0.0.0"], "--host is the address on which ws serves"),
        (["--to", "osc", "--to", f"osc://{HOST}:9000"], "is given twice"),
        (["--to", "osc", "--subject", "benn"], "did you mean 'ben'"),
    ],
)
def test_command_refuses_with_a_reason(take_file, monkeypatch, capsys, arguments, message):
    from fusecap.cli import main

    monkeypatch.setattr("sys.argv", ["fusecap", "stream", str(take_file), *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert message in capsys.readouterr().err


def test_command_names_a_missing_take(tmp_path, monkeypatch, capsys):
    from fusecap.cli import main

    monkeypatch.setattr("sys.argv", ["fusecap", "stream", str(tmp_path / "no.npz"), "--to", "osc"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 1
    assert "no such file; expected a take" in capsys.readouterr().err
