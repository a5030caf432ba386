import http.server
import json
import os
import socket
import subprocess
import sys
import threading
import time
import types
from contextlib import contextmanager
from fractions import Fraction
from importlib.util import find_spec

import av
import cv2
import numpy as np
import pytest

from fusecap.body.landmarks import landmark_set_named
from fusecap.errors import InputError
from fusecap.live.devices import grabbers
from fusecap.live.devices.cameras import UNSTAMPED_DELAY_S, CameraSource
from fusecap.live.devices.genicam import GenICamGrabber
from fusecap.live.devices.grabbers import OpenCvGrabber, Picture, open_url, open_v4l2
from fusecap.live.devices.imus_lsl import LslImus
from fusecap.live.devices.imus_udp import UdpImus
from fusecap.live.devices.open_devices import device_sources
from fusecap.live.devices.openpose_folder import OpenPoseSource
from fusecap.live.devices.sensor_feed import SensorFeed
from fusecap.live.devices.source import SessionClock, SourceLost
from fusecap.sources.imu_streams.mvn import mvn_packet, mvn_sensor_name
from fusecap.sources.imu_streams.osc import osc_packet
from fusecap.sources.live_address import Capture, GenICam, V4l2, VideoUrl, Webcam
from fusecap.sources.session_file import load_session
from fusecap.types import CameraImage, CameraSample, ImuSample
from imu_packets import mvn_segments, mvn_trackers, osc_bundle, osc_message
from session_files import edit, write_session

SIZE_PX = (160, 120)
PATIENCE_S = 20.0


def wait_for(condition):
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "did not come about"
        time.sleep(0.005)


class Running:
    """A source in its thread; what it delivered, and why it ended."""

    def __init__(self, source):
        self.source = source
        self.items = []
        self.lost = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        try:
            self.source.run(self.items.append, self._stopping)
        except SourceLost as error:
            self.lost = str(error)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *exception):
        self._stopping.set()
        self.ended()

    def ended(self):
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        return self.lost


def feed(bone="hips", **more):
    return SensorFeed(subject="A", bone=bone, **more)


def listener(parse, sensors, host="127.0.0.1", port=0, clock=None):
    return UdpImus(
        name="imus test",
        host=host,
        port=port,
        parse=parse,
        sensors=sensors,
        clock=clock or SessionClock(),
    )


@contextmanager
def listening(source):
    """A running source and what sends to it."""
    with Running(source) as running, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        wait_for(lambda: source.address is not None or running.lost)
        yield running, lambda data: sender.sendto(data, source.address)


def test_one_socket_serves_many_osc_sensors_and_counts_what_it_refuses():
    source = listener(osc_packet, {"arm": [feed("left_forearm")], "leg": [feed("left_shank")]})
    with listening(source) as (running, send):
        for k in range(20):
            both = [osc_message("arm", 0.01 * k), osc_message("leg", 0.01 * k)]
            send(osc_bundle(both).dgram)
        send(osc_message("arm", 0.19).dgram)
        send(osc_message("tail", 0.2).dgram)
        send(b"nonsense")
        send(bytes(9500))
        wait_for(lambda: source.counts.oversize == 1)
    counts = source.counts
    assert running.lost is None
    assert (counts.received, counts.dropped, counts.malformed) == (40, 2, 1)
    assert "over 9000 bytes" in counts.note
    assert all(isinstance(item, ImuSample) for item in running.items)
    for bone in ("left_forearm", "left_shank"):
        times_ns = [item.timestamp_ns for item in running.items if item.bone == bone]
        assert len(times_ns) == 20 and (np.diff(times_ns) > 0).all()


def test_unknown_sensor_is_named_while_nothing_else_comes():
    source = listener(mvn_packet, {mvn_sensor_name("Pelvis", 0, "sensor"): [feed()]})
    with listening(source) as (_, send):
        send(mvn_segments({1: (1, 0, 0, 0)}))
        wait_for(lambda: source.counts.dropped == 1)
    assert "'Pelvis?character=0&data=segment'" in source.counts.note


def test_mvn_trackers_of_two_characters_reach_their_own_subjects():
    names = [mvn_sensor_name("Pelvis", character, "sensor") for character in (0, 1)]
    source = listener(mvn_packet, dict(zip(names, ([feed("hips")], [feed("head")]), strict=True)))
    with listening(source) as (running, send):
        for character in (1, 0, 1):
            send(mvn_trackers({1: (1, 0, 0, 0)}, character=character, time_ms=5 + character))
        wait_for(lambda: source.counts.received + source.counts.dropped == 3)
    assert [item.bone for item in running.items] == ["head", "hips"]


def test_mvn_time_code_that_stands_still_gives_way_to_the_arrival():
    sensor = feed()
    for counter in range(5):
        (sample,) = mvn_packet(mvn_trackers({1: (1, 0, 0, 0)}, counter=counter, time_ms=0)).samples
        taken = sensor.take(sample, 10**9 + counter * 16_000_000)
        assert taken is not None and taken.timestamp_ns == 10**9 + counter * 16_000_000
    assert sensor.take(sample, 2 * 10**9) is None


def test_offset_is_added_to_a_sensors_times():
    (sample,) = osc_packet(osc_message(seconds=None).dgram).samples
    taken = feed(offset_s=-0.5).take(sample, 10**9)
    assert taken is not None and taken.timestamp_ns == 500_000_000


def test_port_that_is_taken_is_a_lost_source_and_says_so():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        source = listener(osc_packet, {}, port=other.getsockname()[1])
        with Running(source) as running:
            assert "cannot listen there" in (running.ended() or "")


def test_listening_beyond_this_machine_is_announced():
    source = listener(osc_packet, {"a": [feed()]}, host="0.0.0.0")
    with Running(source):
        wait_for(lambda: source.address is not None)
        assert source.counts.note == "open to the network on imus test"


# Cameras.


class FakeGrabber:
    def __init__(self, pictures):
        self._pictures = list(pictures)
        self.closed = False

    def next(self):
        return self._pictures.pop(0) if self._pictures else None

    def take_broken(self):
        return 0

    def close(self):
        self.closed = True


def picture(clock, size_px=SIZE_PX, **more):
    image = np.zeros((size_px[1], size_px[0], 3), dtype=np.uint8)
    return Picture(image=image, arrival_ns=clock.now_ns(), **more)


def camera(open_grabber, clock, **more):
    return CameraSource(
        name="left", camera=3, size_px=SIZE_PX, open_grabber=open_grabber, clock=clock, **more
    )


def test_camera_gives_exposure_times_of_the_driver_where_there_are_some():
    clock = SessionClock()
    stamp_ns = clock.now_ns() - 7_000_000
    grabber = FakeGrabber([picture(clock, stamp_ns=stamp_ns, synchronised=True)])
    with Running(camera(lambda: grabber, clock, offset_s=0.001)) as running:
        wait_for(lambda: running.items)
    (item,) = running.items
    assert isinstance(item, CameraImage) and item.camera == 3
    assert item.timestamp_ns == stamp_ns + 1_000_000 and grabber.closed


def test_camera_without_stamps_takes_the_arrival_less_a_stated_delay():
    clock = SessionClock()
    came = picture(clock)
    with Running(camera(lambda: FakeGrabber([came]), clock)) as running:
        wait_for(lambda: running.items)
    assert running.items[0].timestamp_ns == came.arrival_ns - round(UNSTAMPED_DELAY_S * 1e9)


def test_pictures_of_another_size_end_the_source_once_and_are_never_delivered():
    clock = SessionClock()
    source = camera(lambda: FakeGrabber([picture(clock, (64, 48))] * 3), clock)
    with Running(source) as running:
        assert "64 x 48, its calibration is for 160 x 120" in (running.ended() or "")
    with Running(source) as again:
        wait_for(lambda: source.counts.malformed == 4)
        assert again.lost is None
    assert not running.items and not again.items


def test_camera_that_falls_silent_is_lost():
    clock = SessionClock()
    now = clock.now_ns
    clock.now_ns = lambda: now() + jump[0]  # type: ignore[method-assign]
    jump = [0]
    with Running(camera(lambda: FakeGrabber([]), clock)) as running:
        jump[0] = 3 * 10**9
        assert "no picture for 2 s" in (running.ended() or "")


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Sender:
    """A camera that sends MPEG-TS over UDP at 30 Hz until it is stopped."""

    def __init__(self, url):
        self._url = url
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        with av.open(self._url, "w", format="mpegts") as container:
            stream = container.add_stream("mpeg2video", rate=30)
            stream.width, stream.height, stream.pix_fmt = *SIZE_PX, "yuv420p"
            stream.gop_size, stream.max_b_frames = 5, 0
            number = 0
            while not self._stopping.wait(1 / 30):
                grey = np.full((SIZE_PX[1], SIZE_PX[0], 3), 100 + number % 50, dtype=np.uint8)
                frame = av.VideoFrame.from_ndarray(grey, format="bgr24")
                frame.pts = number
                number += 1
                container.mux(stream.encode(frame))

    def __enter__(self):
        self._thread.start()

    def __exit__(self, *exception):
        self._stopping.set()
        self._thread.join(PATIENCE_S)


@pytest.mark.slow
def test_network_camera_is_read_lost_when_it_dies_and_read_again():
    clock = SessionClock()
    url = f"udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    source = camera(lambda: open_url(VideoUrl(url=url), clock), clock)
    with Running(source) as running:
        with Sender(url):
            wait_for(lambda: len(running.items) > 10)
            stopped = time.monotonic()
        assert "does not answer" in (running.ended() or "")
        assert time.monotonic() - stopped < PATIENCE_S
    times_ns = [item.timestamp_ns for item in running.items]
    assert np.median(np.diff(times_ns)) == pytest.approx(1e9 / 30, rel=0.02)
    with Running(source) as again, Sender(url):
        wait_for(lambda: len(again.items) > 3)
    assert running.items[0].image.shape == (SIZE_PX[1], SIZE_PX[0], 3)


class MjpegHandler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        image = np.full((SIZE_PX[1], SIZE_PX[0], 3), 90, dtype=np.uint8)
        whole = cv2.imencode(".jpg", image)[1].tobytes()
        try:
            for number in range(10_000):
                data = whole[:60] if number == 20 else whole
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")
                time.sleep(0.01)
        except OSError:
            self.close_connection = True

    def log_message(self, *arguments):
        pass


def test_mjpeg_over_http_has_no_stamps_of_its_own_and_outlives_a_broken_picture():
    clock = SessionClock()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), MjpegHandler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        address = VideoUrl(url=f"http://127.0.0.1:{server.server_address[1]}/video")
        source = camera(lambda: open_url(address, clock), clock)
        with Running(source) as running:
            wait_for(lambda: len(running.items) > 40)
            newest_ns = running.items[-1].timestamp_ns
            assert clock.now_ns() - newest_ns < 5 * 10**9
        assert source.counts.malformed >= 1
    finally:
        server.shutdown()
        server.server_close()
        thread.join(PATIENCE_S)


def test_camera_that_is_not_there_is_lost_without_its_password():
    url = f"rtsp://me:secret@127.0.0.1:{free_port(socket.SOCK_STREAM)}/s"
    with pytest.raises(SourceLost, match="cannot be opened") as caught:
        open_url(VideoUrl(url=url), SessionClock())
    assert "secret" not in str(caught.value)


def test_url_from_a_stranger_reaches_no_file():
    options = grabbers.url_options("http://127.0.0.1/list.m3u8")
    allowed = options["protocol_whitelist"].split(",")
    assert not {"file", "concat", "subfile", "pipe", "fd", "data"} & set(allowed)


class FakeContainer:
    """A v4l2 device with two pictures, one not there yet, one broken."""

    def __init__(self, stamps_us):
        self.format = types.SimpleNamespace(name="video4linux2,v4l2")
        self.stream = types.SimpleNamespace(thread_type="")
        self.streams = types.SimpleNamespace(video=[self.stream])
        self._steps = list(stamps_us)
        self.closed = False

    def demux(self, stream):
        while self._steps:
            stamp_us = self._steps.pop(0)
            if stamp_us is None:
                raise av.error.BlockingIOError(11, "not yet")
            yield types.SimpleNamespace(size=9, decode=lambda us=stamp_us: self._decoded(us))
        raise av.error.OSError(19, "No such device")

    def _decoded(self, stamp_us):
        if stamp_us < 0:
            raise av.error.InvalidDataError(1, "broken")
        frame = av.VideoFrame.from_ndarray(np.zeros((120, 160, 3), np.uint8), format="bgr24")
        frame.pts = stamp_us
        frame.time_base = Fraction(1, 1_000_000)
        return [frame]

    def close(self):
        self.closed = True


def test_v4l2_takes_the_drivers_monotonic_stamps_and_survives_empty_and_broken_reads(monkeypatch):
    clock = SessionClock()
    now_us = time.monotonic_ns() // 1000
    container = FakeContainer([now_us - 9_000, None, -1, now_us - 1_000])
    asked = {}

    def fake_open(url, **more):
        asked.update(more, url=url)
        return container

    monkeypatch.setattr(av, "open", fake_open)
    capture = Capture(size_px=(1280, 720), rate_hz=30.0, format="mjpeg")
    source = camera(lambda: open_v4l2(V4l2(device="/dev/video0", capture=capture), clock), clock)
    with Running(source) as running:
        assert "No such device" in (running.ended() or "")
    assert [item.timestamp_ns for item in running.items] == [
        clock.from_monotonic_ns((now_us - ago) * 1000) for ago in (9_000, 1_000)
    ]
    assert source.counts.malformed == 1 and container.closed
    assert asked["url"] == "/dev/video0" and asked["format"] == "v4l2"
    assert asked["options"] == {
        "timestamps": "default",
        "fflags": "nonblock",
        "video_size": "1280x720",
        "framerate": "30",
        "input_format": "mjpeg",
    }


class FakeCapture:
    def __init__(self, index, backend):
        self.asked = {}
        self.left = 2

    def isOpened(self):
        return True

    def set(self, key, value):
        self.asked[key] = value

    def get(self, key):
        return time.monotonic() * 1e3 - 8.0

    def grab(self):
        self.left -= 1
        return self.left >= 0

    def retrieve(self):
        return True, np.zeros((120, 160, 3), np.uint8)

    def release(self):
        pass


def test_webcam_is_asked_for_size_and_rate_and_lost_when_it_gives_nothing(monkeypatch):
    opened = []

    def fake(index, backend):
        opened.append(FakeCapture(index, backend))
        return opened[-1]

    monkeypatch.setattr(cv2, "VideoCapture", fake)
    monkeypatch.setattr(grabbers.sys, "platform", "linux")
    clock = SessionClock()
    address = Webcam(index=1, capture=Capture(size_px=(160, 120), rate_hz=25.0, format="mjpeg"))
    with Running(camera(lambda: OpenCvGrabber(address, clock), clock)) as running:
        assert "gives no picture" in (running.ended() or "")
    assert len(running.items) == 2
    asked = opened[0].asked
    assert asked[cv2.CAP_PROP_FRAME_WIDTH] == 160 and asked[cv2.CAP_PROP_FPS] == 25.0
    assert asked[cv2.CAP_PROP_FOURCC] == cv2.VideoWriter.fourcc(*"MJPG")


def test_genicam_pictures_come_in_bgr_with_the_cameras_stamps(monkeypatch):
    """Against a stand-in for harvesters: no such camera has been at hand."""
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    red = np.zeros((4, 6, 3), np.uint8)
    red[:, :, 0] = 200
    part = types.SimpleNamespace(data=red.ravel(), width=6, height=4, data_format="RGB8")

    class Buffer:
        timestamp_ns = 123
        payload = types.SimpleNamespace(components=[part])

        def __enter__(self):
            return self

        def __exit__(self, *exception):
            pass

    class Acquirer:
        remote_device = types.SimpleNamespace(node_map=types.SimpleNamespace())

        def start(self):
            pass

        def try_fetch(self, timeout):
            return Buffer()

        def destroy(self):
            pass

    class Harvester:
        def update(self):
            pass

        def create(self, key):
            if key != {"serial_number": "1"}:
                raise ValueError("no device")
            return Acquirer()

    core = types.ModuleType("core")
    monkeypatch.setattr(core, "Harvester", Harvester, raising=False)
    grabber = GenICamGrabber(GenICam(serial="1"), SessionClock(), core)
    taken = grabber.next()
    assert taken is not None and taken.stamp_ns == 123 and not taken.synchronised
    assert (taken.image == [0, 0, 200]).all()
    part.data_format = "Mono12p"
    assert grabber.next() is None and grabber.take_broken() == 1
    with pytest.raises(SourceLost, match="no device"):
        GenICamGrabber(GenICam(serial="2"), SessionClock(), core)


# Keypoints and streams.


def test_openpose_folder_gives_new_frames_at_their_cameras_pace(tmp_path):
    coco = landmark_set_named("coco17")
    body = np.column_stack([np.full(17, 100.0), np.arange(17) + 1.0, np.full(17, 0.9)])
    text = json.dumps({"people": [{"pose_keypoints_2d": body.ravel().tolist()}]})

    def put(number):
        part = tmp_path / "part"
        part.write_text(text)
        os.replace(part, tmp_path / f"cam_{number:012d}_keypoints.json")

    put(0)
    clock = SessionClock()
    source = OpenPoseSource(
        name="left", camera=1, folder=tmp_path, landmarks=coco, rate_hz=100.0, clock=clock
    )
    with Running(source) as running:
        # The frame that was there is past: until the folder has been seen once, nothing is new.
        time.sleep(0.1)
        for number in range(1, 30):
            put(number)
            time.sleep(0.01)
        wait_for(lambda: source.counts.received + source.counts.dropped == 29)
    assert all(isinstance(item, CameraSample) and item.camera == 1 for item in running.items)
    steps_ms = 1e-6 * np.diff([item.timestamp_ns for item in running.items])
    assert np.median(steps_ms) == pytest.approx(10.0, abs=0.01)


def test_openpose_folder_of_another_format_is_lost_and_says_so(tmp_path):
    source = OpenPoseSource(
        name="left",
        camera=0,
        folder=tmp_path,
        landmarks=landmark_set_named("coco17"),
        rate_hz=30.0,
        clock=SessionClock(),
    )
    with Running(source) as running:
        time.sleep(0.1)
        path = tmp_path / "a_000000000005_keypoints.json"
        path.write_text(json.dumps({"people": [{"pose_keypoints_2d": [1.0, 2.0, 0.5] * 25}]}))
        assert "25 keypoints, expected the 17" in (running.ended() or "")


LSL_PROGRAM = """
import sys
sys.path[:0] = {paths}
import math, pylsl, test_live_devices as t
name = "fusecap test {pid}"
info = pylsl.StreamInfo(name, "IMU", 14, 100, pylsl.cf_float32, name)
channels = info.desc().append_child("channels")
for sensor in ("arm", "leg"):
    for end in ("qw", "qx", "qy", "qz", "ax", "ay", "az"):
        channels.append_child("channel").append_child_value("label", sensor + "_" + end)
clock = t.SessionClock()
sensors = dict(arm=[t.feed("left_forearm")], leg=[t.feed("hips")])
source = t.LslImus(stream=name, sensors=sensors, clock=clock)
with t.Running(source) as running:
    print("no stream of this name" in running.ended())
outlet = pylsl.StreamOutlet(info)
good = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
with t.Running(source) as running:
    while len(running.items) < 40 and not running.lost:
        outlet.push_sample(good + good)
        t.time.sleep(0.01)
    if running.lost:
        sys.exit("no stream resolved")
    outlet.push_sample([math.nan] * 7 + good)
    t.wait_for(lambda: source.counts.malformed == 1)
    now_ns = clock.now_ns()
    del outlet
    print("its sender is gone" in running.ended())
for bone in ("hips", "left_forearm"):
    times_ns = [item.timestamp_ns for item in running.items if item.bone == bone]
    print(all(0 < now_ns - at_ns < 20e9 for at_ns in times_ns), times_ns == sorted(set(times_ns)))
"""


@pytest.mark.slow
@pytest.mark.skipif(find_spec("pylsl") is None, reason="the extra 'lsl' is not installed")
def test_lsl_stream_is_read_by_its_labels_and_lost_when_it_ends(tmp_path):
    """In a process of its own: the library reads its settings once, when it is loaded."""
    settings = tmp_path / "lsl_api.cfg"
    settings.write_text("[multicast]\nResolveScope = machine\n[log]\nlevel = -2\n")
    program = LSL_PROGRAM.format(paths=[p for p in sys.path if p], pid=os.getpid())
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
    assert result.stdout.split() == ["True"] * 6, result.stderr


def test_lsl_without_its_library_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pylsl", None)
    with pytest.raises(InputError, match=r"extra 'lsl'.*pip install 'pylsl>="):
        LslImus(stream="a", sensors={}, clock=SessionClock())


# From the session to its sources.


def test_sources_of_a_session_are_grouped_by_camera_stream_and_address(tmp_path):
    file = write_session(tmp_path)
    edit(file, 'keypoints = "keypoints/cam0"', 'live = "udp://127.0.0.1:5000"')
    edit(file, 'keypoints = "keypoints/cam2"', 'live = "openpose:live/cam2"')
    text = file.read_text() + '\n[[subject]]\nname = "A"\n'
    for bone, live in (
        ("left_forearm", "osc://:9000/arm"),
        ("left_shank", "osc://127.0.0.1:9000/leg"),
        ("right_shank", "osc://127.0.0.1:9001/leg"),
        ("head", "mvn:///Head"),
        ("right_forearm", "lsl:imus/arm"),
        ("left_thigh", "lsl:imus/leg"),
    ):
        text += f'\n[[subject.imu]]\nbone = "{bone}"\nlive = "{live}"\n'
    file.write_text(text)
    names = [source.name for source in device_sources(load_session(file), SessionClock())]
    assert names == [
        "camera 'cam0'",
        "camera 'cam2'",
        "imus osc://127.0.0.1:9000",
        "imus osc://127.0.0.1:9001",
        "imus mvn://127.0.0.1:9763",
        "imus lsl:imus",
    ]


def test_session_without_live_keys_has_no_sources(tmp_path):
    assert device_sources(load_session(write_session(tmp_path)), SessionClock()) == []


def test_missing_harvesters_is_named_before_anything_starts(tmp_path, monkeypatch):
    file = write_session(tmp_path)
    edit(file, 'keypoints = "keypoints/cam0"', 'live = "genicam:1"')
    monkeypatch.setitem(sys.modules, "harvesters.core", None)
    with pytest.raises(InputError, match="pip install 'harvesters>="):
        device_sources(load_session(file), SessionClock())
    monkeypatch.setitem(sys.modules, "harvesters.core", types.ModuleType("core"))
    (source,) = device_sources(load_session(file), SessionClock())
    assert source.name == "camera 'cam0'"
