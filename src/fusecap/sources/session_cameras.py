"""A session's cameras: their calibration, and keypoints on the cameras' own clocks."""

from __future__ import annotations

from contextlib import suppress

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.errors import InputError, SessionError
from fusecap.findings import Finding
from fusecap.geometry.camera import Rig
from fusecap.progress import Progress
from fusecap.sources.calibration_files import check_rig, load_rig
from fusecap.sources.detection_files import read_record
from fusecap.sources.keypoint_files import KeypointTrack, read_keypoints, sets_in
from fusecap.sources.offset_files import read_offsets
from fusecap.sources.session import CameraSettings, Session
from fusecap.sources.video import check_video, probe


def with_detections(session: Session) -> Session:
    """The session with what its files say and it does not.

    A camera that names a video only gets the folder of what `fusecap detect` found in it, where
    that is complete and the video still has the name and size that it was made from. Keypoints
    without a stated format get the one that their number tells, those beside a video its rate. A
    session that does not state its rate takes that of the first camera that has one.
    """
    cameras = tuple(_as_its_files_say(session, camera) for camera in session.cameras)
    settings = session.settings
    if not rate_is_stated(session):
        records = [read_record(c.keypoints) for c in cameras if c.keypoints and not c.rate_hz]
        rates_hz = [record.video.rate_hz for record in records if record is not None]
        rates_hz += [camera.rate_hz for camera in cameras if camera.rate_hz]
        if rates_hz:
            settings = settings.model_copy(update={"rate_hz": rates_hz[0]})
    return session.model_copy(update={"cameras": cameras, "settings": settings})


def rate_is_stated(session: Session) -> bool:
    """Whether anything says how often the session is solved; else it is the default."""
    return "rate_hz" in session.settings.model_fields_set


def _as_its_files_say(session: Session, camera: CameraSettings) -> CameraSettings:
    if camera.keypoints is None:
        return _with_folder(session, camera)
    if not camera.keypoints.exists() or read_record(camera.keypoints) is not None:
        return camera
    told: dict[str, object] = {}
    if "format" not in camera.model_fields_set:
        with suppress(InputError):
            alike = [landmarks.name for landmarks in sets_in(camera.keypoints)]
            if alike and camera.landmark_set_name not in alike:
                told["format"] = f"openpose-{alike[0]}"
    if camera.video is not None and camera.rate_hz is None and not rate_is_stated(session):
        with suppress(InputError):
            told["rate_hz"] = probe(camera.video).rate_hz
    return camera.model_copy(update=told)


def _with_folder(session: Session, camera: CameraSettings) -> CameraSettings:
    if camera.video is None:
        return camera
    folder = session.detection_folder(camera)
    record = read_record(folder)
    if record is None or not record.complete or not record.video.is_likely(camera.video):
        return camera
    return camera.model_copy(update={"keypoints": folder})


def open_rig(session: Session) -> tuple[Rig, list[Finding]]:
    """The session's cameras in its order, and what is odd about them.

    Raises `SessionError` for cameras without a calibration.
    """
    if not session.cameras:
        return Rig(cameras=()), []
    if session.settings.calibration is None:
        raise SessionError(
            f"{session.path}: [session] calibration is missing; cameras need a calibration file, "
            "as fusecap calibrate extrinsics writes it"
        )
    names = [camera.name for camera in session.cameras]
    rig = load_rig(
        session.settings.calibration,
        up=session.settings.up,
        unit=session.settings.calibration_unit,
        names=names,
    ).subset(names)
    return rig, check_rig(rig, floor=session.settings.floor)


def common_landmarks(session: Session) -> LandmarkSet | None:
    """The one landmark set of all cameras, with the session's offsets; None without cameras.

    Of a video that was not looked at yet it is the others'. Raises `SessionError` when cameras
    differ, `InputError` for offsets that cannot be used.
    """
    seen = [camera for camera in session.cameras if not _is_undetected(camera)]
    names = {c.name: _landmark_set_name(session, c) for c in seen or session.cameras}
    if len(set(names.values())) > 1:
        listed = ", ".join(f"'{camera}' openpose-{name}" for camera, name in names.items())
        raise SessionError(
            f"{session.path}: cameras with different keypoint formats ({listed}); "
            "expected one format for all: run the same detector on every camera"
        )
    if not names:
        return None
    landmarks = landmark_set_named(next(iter(names.values())))
    if session.settings.landmark_offsets is None:
        return landmarks
    return landmarks.calibrated(read_offsets(session.settings.landmark_offsets, landmarks.name))


def refuse_other_landmarks(session: Session, found: str) -> None:
    """Where a detector finds the set `found` in videos, and other cameras have others' keypoints.

    What was detected in a video is no matter: it is detected again. Raises `SessionError`.
    """
    session = with_detections(session)
    others = {
        camera.name: _landmark_set_name(session, camera)
        for camera in session.cameras
        if camera.keypoints is not None
        and (camera.video is None or camera.keypoints != session.detection_folder(camera))
    }
    listed = ", ".join(f"'{camera}' {name}" for camera, name in others.items() if name != found)
    if listed:
        raise SessionError(
            f"{session.path}: the detector finds {found}, but cameras have other keypoints "
            f"({listed}); set model under [detector] to a network of theirs, or leave their "
            "keypoints out and name their videos"
        )


def _is_undetected(camera: CameraSettings) -> bool:
    return camera.keypoints is None and camera.video is not None


def _landmark_set_name(session: Session, camera: CameraSettings) -> str:
    """The set that a detection left in the camera's folder, else that of its format."""
    record = read_record(camera.keypoints) if camera.keypoints else None
    if record is None:
        return camera.landmark_set_name
    if "format" in camera.model_fields_set and record.landmark_set != camera.landmark_set_name:
        raise SessionError(
            f"{session.path}: camera '{camera.name}' states format = \"{camera.format}\", but "
            f"{camera.keypoints} holds openpose-{record.landmark_set}; leave format out"
        )
    return record.landmark_set


def open_keypoints(session: Session, progress: Progress | None = None) -> tuple[KeypointTrack, ...]:
    """Of all cameras, on their own clocks; raises `InputError`."""
    landmarks = common_landmarks(session)
    return tuple(camera_track(session, camera, landmarks, progress) for camera in session.cameras)


def camera_track(
    session: Session,
    camera: CameraSettings,
    landmarks: LandmarkSet | None,
    progress: Progress | None = None,
) -> KeypointTrack:
    """Of one camera, on its own clock; raises `InputError`."""
    if camera.keypoints is None and camera.video is None:
        raise SessionError(
            f"{session.path}: camera '{camera.name}' is live only, nothing is recorded here; solve "
            "a recording of fusecap live (.mcap), or name keypoints or a video"
        )
    if camera.keypoints is None or landmarks is None:
        raise SessionError(
            f"{session.path}: camera '{camera.name}' has a video but no keypoints yet; run: "
            f"fusecap detect {session.folder}"
        )
    return read_keypoints(
        camera.keypoints,
        name=camera.name,
        landmarks=landmarks,
        rate_hz=session.camera_rate_hz(camera),
        offset_s=camera.offset_s,
        own_times=camera.rate_hz is None,
        place=session.place_in_table(camera),
        progress=progress,
    )


def unreadable_videos(session: Session) -> list[Finding]:
    """Of cameras whose keypoints are there: nothing that is solved needs their videos."""
    findings = []
    for camera in session.cameras:
        if camera.keypoints is None or camera.video is None or not camera.video.is_file():
            continue
        try:
            check_video(camera.video)
        except InputError as error:
            findings.append(
                Finding(
                    severity="warning",
                    where=f"camera '{camera.name}'",
                    found=str(error),
                    remedy="its keypoints are used; overlays and the viewer's pictures need it",
                )
            )
    return findings


def broken_files(track: KeypointTrack) -> Finding:
    """The finding for unreadable keypoint files."""
    share = len(track.broken) / len(track.frames)
    return Finding(
        severity="warning",
        where=f"camera '{track.name}'",
        found=f"{len(track.broken)} of {len(track.frames)} keypoint files ({share:.1%}) are "
        f"truncated or garbled (first: {track.broken[0]})",
        remedy="they count as frames without people; run the detector again on these frames",
    )


def stepped_frames(track: KeypointTrack) -> Finding:
    """The finding for a detector that looked at every so many frames only."""
    return Finding(
        severity="warning",
        where=f"camera '{track.name}'",
        found=f"only every {track.step}. frame has keypoints: taken as {track.rate_hz:g} Hz",
        remedy="detect every frame for fast motion; where the camera recorded at this rate, number "
        "its frames 0, 1, 2 and state rate_hz",
    )
