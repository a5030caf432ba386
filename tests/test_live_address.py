from pathlib import Path

import pytest

from fusecap.errors import InputError, SessionError
from fusecap.sources.imu_streams.mvn import SEGMENTS
from fusecap.sources.live_address import (
    Capture,
    GenICam,
    KeypointFolder,
    V4l2,
    VideoUrl,
    Webcam,
    parse_camera_address,
    parse_imu_address,
)
from fusecap.sources.live_sensor import SensorAddress
from fusecap.sources.session_file import parse_session

HD = Capture(size_px=(1280, 720), rate_hz=30.0, format="mjpeg")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("webcam:0", Webcam(index=0)),
        ("webcam:2?size=1280x720&rate=30&format=mjpeg", Webcam(index=2, capture=HD)),
        ("v4l2:/dev/video0", V4l2(device="/dev/video0")),
        (
            "v4l2:/dev/v4l/by-id/usb-0?rate=29.97",
            V4l2(device="/dev/v4l/by-id/usb-0", capture=Capture(rate_hz=29.97)),
        ),
        ("genicam:22345678", GenICam(serial="22345678")),
        ("openpose:live/left", KeypointFolder(folder=Path("live/left"))),
        ("rtsp://me:secret@cam/s?a=b", VideoUrl(url="rtsp://me:secret@cam/s?a=b")),
        ("udp://127.0.0.1:5000", VideoUrl(url="udp://127.0.0.1:5000")),
    ],
)
def test_camera_addresses(text, expected):
    assert parse_camera_address(text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("lsl:imus", SensorAddress(protocol="lsl", stream="imus")),
        ("lsl:imus/left_shank", SensorAddress(protocol="lsl", stream="imus", sensor="left_shank")),
        (
            "osc://:9000/arm",
            SensorAddress(protocol="osc", host="127.0.0.1", port=9000, sensor="arm"),
        ),
        (
            "osc://0.0.0.0:9000/a%20b",
            SensorAddress(protocol="osc", host="0.0.0.0", port=9000, sensor="a b"),
        ),
        (
            "mvn:///Pelvis",
            SensorAddress(
                protocol="mvn",
                host="127.0.0.1",
                port=9763,
                sensor="Pelvis?character=0&data=sensor",
            ),
        ),
        (
            "mvn://192.168.1.5:9764/LeftForeArm?character=1&data=segment",
            SensorAddress(
                protocol="mvn",
                host="192.168.1.5",
                port=9764,
                sensor="LeftForeArm?character=1&data=segment",
            ),
        ),
    ],
)
def test_imu_addresses(text, expected):
    assert parse_imu_address(text) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("webcamm:0", ["'webcamm'", "did you mean 'webcam'"]),
        ("webcam:front", ["number"]),
        ("webcam:0?sise=1x1", ["'sise'", "did you mean 'size'"]),
        ("webcam:0?size=big", ["WIDTHxHEIGHT"]),
        ("webcam:0?rate=0", ["rate=0"]),
        ("webcam:0?rate", ["key=value"]),
        ("webcam:0?format=a,b", ["mjpeg"]),
        ("v4l2:/etc/passwd", ["/dev"]),
        ("v4l2:/dev/../etc/passwd", ["/dev"]),
        ("genicam:", ["serial"]),
        ("openpose:", ["folder"]),
        ("rtsp:///stream", ["host"]),
        ("rtsp://cam:port/s", ["Port"]),
        ("file:///etc/passwd", ["'file'"]),
        ("concat:a|b", ["'concat'"]),
        ("pipe:0", ["'pipe'"]),
        ("/dev/video0", ["no kind of camera"]),
    ],
)
def test_wrong_camera_address_says_why_and_what_to_write(text, expected):
    with pytest.raises(InputError) as caught:
        parse_camera_address(text)
    for part in [*expected, repr(text), 'live = "']:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("osx://h:1/a", ["'osx'", "did you mean"]),
        ("lsl:", ["name"]),
        ('lsl:a"b', ["quotes"]),
        ("osc://h/a", ["port"]),
        ("osc://h:9000", ["name"]),
        ("osc://h:99999/a", ["65535"]),
        ("osc://h:0/a", ["65535"]),
        ("osc:9000/a", ["host"]),
        ("mvn:///LeftArm", ["'LeftArm'", "did you mean 'LeftForeArm'"]),
        ("mvn:///Pelvis?data=points", ["data=points", "sensor or segment"]),
        ("mvn:///Pelvis?character=300", ["character=300"]),
    ],
)
def test_wrong_imu_address_says_why_and_what_to_write(text, expected):
    with pytest.raises(InputError) as caught:
        parse_imu_address(text)
    for part in [*expected, repr(text), 'live = "']:
        assert part in str(caught.value)


def test_session_names_the_table_of_a_wrong_address(tmp_path):
    (tmp_path / "session.toml").write_text(
        '[session]\nname = "a"\ncalibration = "c.toml"\n'
        '[[camera]]\nname = "left"\nlive = "webcam:x"\n'
        '[[subject]]\nname = "A"\n[[subject.imu]]\nbone = "left_shank"\nlive = "mvn:///Knee"\n'
    )
    with pytest.raises(SessionError) as caught:
        parse_session(tmp_path)
    camera, sensor = str(caught.value).splitlines()
    assert "[[camera]] 'left' live: found 'webcam:x'" in camera
    assert "[[subject.imu]] 'left_shank' live: found 'mvn:///Knee'" in sensor


def test_password_is_not_shown():
    address = VideoUrl(url="rtsp://me:secret@cam:554/s?token=abc")
    assert address.shown == "rtsp://cam:554/s"


def test_segment_identities_are_those_of_the_published_table():
    """MVN network streaming specification, 3.1: an ID is the index + 1."""
    assert len(SEGMENTS) == 23
    assert [SEGMENTS.index(n) for n in ("Head", "RightHand", "LeftHand", "LeftToe")] == [
        *(6, 10, 14, 22)
    ]
