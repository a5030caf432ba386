"""A session with its files open: everything the pipeline needs, instant by instant.

The solve runs from the first to the last instant that any camera or IMU covers, at the session's
rate, in step with the first camera's frames (or the first IMU's samples), so that cameras of the
session's rate are not interpolated at all.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median_high
from typing import TypeVar

import numpy as np

from fusecap.body.landmarks import LandmarkSet
from fusecap.errors import FusecapError, SessionError
from fusecap.findings import Finding
from fusecap.geometry.camera import Rig
from fusecap.inputs import SENSORS, SESSION, read_bytes
from fusecap.progress import Progress
from fusecap.sources.detection_files import read_record
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import CameraSettings, Session
from fusecap.sources.session_cameras import (
    broken_files,
    camera_track,
    common_landmarks,
    open_rig,
    stepped_frames,
    unreadable_videos,
    with_detections,
)
from fusecap.sources.session_sensors import (
    mount,
    open_some_imus,
    sensor_notes,
    without_unplaced_sensors,
)
from fusecap.sources.sync_files import Clock, Clocks, read_sync
from fusecap.sources.synchronizer import (
    MAX_GAP_S,
    MountedImu,
    detections_of,
    resample_imus,
    seen_at,
)
from fusecap.sources.video import Video
from fusecap.types import Detections, ImuReading

T = TypeVar("T")
Track = TypeVar("Track", KeypointTrack, ImuTrack)

MAX_INSTANTS = 2_000_000
"""9 hours at 60 Hz: beyond this, clocks do not agree."""
HASHED_BYTES = 1 << 20
"""Of a larger file only name and size enter the hash."""


BLOCK = 256
"""Instants that sensors are brought to at once: 3 MB of thirteen, where hours would be 2 GB."""


class SubjectImus:
    """The sensors of one subject, on the solve's instants."""

    def __init__(self, subject: str, imus: Sequence[MountedImu], times_s: np.ndarray) -> None:
        self.subject = subject
        self.bones = tuple(imu.bone for imu in imus)
        """Which of them carries each sensor."""
        self._imus = imus
        self._times_s = times_s
        self._block = -1
        self._rotations = np.empty((0, len(imus), 3, 3))
        self._accelerations = np.empty((0, len(imus), 3))

    def reading(self, instant: int) -> ImuReading:
        """What the sensors say at one of the solve's instants."""
        block, row = divmod(instant, BLOCK)
        if block != self._block:
            times_s = self._times_s[block * BLOCK : (block + 1) * BLOCK]
            self._rotations, self._accelerations = resample_imus(self._imus, times_s)
            self._block = block
        return ImuReading(
            bone_rotation_in_world=self._rotations[row],
            accel_in_world_m_s2=self._accelerations[row],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionData:
    """All inputs of a session; cameras in the order of its [[camera]] tables."""

    session: Session
    rig: Rig
    """Empty without cameras."""
    landmarks: LandmarkSet | None
    """What the keypoints are; None without cameras."""
    keypoints: tuple[KeypointTrack, ...]
    imus: tuple[SubjectImus, ...]
    """Subjects that carry sensors, in the order of the [[subject]] tables."""
    samples: dict[str, list[ImuTrack | None]]
    """Per subject what its sensors measured, on the session's clock."""
    times_s: np.ndarray
    """(T,) instants of the solve on the session's clock."""
    findings: tuple[Finding, ...]
    """What is odd about the inputs and was dealt with."""
    content_hash: str
    """sha256 over the session file and its inputs."""

    @property
    def timestamps_ns(self) -> np.ndarray:
        """(T,) int64."""
        return np.round(self.times_s * 1e9).astype(np.int64)

    def detections(self, instant: int) -> Detections:
        """Everyone in every camera at one instant."""
        t_s = float(self.times_s[instant])
        return detections_of(round(t_s * 1e9), [seen_at(track, t_s) for track in self.keypoints])

    def frames(self) -> Iterator[tuple[int, Detections, dict[str, ImuReading]]]:
        """Per instant its timestamp [ns], the detections, and each subject's IMU reading."""
        for instant in range(len(self.times_s)):
            detections = self.detections(instant)
            readings = {imus.subject: imus.reading(instant) for imus in self.imus}
            yield detections.timestamp_ns, detections, readings


@dataclass(frozen=True, kw_only=True)
class OpenedInputs:
    """What a session names, as far as it can be used: None stands for what cannot."""

    session: Session
    """At the rate of the solve."""
    rig: Rig | None
    landmarks: LandmarkSet | None
    clocks: Clocks
    keypoints: tuple[KeypointTrack | None, ...]
    """Per camera, on the session's clock."""
    imus: dict[str, list[ImuTrack | None]]
    """Per subject its sensors, on the session's clock."""
    times_s: np.ndarray | None
    """(T,) the instants; None unless all of the above can be used."""
    findings: list[Finding]
    """What is odd and was dealt with."""


def open_inputs(
    session: Session,
    failed: Callable[[str, FusecapError], None],
    progress: Progress | None = None,
) -> OpenedInputs:
    """Opens all inputs in the one order there is, for a solve and for doctor.

    `failed` is told where something cannot be used and why: it raises, or notes it and goes on.
    """

    def attempt(where: str, opened: Callable[[], T]) -> T | None:
        try:
            return opened()
        except FusecapError as error:
            failed(where, error)
            return None

    def on_clock(track: Track, clock: Clock) -> Track:
        return replace(track, times_s=clock.session_s(track.times_s))

    rig, findings = attempt("calibration", lambda: open_rig(session)) or (None, [])
    session, unplaced = without_unplaced_sensors(session)
    findings += unplaced
    landmarks = attempt("cameras", lambda: common_landmarks(session))
    clocks = attempt("clocks", lambda: session_clocks(session)) or Clocks()
    keypoints: list[KeypointTrack | None] = []
    for camera in session.cameras if landmarks else ():
        track = attempt(
            f"camera '{camera.name}'",
            lambda c=camera: camera_track(session, c, landmarks, progress),
        )
        if track is not None:
            if track.broken:
                findings.append(broken_files(track))
            if track.step > 1:
                findings.append(stepped_frames(track))
            track = on_clock(track, clocks.camera(track.name))
        keypoints.append(track)
    findings += unreadable_videos(session) + unplaced_wearers(session)
    imus: dict[str, list[ImuTrack | None]] = {}
    for subject in session.subjects:
        imus[subject.name] = [
            track
            and replace(track, times_s=clocks.imu(subject.name, imu.bone).session_s(track.times_s))
            for imu, track in zip(subject.imus, open_some_imus(subject, attempt), strict=True)
        ]
        findings += sensor_notes(subject, imus[subject.name])
    seen = tuple(track for track in keypoints if track is not None)
    worn = [track for some in imus.values() for track in some if track is not None]
    session = _at_sensors_rate(session, worn)
    whole = len(seen) == len(session.cameras) and len(worn) == sum(map(len, imus.values()))
    times_s = None
    if whole and (seen or worn):
        times_s = attempt(session.path.name, lambda: solve_times_s(session, seen, worn))
    return OpenedInputs(
        session=session,
        rig=rig,
        landmarks=landmarks,
        clocks=clocks,
        keypoints=tuple(keypoints),
        imus=imus,
        times_s=times_s,
        findings=findings,
    )


def open_session(session: Session, progress: Progress | None = None) -> SessionData:
    """Reads all inputs; raises `InputError` for the first that cannot be used.

    Cameras with a video need keypoints that were detected in it (`with_detections`).
    """
    session = with_detections(session)
    inputs = open_inputs(session, _refuse, progress)
    if inputs.rig is None or inputs.times_s is None:
        raise SessionError(f"{session.path}: neither a camera nor a sensor: nothing to solve")
    imus = []
    for subject in inputs.session.subjects:
        if subject.imus:
            tracks = [track for track in inputs.imus[subject.name] if track is not None]
            imus.append(SubjectImus(subject.name, mount(subject, tracks), inputs.times_s))
    return SessionData(
        session=inputs.session,
        rig=inputs.rig,
        landmarks=inputs.landmarks,
        keypoints=tuple(track for track in inputs.keypoints if track is not None),
        imus=tuple(imus),
        samples=inputs.imus,
        times_s=inputs.times_s,
        findings=tuple(inputs.findings),
        content_hash=content_hash(session),
    )


def _at_sensors_rate(session: Session, worn: Sequence[ImuTrack]) -> Session:
    """Without cameras and a stated rate, people are solved as often as sensors measure."""
    rates_hz = [track.rate_hz for track in worn if np.isfinite(track.rate_hz)]
    if session.cameras or "rate_hz" in session.settings.model_fields_set or not rates_hz:
        return session
    settings = session.settings.model_copy(update={"rate_hz": median_high(rates_hz)})
    return session.model_copy(update={"settings": settings})


def _refuse(where: str, error: FusecapError) -> None:
    raise error


TELLING_SENSORS = 3
"""So many tell whose they are, by how limbs point."""


def unplaced_wearers(session: Session) -> list[Finding]:
    """People who wear sensors but could be anyone the cameras find first."""
    if not session.cameras or len(session.subjects) < 2:
        return []
    names = [
        s.name for s in session.subjects if 0 < len(s.imus) < TELLING_SENSORS and s.start_m is None
    ]
    if not names:
        return []
    return [
        Finding(
            severity="warning",
            where="subjects",
            found=f"{', '.join(names)}: fewer than {TELLING_SENSORS} sensors, which do not tell "
            "who wears them, and no start position",
            remedy="add start_m = [x, z], or sensors may be taken for another person's",
        )
    ]


def session_clocks(session: Session) -> Clocks:
    """Those of the session's `sync` file; of one without, everybody's times are right."""
    return Clocks() if session.settings.sync is None else read_sync(session.settings.sync)


def video_times_s(session: Session, camera: CameraSettings, video: Video) -> np.ndarray:
    """(F,) when the frames of a camera's video were exposed, on the session's clock.

    A constant rate is taken as such, without the container's rounding, and the rate of keypoints
    that number the frames is that of the frames.
    """
    rate_hz = camera.rate_hz
    if rate_hz is None and camera.keypoints is not None and read_record(camera.keypoints) is None:
        rate_hz = session.camera_rate_hz(camera)
    if rate_hz is None and video.info.is_variable_rate:
        own_s = video.times_ns * 1e-9
    else:
        own_s = np.arange(video.info.frames) / (rate_hz or video.info.rate_hz)
    return session_clocks(session).camera(camera.name).session_s(own_s + camera.offset_s)


def solve_times_s(
    session: Session, keypoints: tuple[KeypointTrack, ...], imus: list[ImuTrack]
) -> np.ndarray:
    """(T,) from the first to the last covered instant; raises `SessionError` where clocks differ.

    Clocks differ when some source covers a stretch of time that no chain of overlapping sources
    connects to the rest.
    """
    spans = [(float(t.times_s[0]), float(t.times_s[-1]), f"camera '{t.name}'") for t in keypoints]
    names = [f"imu '{imu.bone}' of '{s.name}'" for s in session.subjects for imu in s.imus]
    spans += [
        (float(track.times_s[0]), float(track.times_s[-1]), name)
        for track, name in zip(imus, names, strict=True)
    ]
    reached_s, until = -np.inf, ""
    for start_s, end_s, name in sorted(spans):
        if until and start_s > reached_s + MAX_GAP_S:
            raise SessionError(
                f"{session.path}: {until} ends at {reached_s:g} s, but {name} starts at "
                f"{start_s:g} s; nothing was recorded in between: set offset_s so that their "
                "clocks agree"
            )
        if end_s > reached_s:
            reached_s, until = end_s, name
    first_s = min(start for start, _, _ in spans)
    rate_hz = session.settings.rate_hz
    with np.errstate(over="ignore"):
        before = np.floor((spans[0][0] - first_s) * rate_hz + 1e-6)
        count = np.floor((reached_s - spans[0][0]) * rate_hz + 1e-6) + before + 1
    if not count <= MAX_INSTANTS:
        raise SessionError(
            f"{session.path}: {first_s:g} to {reached_s:g} s at {rate_hz:g} Hz are {count:.3g} "
            "instants; check times, rates and offset_s"
        )
    return spans[0][0] + np.arange(-before, count - before) / rate_hz


def content_hash(session: Session) -> str:
    """sha256 over the session file and, per input, its name, size and (up to 1 MiB) content.

    Of keypoint folders names and sizes only, and of detected ones the video and the detector. The
    same inputs hash alike in every folder.
    """
    digest = hashlib.sha256(read_bytes(session.path, SESSION) if session.path.is_file() else b"")
    inputs = [session.settings.calibration, session.settings.landmark_offsets]
    inputs += [session.settings.imu_calibration]
    inputs += [session.settings.sync] if session.settings.sync is not None else []
    for subject in session.subjects:
        inputs += [file for imu in subject.imus for file in (imu.file, imu.static_file)]
    inputs += [c.keypoints for c in session.cameras if c.keypoints and not c.keypoints.is_dir()]
    for path in inputs:
        if path is not None and path.is_dir():
            for file in sorted(path.iterdir()):
                _add_file(digest, file)
        elif path is not None:
            _add_file(digest, path)
    for camera in session.cameras:
        if camera.keypoints is not None and camera.keypoints.is_dir():
            for file in _names_and_sizes(camera.keypoints):
                digest.update(file)
            record = read_record(camera.keypoints)
            if record is not None:
                digest.update(f"{record.video.sha256}\0{record.detector}\0".encode())
    return digest.hexdigest()


def _names_and_sizes(folder: Path) -> list[bytes]:
    """Of its .json files, in order; little of each, as an hour's folder has 200,000."""
    with os.scandir(folder) as entries:
        return sorted(
            f"{entry.name}\0{entry.stat().st_size}\0".encode()
            for entry in entries
            if entry.name.endswith(".json") and entry.is_file()
        )


def _add_file(digest: hashlib._Hash, path: Path) -> None:
    if not path.is_file():
        return
    size = path.stat().st_size
    digest.update(f"{path.name}\0{size}\0".encode())
    if size <= HASHED_BYTES:
        digest.update(read_bytes(path, SENSORS))
