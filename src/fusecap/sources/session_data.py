"""A session with its files open: everything the pipeline needs, instant by instant.

The solve runs from the first to the last instant that any camera or IMU covers, at the session's
rate, in step with the first camera's frames (or the first IMU's samples), so that cameras of the
session's rate are not interpolated at all.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.errors import SessionError
from fusecap.findings import Finding
from fusecap.geometry.camera import Rig
from fusecap.geometry.quaternions import from_wxyz
from fusecap.progress import Progress
from fusecap.sources.calibration_files import check_rig, load_rig
from fusecap.sources.detection_files import read_record
from fusecap.sources.imu_files import ImuTrack, read_imu
from fusecap.sources.keypoint_files import KeypointTrack, read_keypoints
from fusecap.sources.offset_files import read_offsets
from fusecap.sources.session import CameraSettings, ImuSettings, Session, SubjectSettings
from fusecap.sources.sync_files import Clocks, read_sync
from fusecap.sources.synchronizer import (
    MAX_GAP_S,
    MountedImu,
    people_at,
    resample_imus,
    world_from_imu_world,
)
from fusecap.types import Detections, ImuReading

MAX_INSTANTS = 2_000_000
"""9 hours at 60 Hz: beyond this, clocks do not agree."""
HASHED_BYTES = 1 << 20
"""Of a larger file only name and size enter the hash."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SubjectImus:
    """The sensors of one subject, on the solve's instants."""

    subject: str
    bones: tuple[str, ...]
    """(I,) which bone carries each sensor."""
    positions_in_bone_m: np.ndarray
    """(I, 3) t_ib [1, eq. 11]."""
    bone_rotation_in_world: np.ndarray
    """(T, I, 3, 3), NaN where not measured [1, eq. 8]."""
    accel_in_world_m_s2: np.ndarray
    """(T, I, 3) without gravity, NaN where not measured [1, eq. 12]."""

    def reading(self, instant: int) -> ImuReading:
        """What the sensors say at one of the solve's instants."""
        return ImuReading(
            bone_rotation_in_world=self.bone_rotation_in_world[instant],
            accel_in_world_m_s2=self.accel_in_world_m_s2[instant],
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
        return Detections(
            timestamp_ns=round(t_s * 1e9),
            people=tuple(people_at(track, t_s) for track in self.keypoints),
        )

    def frames(self) -> Iterator[tuple[int, Detections, dict[str, ImuReading]]]:
        """Per instant its timestamp [ns], the detections, and each subject's IMU reading."""
        for instant in range(len(self.times_s)):
            detections = self.detections(instant)
            readings = {imus.subject: imus.reading(instant) for imus in self.imus}
            yield detections.timestamp_ns, detections, readings


def open_session(session: Session, progress: Progress | None = None) -> SessionData:
    """Reads all inputs; raises `InputError` for the first that cannot be used.

    Cameras with a video need keypoints that were detected in it (`with_detections`).
    """
    session = with_detections(session)
    rig, findings = open_rig(session)
    landmarks = common_landmarks(session)
    keypoints = open_keypoints(session, progress)
    for track in keypoints:
        if track.broken:
            findings.append(broken_files(track))
    clocks = session_clocks(session)
    keypoints = tuple(
        replace(track, times_s=clocks.camera(track.name).session_s(track.times_s))
        for track in keypoints
    )
    findings += unplaced_wearers(session)
    tracks = {}
    for subject in session.subjects:
        tracks[subject.name] = [
            replace(track, times_s=clocks.imu(subject.name, imu.bone).session_s(track.times_s))
            for imu, track in zip(subject.imus, open_imus(subject), strict=True)
        ]
        findings += sensor_notes(subject, tracks[subject.name])
    times_s = solve_times_s(session, keypoints, [t for some in tracks.values() for t in some])
    imus = []
    for subject in session.subjects:
        if subject.imus:
            mounted = mount(subject, tracks[subject.name])
            rotations, accelerations = resample_imus(mounted, times_s)
            imus.append(
                SubjectImus(
                    subject=subject.name,
                    bones=tuple(imu.bone for imu in mounted),
                    positions_in_bone_m=np.array([imu.position_in_bone_m for imu in mounted]),
                    bone_rotation_in_world=rotations,
                    accel_in_world_m_s2=accelerations,
                )
            )
    return SessionData(
        session=session,
        rig=rig,
        landmarks=landmarks,
        keypoints=keypoints,
        imus=tuple(imus),
        times_s=times_s,
        findings=tuple(findings),
        content_hash=content_hash(session),
    )


def with_detections(session: Session) -> Session:
    """The session with what `fusecap detect` left in its folder.

    A camera that names a video only gets the folder of its keypoints, where these are complete and
    the video still has the name and size that they were made from. A session that does not state
    its rate takes that of the first detected video.
    """
    cameras = tuple(_with_folder(session, camera) for camera in session.cameras)
    settings = session.settings
    if "rate_hz" not in settings.model_fields_set:
        records = [read_record(c.keypoints) for c in cameras if c.keypoints and not c.rate_hz]
        rates_hz = [record.video.rate_hz for record in records if record is not None]
        if rates_hz:
            settings = settings.model_copy(update={"rate_hz": rates_hz[0]})
    return session.model_copy(update={"cameras": cameras, "settings": settings})


def _with_folder(session: Session, camera: CameraSettings) -> CameraSettings:
    if camera.keypoints is not None or camera.video is None:
        return camera
    folder = session.detection_folder(camera)
    record = read_record(folder)
    if record is None or not record.complete or not record.video.is_likely(camera.video):
        return camera
    return camera.model_copy(update={"keypoints": folder})


def unplaced_wearers(session: Session) -> list[Finding]:
    """People who wear sensors but could be anyone the cameras find first."""
    if not session.cameras or len(session.subjects) < 2:
        return []
    names = [s.name for s in session.subjects if s.imus and s.start_m is None]
    if not names:
        return []
    return [
        Finding(
            severity="warning",
            where="subjects",
            found=f"{', '.join(names)}: sensors, but no start position to tell them apart by",
            remedy="add start_m = [x, z], or sensors may be taken for another person's",
        )
    ]


def session_clocks(session: Session) -> Clocks:
    """Those of the session's `sync` file; of one without, everybody's times are right."""
    return Clocks() if session.settings.sync is None else read_sync(session.settings.sync)


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
    rig = load_rig(
        session.settings.calibration,
        up=session.settings.up,
        unit=session.settings.calibration_unit,
    ).subset([camera.name for camera in session.cameras])
    return rig, check_rig(rig, floor=session.settings.floor)


def common_landmarks(session: Session) -> LandmarkSet | None:
    """The one landmark set of all cameras, with the session's offsets; None without cameras.

    Raises `SessionError` when cameras differ, `InputError` for offsets that cannot be used.
    """
    names = {camera.name: _landmark_set_name(session, camera) for camera in session.cameras}
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
    return tuple(
        _keypoints(session, index, landmarks, progress) for index in range(len(session.cameras))
    )


def _keypoints(
    session: Session, index: int, landmarks: LandmarkSet | None, progress: Progress | None
) -> KeypointTrack:
    camera = session.cameras[index]
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
        progress=progress,
    )


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


def open_imus(subject: SubjectSettings) -> list[ImuTrack]:
    """The subject's tracks on the session's clock.

    Sensors that share a recorder's clock keep their mutual delays: the earliest starts at 0.
    """
    tracks = []
    for imu in subject.imus:
        if imu.file is None:
            raise SessionError(
                f"imu '{imu.bone}' of '{subject.name}' is live only; name a file of its samples, "
                "or use: fusecap live"
            )
        tracks.append(read_imu(imu.file, format=imu.format, sensor=imu.sensor, rate_hz=imu.rate_hz))
    delays = _shared_delays_s(tracks)
    return [
        replace(track, times_s=track.times_s + delay + imu.offset_s)
        for track, delay, imu in zip(tracks, delays, subject.imus, strict=True)
    ]


def _shared_delays_s(tracks: list[ImuTrack]) -> list[float]:
    delays = [0.0] * len(tracks)
    for period_s in {track.clock.period_s for track in tracks if track.clock}:
        group = [i for i, t in enumerate(tracks) if t.clock and t.clock.period_s == period_s]
        starts = np.array([t.clock.start_s for i, t in enumerate(tracks) if i in group and t.clock])
        behind = np.mod(starts - starts[0] + period_s / 2, period_s) - period_s / 2
        for i, delay in zip(group, behind - behind.min(), strict=True):
            delays[i] = float(delay)
    return delays


def sensor_notes(subject: SubjectSettings, tracks: Sequence[ImuTrack | None]) -> list[Finding]:
    """What was dealt with in a subject's sensor files; None for a file that was not read.

    Lost samples are one finding per subject: radio drops some of nearly every sensor's.
    """
    findings, lost = [], []
    for imu, track in zip(subject.imus, tracks, strict=True):
        for note in () if track is None else track.notes:
            if "samples lost" in note:
                lost.append((imu.bone, note))
            else:
                where = f"imu '{imu.bone}' of '{subject.name}'"
                findings.append(Finding(severity="warning", where=where, found=note, remedy=""))
    if lost:
        each = ", ".join(f"{bone} {note.replace(' samples lost', '')}" for bone, note in lost)
        alone = len(lost) == 1
        findings.append(
            Finding(
                severity="warning",
                where=f"imu '{lost[0][0]}' of '{subject.name}'"
                if alone
                else f"sensors of '{subject.name}'",
                found=lost[0][1] if alone else f"samples lost: {each}",
                remedy="gaps over 0.1 s are not bridged",
            )
        )
    return findings


def mount(subject: SubjectSettings, tracks: list[ImuTrack]) -> list[MountedImu]:
    """Sensors with their offsets; `bone_from_imu` from the T-pose where it is not given."""
    return [
        MountedImu(
            bone=imu.bone,
            track=track,
            world_from_imu_world=world_from_imu_world(imu.imu_up, imu.heading_deg),
            bone_from_imu=_bone_from_imu(subject, imu, track),
            position_in_bone_m=np.array(imu.position_m),
        )
        for imu, track in zip(subject.imus, tracks, strict=True)
    ]


def _bone_from_imu(subject: SubjectSettings, imu: ImuSettings, track: ImuTrack) -> np.ndarray:
    where = f"imu '{imu.bone}' of '{subject.name}'"
    if imu.bone_from_imu_wxyz is not None:
        return from_wxyz(imu.bone_from_imu_wxyz).as_matrix()
    if subject.tpose_s is None:
        raise SessionError(
            f"{where}: how it sits on the bone is not known; fusecap calibrate imu finds it from "
            "motion the cameras saw, tpose_s states when the subject stands in the T-pose, "
            "bone_from_imu_wxyz = [1, 0, 0, 0] a sensor whose axes are the bone's"
        )
    start_s, end_s = subject.tpose_s
    inside = (track.times_s >= start_s) & (track.times_s <= end_s)
    if not inside.any():
        raise SessionError(
            f"{where}: no sample in tpose_s = [{start_s:g}, {end_s:g}]; its samples run from "
            f"{track.times_s[0]:g} to {track.times_s[-1]:g} s"
        )
    mean = from_wxyz(track.orientation_wxyz[inside]).mean().as_matrix()
    world_from_imu = world_from_imu_world(imu.imu_up, imu.heading_deg) @ mean
    world_from_bone = Rotation.from_euler("y", subject.tpose_facing_deg, degrees=True).as_matrix()
    return world_from_bone.T @ world_from_imu


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
    before = np.floor((spans[0][0] - first_s) * rate_hz + 1e-6)
    count = int(np.floor((reached_s - spans[0][0]) * rate_hz + 1e-6) + before) + 1
    if count > MAX_INSTANTS:
        raise SessionError(
            f"{session.path}: {first_s:g} to {reached_s:g} s at {rate_hz:g} Hz are {count} "
            "instants; check times, rates and offset_s"
        )
    return spans[0][0] + np.arange(-before, count - before) / rate_hz


def content_hash(session: Session) -> str:
    """sha256 over the session file and, per input, its name, size and (up to 1 MiB) content.

    Of keypoint folders names and sizes only, and of detected ones the video and the detector. The
    same inputs hash alike in every folder.
    """
    digest = hashlib.sha256(session.path.read_bytes() if session.path.is_file() else b"")
    inputs = [session.settings.calibration, session.settings.landmark_offsets]
    inputs += [session.settings.imu_calibration]
    inputs += [session.settings.sync] if session.settings.sync is not None else []
    inputs += [imu.file for subject in session.subjects for imu in subject.imus]
    for path in inputs:
        if path is not None and path.is_dir():
            for file in sorted(path.iterdir()):
                _add_file(digest, file, with_content=True)
        elif path is not None:
            _add_file(digest, path, with_content=True)
    for camera in session.cameras:
        if camera.keypoints is not None and camera.keypoints.is_dir():
            for file in sorted(camera.keypoints.glob("*.json")):
                _add_file(digest, file, with_content=False)
            record = read_record(camera.keypoints)
            if record is not None:
                digest.update(f"{record.video.sha256}\0{record.detector}\0".encode())
    return digest.hexdigest()


def _add_file(digest: hashlib._Hash, path: Path, *, with_content: bool) -> None:
    if not path.is_file():
        return
    size = path.stat().st_size
    digest.update(f"{path.name}\0{size}\0".encode())
    if with_content and size <= HASHED_BYTES:
        digest.update(path.read_bytes())
