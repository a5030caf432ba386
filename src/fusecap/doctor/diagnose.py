"""Everything that is wrong with a session; unlike `open_session` it does not stop at the first."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fusecap.doctor.detection import check_detection
from fusecap.doctor.folder import PRINT_A_BOARD, check_folder
from fusecap.doctor.imus import check_imus
from fusecap.doctor.keypoints import check_keypoints
from fusecap.doctor.views import check_views
from fusecap.errors import FusecapError
from fusecap.findings import Finding, Findings
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import FILE_NAME, Session
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_data import open_inputs
from fusecap.sources.session_file import (
    missing_files,
    parse_session,
    with_imu_calibration,
)

SHORT_S = 0.5
"""A person is followed for about as long before becoming a subject."""


def diagnose(path: Path | str, progress: Progress | None = None) -> list[Finding]:
    """Everything that is wrong or odd, errors first; empty for a session without a flaw."""
    findings = Findings()
    if Path(path).is_dir() and not (Path(path) / FILE_NAME).is_file():
        check_folder(Path(path), findings)
        return findings.sorted()
    try:
        session = with_detections(parse_session(path))
    except FusecapError as error:
        for line in str(error).splitlines():
            findings.add("error", *_split(line))
        return findings
    for line in missing_files(session):
        findings.add("error", *_split(line))
    session = _calibrated(session, findings)
    told = _told(session)

    def failed(where: str, error: FusecapError) -> None:
        if where in told:
            return
        if where == "calibration" and session.settings.calibration is None:
            findings.add("error", where, "is missing under [session]", PRINT_A_BOARD)
            return
        found = str(error).removeprefix(f"{session.path}: ").removeprefix(f"{where}: ")
        remedy = "fusecap calibrate sync writes it anew" if where == "clocks" else ""
        findings.add("error", where, found, remedy)

    inputs = open_inputs(session, failed, progress)
    findings += inputs.findings
    check_detection(session, findings)
    tracks = {track.name: track for track in inputs.keypoints if track is not None}
    check_keypoints(tracks, inputs.rig, findings)
    check_imus(session, inputs.imus, findings)
    _check_amount(session, tracks, findings)
    if inputs.times_s is not None:
        _check_length(inputs.times_s, findings)
    check_views(session, inputs.rig, tracks, findings)
    return findings.sorted()


def _told(session: Session) -> set[str]:
    """Where nothing can be opened, as missing files and missing keypoints are told already."""
    settings = session.settings
    told = {
        f"camera '{camera.name}'"
        for camera in session.cameras
        if camera.keypoints is None or not camera.keypoints.is_dir()
    }
    told |= {
        f"imu '{imu.bone}' of '{subject.name}'"
        for subject in session.subjects
        for imu in subject.imus
        if imu.file is None or not imu.file.is_file()
    }
    if settings.calibration is not None and not settings.calibration.exists():
        told.add("calibration")
    if settings.sync is not None and not settings.sync.is_file():
        told.add("clocks")
    return told


def _calibrated(session: Session, findings: Findings) -> Session:
    """The session with its sensors' calibration, where that file is right."""
    calibration = session.settings.imu_calibration
    if calibration is None or not calibration.is_file():
        return session
    try:
        return with_imu_calibration(session)
    except FusecapError as error:
        findings.add("error", "sensors", str(error))
        return session


def _split(line: str) -> tuple[str, str]:
    where, _, found = line.partition(": ")
    return (where, found) if found else ("session", line)


def _check_length(times_s: np.ndarray, findings: Findings) -> None:
    length_s = float(times_s[-1] - times_s[0])
    if length_s < SHORT_S:
        findings.add(
            "warning",
            "session",
            f"lasts {length_s:.2f} s in all",
            f"people are found once they are followed for {SHORT_S:g} s: record longer, and see "
            "whether files are whole",
        )


def _check_amount(session: Session, tracks: dict[str, KeypointTrack], findings: Findings) -> None:
    with_imus = any(subject.imus for subject in session.subjects)
    seen = sum(len(people) for track in tracks.values() for people in track.people)
    if tracks and seen == 0:
        findings.add(
            "warning" if with_imus else "error",
            "cameras",
            "no camera sees anyone",
            "check the detector's output",
        )
    if len(session.cameras) == 0:
        findings.add(
            "info",
            "session",
            "no camera: where the subjects stand is not observed, only their posture",
            "add cameras for positions",
        )
    if len(session.cameras) == 1:
        findings.add(
            "warning",
            f"camera '{session.cameras[0].name}'",
            "is the only one: depth is not observed",
            "add a second camera",
        )
