"""From a session to what a run needs: its sources and, where pictures come, a detector."""

from __future__ import annotations

import os

from fusecap.batch.detect import detector_options
from fusecap.detect.build import build_detector
from fusecap.detect.detector import Detector, DetectorOptions
from fusecap.errors import SessionError
from fusecap.live.devices.open_devices import device_sources
from fusecap.live.devices.playback_sources import PlaybackOptions, playback_sources
from fusecap.live.devices.source import SessionClock, Source
from fusecap.progress import Progress
from fusecap.setup import SessionSetup, session_setup
from fusecap.sources.live_address import KeypointFolder, parse_camera_address
from fusecap.sources.session import CameraSettings, Session


def open_setup(
    session: Session, *, playback: bool, progress: Progress | None = None
) -> tuple[SessionSetup, Detector | None]:
    """What poses depend on, and the detector where a camera brings pictures.

    One core is left to everything else. Raises `InputError`; where the session has nothing to
    open, or cameras that bring other keypoints than the detector, it says which.
    """
    options = networks_of(session, playback=playback)
    if options is None:
        return session_setup(session), None
    pictures = [camera for camera in session.cameras if _brings_pictures(camera, playback=playback)]
    threads = max(1, (os.cpu_count() or 1) - 1)
    detector = build_detector(options, progress, threads=threads, follow_others=False)
    landmarks = detector.landmarks
    for camera in session.cameras:
        if camera not in pictures and camera.landmark_set_name != landmarks.name:
            raise SessionError(
                f"{session.path}: camera '{camera.name}' brings {camera.landmark_set_name} "
                f"keypoints, the detector {landmarks.name}; let the detector see every camera, or "
                "none"
            )
    return session_setup(session, landmarks), detector


def networks_of(session: Session, *, playback: bool) -> DetectorOptions | None:
    """What the run detects with; None where no camera brings pictures."""
    pictures = (_brings_pictures(camera, playback=playback) for camera in session.cameras)
    return detector_options(session) if any(pictures) else None


def open_sources(
    session: Session,
    clock: SessionClock,
    playback: PlaybackOptions | None,
    progress: Progress | None = None,
) -> list[Source]:
    """Devices, or the recording played as if live; raises `InputError`."""
    if playback is not None:
        return playback_sources(session, clock, playback, progress)
    return device_sources(session, clock)


def check_live(session: Session) -> list[str]:
    """What the session has no device for, one line each; raises `SessionError` for nothing at all.

    A run goes on without them.
    """
    missing = [f"camera '{camera.name}'" for camera in session.cameras if camera.live is None]
    present = len(session.cameras) - len(missing)
    for subject in session.subjects:
        for imu in subject.imus:
            if imu.live is None:
                missing.append(f"imu '{imu.bone}' of '{subject.name}'")
            else:
                present += 1
    if not present:
        raise SessionError(
            f"{session.path}: no camera and no imu says where it is found live. Add keys like "
            'live = "webcam:0" to [[camera]] and live = "lsl:STREAM" to [[subject.imu]], or play '
            "what is recorded as if it were live: --playback"
        )
    return missing


def _brings_pictures(camera: CameraSettings, *, playback: bool) -> bool:
    if playback:
        return camera.keypoints is None
    return camera.live is not None and not isinstance(
        parse_camera_address(camera.live), KeypointFolder
    )
