"""The sources that a session's `live` keys ask for."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import assert_never

from fusecap.body.landmarks import landmark_set_named
from fusecap.live.devices.cameras import CameraSource
from fusecap.live.devices.genicam import open_genicam
from fusecap.live.devices.grabbers import Grabber, OpenCvGrabber, open_url, open_v4l2
from fusecap.live.devices.imus_lsl import LslImus
from fusecap.live.devices.imus_udp import UdpImus
from fusecap.live.devices.openpose_folder import OpenPoseSource
from fusecap.live.devices.sensor_feed import SensorFeed
from fusecap.live.devices.source import SessionClock, Source
from fusecap.sources.imu_streams.mvn import mvn_packet, mvn_sensor_name
from fusecap.sources.imu_streams.osc import osc_packet
from fusecap.sources.imu_streams.sample import Packet
from fusecap.sources.live_address import (
    GenICam,
    KeypointFolder,
    LslSensor,
    MvnSensor,
    OscSensor,
    V4l2,
    VideoUrl,
    Webcam,
    parse_camera_address,
    parse_imu_address,
)
from fusecap.sources.session import CameraSettings, Session
from fusecap.sources.session_data import open_rig

Feeds = dict[str, list[SensorFeed]]
"""By the name that the sender calls a sensor."""


def device_sources(session: Session, clock: SessionClock) -> list[Source]:
    """One source per live camera, and one per stream or address that sensors arrive at.

    Cameras and sensors without a `live` key have none. Nothing is opened yet. Raises `InputError`
    for cameras without a calibration and for an extra that is missing.
    """
    return [*_cameras(session, clock), *_sensors(session, clock)]


def _cameras(session: Session, clock: SessionClock) -> list[Source]:
    if not any(camera.live for camera in session.cameras):
        return []
    rig, _ = open_rig(session)
    return [
        _camera(session, camera, index, rig.cameras[index].size_px, clock)
        for index, camera in enumerate(session.cameras)
        if camera.live is not None
    ]


def _camera(
    session: Session,
    camera: CameraSettings,
    index: int,
    size_px: tuple[int, int],
    clock: SessionClock,
) -> Source:
    address = parse_camera_address(camera.live or "")
    open_grabber: Callable[[], Grabber]
    match address:
        case KeypointFolder():
            return OpenPoseSource(
                name=camera.name,
                camera=index,
                folder=session.folder / address.folder,
                landmarks=landmark_set_named(camera.landmark_set_name),
                rate_hz=session.camera_rate_hz(camera),
                clock=clock,
                offset_s=camera.offset_s,
            )
        case V4l2():
            open_grabber = partial(open_v4l2, address, clock)
        case VideoUrl():
            open_grabber = partial(open_url, address, clock)
        case Webcam():
            open_grabber = partial(OpenCvGrabber, address, clock)
        case GenICam():
            open_grabber = open_genicam(address, clock)
        case _:
            assert_never(address)
    return CameraSource(
        name=camera.name,
        camera=index,
        size_px=size_px,
        open_grabber=open_grabber,
        clock=clock,
        offset_s=camera.offset_s,
    )


def _sensors(session: Session, clock: SessionClock) -> list[Source]:
    streams: dict[str, Feeds] = {}
    listeners: dict[tuple[str, str, int], Feeds] = {}
    for subject in session.subjects:
        for imu in subject.imus:
            if imu.live is None:
                continue
            address = parse_imu_address(imu.live)
            match address:
                case LslSensor():
                    feeds, name = streams.setdefault(address.stream, {}), address.sensor
                case OscSensor():
                    key = ("osc", address.host, address.port)
                    feeds, name = listeners.setdefault(key, {}), address.sensor
                case MvnSensor():
                    key = ("mvn", address.host, address.port)
                    feeds = listeners.setdefault(key, {})
                    name = mvn_sensor_name(address.segment, address.character, address.kind)
                case _:
                    assert_never(address)
            feed = SensorFeed(subject=subject.name, bone=imu.bone, offset_s=imu.offset_s)
            feeds.setdefault(name, []).append(feed)
    return [
        *(LslImus(stream=name, sensors=feeds, clock=clock) for name, feeds in streams.items()),
        *(_udp(*key, feeds, clock) for key, feeds in listeners.items()),
    ]


def _udp(protocol: str, host: str, port: int, feeds: Feeds, clock: SessionClock) -> UdpImus:
    parsers: dict[str, Callable[[bytes], Packet]] = {"osc": osc_packet, "mvn": mvn_packet}
    shown = f"[{host}]" if ":" in host else host
    return UdpImus(
        name=f"imus {protocol}://{shown}:{port}",
        host=host,
        port=port,
        parse=parsers[protocol],
        sensors=feeds,
        clock=clock,
    )
