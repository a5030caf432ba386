"""The sources that a session's `live` keys ask for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
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
from fusecap.sources.imu_streams import protocol_named
from fusecap.sources.live_address import (
    GenICam,
    KeypointFolder,
    V4l2,
    VideoUrl,
    Webcam,
    parse_camera_address,
    parse_imu_address,
)
from fusecap.sources.live_sensor import SensorAddress
from fusecap.sources.session import CameraSettings, Session
from fusecap.sources.session_cameras import open_rig

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
    senders: dict[SensorAddress, Feeds] = {}
    for subject in session.subjects:
        for imu in subject.imus:
            if imu.live is None:
                continue
            address = parse_imu_address(imu.live)
            feeds = senders.setdefault(replace(address, sensor=""), {})
            feed = SensorFeed(subject=subject.name, bone=imu.bone, offset_s=imu.offset_s)
            feeds.setdefault(address.sensor, []).append(feed)
    return [_listener(sender, feeds, clock) for sender, feeds in senders.items()]


def _listener(address: SensorAddress, feeds: Feeds, clock: SessionClock) -> Source:
    packet = protocol_named(address.protocol).packet
    if packet is None:
        return LslImus(stream=address.stream, sensors=feeds, clock=clock)
    return UdpImus(
        name=f"imus {address.sender}",
        host=address.host,
        port=address.port,
        parse=packet,
        sensors=feeds,
        clock=clock,
    )
