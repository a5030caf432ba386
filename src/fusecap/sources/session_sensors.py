"""A session's sensors: their samples on one clock, how they sit on bones, what is odd."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.errors import SessionError
from fusecap.findings import Finding
from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.imu_files import ImuTrack, read_imu
from fusecap.sources.session import ImuSettings, Session, SubjectSettings
from fusecap.sources.synchronizer import MAX_GAP_S, MountedImu, world_from_imu_world

LEAST_COMMON = 0.5
"""Of the shortest recording: of sensors that share less of it by their clock, it is not one."""
LONG_GAP_S, LOST_SHARE = 0.5, 0.05
"""Radio drops some of nearly every sensor's samples; beyond these motion is missing."""
TPOSE_MOVED_DEG = 15.0
"""95th percentile from a sensor's mean orientation: twice what people's T-poses are off anyway."""
_NOT_SYNCHRONISED = "its counter is not on the other sensors' clock"


def open_imus(subject: SubjectSettings) -> list[ImuTrack]:
    """The subject's tracks on the recorder's clock, each with its `offset_s`.

    Sensors that share a recorder's clock keep their mutual delays: the earliest starts at 0. Raises
    `InputError` for a sensor that cannot be read.
    """
    return [track for track in open_some_imus(subject, lambda _, read: read()) if track]


def open_some_imus(
    subject: SubjectSettings, attempt: Callable[[str, Callable[[], ImuTrack]], ImuTrack | None]
) -> list[ImuTrack | None]:
    """`open_imus`, where `attempt` says what becomes of a sensor that cannot be read."""
    tracks = [
        attempt(f"imu '{imu.bone}' of '{subject.name}'", lambda imu=imu: _read(subject, imu))
        for imu in subject.imus
    ]
    read = iter(_on_shared_clocks([track for track in tracks if track is not None]))
    return [
        track and _later(next(read), imu.offset_s)
        for track, imu in zip(tracks, subject.imus, strict=True)
    ]


def _read(subject: SubjectSettings, imu: ImuSettings) -> ImuTrack:
    if imu.file is None:
        raise SessionError(
            f"imu '{imu.bone}' of '{subject.name}' is live only; name a file of its samples, "
            "or use: fusecap live"
        )
    return read_imu(imu.file, format=imu.format, sensor=imu.sensor, rate_hz=imu.rate_hz)


def _later(track: ImuTrack, delay_s: float) -> ImuTrack:
    return replace(track, times_s=track.times_s + delay_s)


def _on_shared_clocks(tracks: list[ImuTrack]) -> list[ImuTrack]:
    """Each as much later than the earliest as their recorder's clock says.

    Sensors that were not synchronised count on their own: by the clock they would hardly have
    measured at once, so it is none that they share, and all start at 0.
    """
    placed = list(tracks)
    for period_s in {track.clock.period_s for track in tracks if track.clock}:
        group = [i for i, t in enumerate(tracks) if t.clock and t.clock.period_s == period_s]
        starts = np.array([t.clock.start_s for i, t in enumerate(tracks) if i in group and t.clock])
        behind = np.mod(starts - starts[0] + period_s / 2, period_s) - period_s / 2
        behind -= behind.min()
        lengths = np.array([float(np.ptp(tracks[i].times_s)) for i in group])
        common = (behind + lengths).min() - behind.max()
        if len(group) > 1 and common < LEAST_COMMON * lengths.min():
            for i in group:
                placed[i] = replace(
                    tracks[i], clock=None, notes=(*tracks[i].notes, _NOT_SYNCHRONISED)
                )
            continue
        for i, delay_s in zip(group, behind, strict=True):
            placed[i] = _later(tracks[i], float(delay_s))
    return placed


def sensor_notes(subject: SubjectSettings, tracks: Sequence[ImuTrack | None]) -> list[Finding]:
    """What was dealt with in a subject's sensor files; None for a file that was not read.

    Lost samples are one finding per subject: radio drops some of nearly every sensor's.
    """
    findings, alone = [], []
    for imu, track in zip(subject.imus, tracks, strict=True):
        for note in () if track is None else track.notes:
            if note == _NOT_SYNCHRONISED:
                alone.append(imu.bone)
            else:
                where = f"imu '{imu.bone}' of '{subject.name}'"
                findings.append(Finding(severity="warning", where=where, found=note, remedy=""))
    findings += _lost_samples(subject, tracks)
    if alone:
        findings.append(
            Finding(
                severity="warning",
                where=f"sensors of '{subject.name}'",
                found=f"their counters do not share a clock ({', '.join(alone)}): each starts at 0",
                remedy="synchronise sensors before recording; fusecap calibrate sync finds each "
                "one's delay from motion the cameras saw, offset_s states it",
            )
        )
    return findings


def _lost_samples(subject: SubjectSettings, tracks: Sequence[ImuTrack | None]) -> list[Finding]:
    lost, grave = [], False
    for imu, track in zip(subject.imus, tracks, strict=True):
        if track is not None and (track.gaps > 0).any():
            count, gaps = int(track.gaps.sum()), int(np.count_nonzero(track.gaps > 0))
            lost.append((imu.bone, f"{count} in {gaps} gap{'s' if gaps > 1 else ''}"))
            grave |= float(np.diff(track.times_s).max()) > LONG_GAP_S
            grave |= count > LOST_SHARE * (count + len(track.times_s))
    if not lost:
        return []
    return [
        Finding(
            severity="warning" if grave else "info",
            where=f"sensors of '{subject.name}'",
            found=f"samples lost: {', '.join(f'{bone} {found}' for bone, found in lost)}",
            remedy=f"gaps over {MAX_GAP_S:g} s are not bridged",
        )
    ]


def without_unplaced_sensors(session: Session) -> tuple[Session, list[Finding]]:
    """Of a calibrated session, without the sensors that calibration could not place."""
    if session.settings.imu_calibration is None:
        return session, []
    subjects, findings = [], []
    for subject in session.subjects:
        placed = tuple(
            imu
            for imu in subject.imus
            if imu.bone_from_imu_wxyz is not None or subject.still_s is not None
        )
        left_out = [imu.bone for imu in subject.imus if imu not in placed]
        subjects.append(subject.model_copy(update={"imus": placed}))
        if left_out:
            findings.append(
                Finding(
                    severity="warning",
                    where=f"sensors of '{subject.name}'",
                    found=f"left out: {', '.join(left_out)}, which "
                    f"{session.settings.imu_calibration.name} does not hold",
                    remedy="fusecap calibrate imu says why it could not place them",
                )
            )
    return session.model_copy(update={"subjects": tuple(subjects)}), findings


def mount(subject: SubjectSettings, tracks: list[ImuTrack]) -> list[MountedImu]:
    """Sensors with their offsets; `bone_from_imu` as given, by a T- or N-pose, else MVN's."""
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


def still_samples(subject: SubjectSettings, imu: ImuSettings, track: ImuTrack) -> ImuTrack:
    """The sensor while the subject stands in the T- or N-pose, of the static trial if it has one.

    Raises `SessionError` without an interval or samples in it and for a static trial whose world
    is not the motion's, `InputError` for one that cannot be read.
    """
    where = f"imu '{imu.bone}' of '{subject.name}'"
    if subject.still_s is None:
        raise SessionError(
            f"{where}: how it sits on the bone is not known; fusecap calibrate imu finds it from "
            "motion the cameras saw, tpose_s states when the subject stands in the T-pose, npose_s "
            "in the N-pose, bone_from_imu_wxyz = [1, 0, 0, 0] a sensor whose axes are the bone's"
        )
    if imu.static_file is not None:
        static = read_imu(
            imu.static_file, format=imu.format, sensor=imu.sensor, rate_hz=imu.rate_hz
        )
        if not (static.heading_known and track.heading_known):
            raise SessionError(
                f"{where}: found without a magnetometer, static_file and file face different ways, "
                "nobody knows which; fusecap calibrate imu finds how it sits from motion the "
                "cameras saw, or take static_file out and state when the pose is held in file"
            )
        track = static
    start_s, end_s = subject.still_s
    inside = (track.times_s >= start_s) & (track.times_s <= end_s)
    if not inside.any():
        raise SessionError(
            f"{where}: no sample in {_still(subject)}; its samples run from "
            f"{track.times_s[0]:g} to {track.times_s[-1]:g} s"
        )
    return replace(
        track,
        times_s=track.times_s[inside],
        orientation_wxyz=track.orientation_wxyz[inside],
        accel_m_s2=track.accel_m_s2[inside],
    )


def world_from_still_bone(subject: SubjectSettings, bone: str) -> np.ndarray:
    """(3, 3) how the bone is turned in the pose of `still_samples`."""
    facing = Rotation.from_euler("y", subject.tpose_facing_deg, degrees=True)
    side, _, part = bone.partition("_")
    if subject.npose_s is not None and part in ("upper_arm", "forearm", "hand"):
        facing *= Rotation.from_euler("z", -90 if side == "left" else 90, degrees=True)
    return facing.as_matrix()


def _still(subject: SubjectSettings) -> str:
    key = "tpose_s" if subject.tpose_s is not None else "npose_s"
    start_s, end_s = subject.still_s or (0.0, 0.0)
    return f"{key} = [{start_s:g}, {end_s:g}]"


def _bone_from_imu(subject: SubjectSettings, imu: ImuSettings, track: ImuTrack) -> np.ndarray:
    if imu.bone_from_imu_wxyz is not None:
        return from_wxyz(imu.bone_from_imu_wxyz).as_matrix()
    if subject.still_s is None and track.bone_from_imu is not None:
        return track.bone_from_imu
    turned = from_wxyz(still_samples(subject, imu, track).orientation_wxyz)
    mean = turned.mean()
    moved_deg = float(np.degrees(np.percentile((mean.inv() * turned).magnitude(), 95)))
    if moved_deg > TPOSE_MOVED_DEG:
        raise SessionError(
            f"imu '{imu.bone}' of '{subject.name}': turns by {moved_deg:.0f} deg within "
            f"{_still(subject)}; choose a stretch in which the subject stands still in this pose"
        )
    world_from_imu = world_from_imu_world(imu.imu_up, imu.heading_deg) @ mean.as_matrix()
    return world_from_still_bone(subject, imu.bone).T @ world_from_imu
