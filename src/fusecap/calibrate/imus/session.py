"""A session's sensors, calibrated from its own cameras, from a take, or from a T-pose."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.batch.solve import solve_session
from fusecap.body.landmarks import LANDMARK_SETS
from fusecap.calibrate.imus.checks import Worn
from fusecap.calibrate.imus.identify import Identity
from fusecap.calibrate.imus.joint_centres import MAX_INSTANTS, landmarks_seen
from fusecap.calibrate.imus.motion import (
    SubjectCalibration,
    calibrate_subject,
    identify_subject,
)
from fusecap.calibrate.imus.reference import ReferenceMotion, reference_motion
from fusecap.calibrate.imus.tpose import TPose, look_at_tpose
from fusecap.errors import InputError, SessionError
from fusecap.geometry.quaternions import to_wxyz
from fusecap.progress import Progress
from fusecap.sources.imu_calibration_files import CalibratedImu
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings, Session, SubjectSettings
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_data import SessionData, open_session, session_clocks
from fusecap.sources.session_sensors import open_imus
from fusecap.take import Take
from fusecap.types import Detections


def wearers(session: Session) -> list[SubjectSettings]:
    """Subjects with sensors; raises `InputError` where there are none."""
    found = [subject for subject in session.subjects if subject.imus]
    if not found:
        raise InputError(
            f"{session.path}: no [[subject.imu]]; there is nothing to calibrate. Add one table per "
            "sensor with its bone and file"
        )
    return found


def camera_data(session: Session, progress: Progress | None = None) -> SessionData | None:
    """What the cameras saw, without sensors; None where keypoints are missing."""
    session = with_detections(session)
    if not session.cameras or any(camera.keypoints is None for camera in session.cameras):
        return None
    bare = tuple(subject.model_copy(update={"imus": ()}) for subject in session.subjects)
    return open_session(session.model_copy(update={"subjects": bare}), progress)


def seen_by_cameras(
    session: Session, data: SessionData | None, progress: Progress | None = None
) -> Take:
    """The session solved from its cameras alone; raises `InputError` where it has none."""
    if data is None and not session.cameras:
        raise InputError(
            f"{session.path}: there are no cameras to see how the sensors move; give a take of the "
            "same motion (--take), or stand in a T-pose and use --from tpose"
        )
    if data is None:
        raise InputError(
            f"{session.path}: the cameras' videos have no keypoints yet; run: fusecap detect"
        )
    return solve_session(data, progress=progress).whole_take


def references(
    session: Session, take: Take, *, optical: bool = False
) -> dict[str, ReferenceMotion]:
    """What the take says about each subject with sensors; `optical` takes observe every axis."""
    landmarks = None
    if not optical:
        named = session.cameras[0].landmark_set_name if session.cameras else "body25"
        landmarks = LANDMARK_SETS[named]
    return {
        subject.name: reference_motion(take, take.subject(subject.name), landmarks)
        for subject in wearers(session)
    }


def calibrate_from_motion(
    session: Session,
    reference: dict[str, ReferenceMotion],
    take: Take,
    data: SessionData | None = None,
    progress: Progress | None = None,
) -> tuple[SubjectCalibration, ...]:
    """Every subject with sensors; a T-pose that the session states helps where it is sound.

    With `data`, the landmarks that cameras saw hold the sensors together. Raises `InputError`.
    """
    found = []
    for subject in wearers(session):
        _one_per_bone(subject)
        seen = None
        if data is not None and data.landmarks is not None and len(data.rig) > 1:
            seen = landmarks_seen(
                data.rig,
                data.landmarks,
                take,
                take.subject(subject.name),
                _some_instants(take, data),
            )
        worn = worn_by(session, subject)
        found.append(calibrate_subject(reference[subject.name], worn, seen, progress))
    return tuple(found)


def _some_instants(take: Take, data: SessionData) -> list[Detections]:
    """Of the cameras' instants those that the take has, spread evenly."""
    shown = np.isin(data.timestamps_ns, take.timestamps_ns).nonzero()[0]
    step = max(1, -(-len(shown) // MAX_INSTANTS))
    return [data.detections(int(instant)) for instant in shown[::step]]


def _one_per_bone(subject: SubjectSettings) -> None:
    bones = [imu.bone for imu in subject.imus]
    twice = sorted({bone for bone in bones if bones.count(bone) > 1})
    if twice:
        raise InputError(
            f"'{subject.name}' has two [[subject.imu]] on {', '.join(twice)}; a calibration is for "
            "one sensor per bone. Leave one out, or ask which bones they are on with --identify"
        )


def identify_sensors(
    session: Session, reference: dict[str, ReferenceMotion]
) -> dict[str, tuple[Identity, ...]]:
    """By subject, which of its sensors is on which bone."""
    return {
        subject.name: identify_subject(reference[subject.name], worn_by(session, subject))
        for subject in wearers(session)
    }


def worn_by(session: Session, subject: SubjectSettings) -> list[Worn]:
    """The subject's sensors with their samples and, where stated, their T-pose."""
    worn = []
    for settings, track in _on_session_clock(session, subject):
        tpose = None
        if subject.still_s is not None:
            with suppress(SessionError):  # of a sensor that was silent meanwhile
                tpose = look_at_tpose(subject, settings, track)
        worn.append(Worn(settings=settings, track=track, tpose=tpose))
    return worn


def _on_session_clock(
    session: Session, subject: SubjectSettings
) -> list[tuple[ImuSettings, ImuTrack]]:
    clocks = session_clocks(session)
    return [
        (imu, replace(track, times_s=clocks.imu(subject.name, imu.bone).session_s(track.times_s)))
        for imu, track in zip(subject.imus, open_imus(subject), strict=True)
    ]


def calibrate_from_tpose(session: Session) -> list[tuple[CalibratedImu, TPose]]:
    """Every sensor of every subject; raises `SessionError` without a T-pose."""
    found = []
    for subject in wearers(session):
        _one_per_bone(subject)
        for settings, track in _on_session_clock(session, subject):
            pose = look_at_tpose(subject, settings, track)
            w, x, y, z = to_wxyz(Rotation.from_matrix(pose.bone_from_imu)).tolist()
            imu = CalibratedImu(
                subject=subject.name,
                bone=settings.bone,
                bone_from_imu_wxyz=(w, x, y, z),
                heading_deg=settings.heading_deg,
            )
            found.append((imu, pose))
    return found


def calibrated_imus(found: Sequence[SubjectCalibration]) -> list[CalibratedImu]:
    """The values that are worth writing."""
    return [
        CalibratedImu(
            subject=sensor.subject,
            bone=sensor.bone,
            bone_from_imu_wxyz=sensor.bone_from_imu_wxyz,
            heading_deg=sensor.heading_deg,
        )
        for subject in found
        for sensor in subject.sensors
        if sensor.usable
    ]
