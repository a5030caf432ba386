"""Everything that is wrong with a session; unlike `open_session` it does not stop at the first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fusecap.doctor.detection import check_detection
from fusecap.doctor.folder import PRINT_A_BOARD, check_folder
from fusecap.doctor.imus import check_imus
from fusecap.doctor.keypoints import check_keypoints
from fusecap.doctor.views import check_views
from fusecap.errors import FusecapError
from fusecap.findings import Finding, Findings, Severity
from fusecap.geometry.camera import Rig
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import FILE_NAME, Session
from fusecap.sources.session_cameras import open_rig, with_detections
from fusecap.sources.session_data import session_clocks, solve_times_s, unplaced_wearers
from fusecap.sources.session_file import (
    missing_files,
    parse_session,
    session_file,
    with_imu_calibration,
)
from fusecap.sources.sync_files import Clocks

SHORT_S = 0.5
"""A person is followed for about as long before becoming a subject."""


def diagnose(path: Path | str, progress: Progress | None = None) -> list[Finding]:
    """Everything that is wrong or odd, errors first; empty for a session without a flaw."""
    findings = Findings()
    if Path(path).is_dir() and not (Path(path) / FILE_NAME).is_file():
        check_folder(Path(path), findings)
        return _sorted(findings)
    try:
        session = with_detections(parse_session(path))
    except FusecapError as error:
        for line in str(error).splitlines():
            findings.add("error", *_split(line))
        return findings
    for line in missing_files(session):
        findings.add("error", *_split(line))
    session, clocks = _calibrated(session, findings)
    rig = _check_rig(session, findings)
    check_detection(session, findings)
    tracks = check_keypoints(session, rig, findings, progress)
    tracks = {
        name: replace(track, times_s=clocks.camera(name).session_s(track.times_s))
        for name, track in tracks.items()
    }
    imus = check_imus(session, clocks, findings)
    _check_amount(session, tracks, findings)
    findings += unplaced_wearers(session)
    complete = len(tracks) == len(session.cameras) and all(
        track is not None for track in (*tracks.values(), *imus)
    )
    if complete and (tracks or imus):
        try:
            times_s = solve_times_s(
                session, tuple(tracks.values()), [t for t in imus if t is not None]
            )
            _check_length(times_s, findings)
        except FusecapError as error:
            findings.add("error", str(session_file(path).name), str(error).split(": ", 1)[-1])
    check_views(session, rig, tracks, findings)
    return _sorted(findings)


def _calibrated(session: Session, findings: Findings) -> tuple[Session, Clocks]:
    """The session with its sensors' calibration, and its clocks, where their files are right."""
    clocks = Clocks()
    settings = session.settings
    if settings.sync is not None and settings.sync.is_file():
        try:
            clocks = session_clocks(session)
        except FusecapError as error:
            findings.add("error", "clocks", str(error), "fusecap calibrate sync writes it anew")
    if settings.imu_calibration is not None and settings.imu_calibration.is_file():
        try:
            session = with_imu_calibration(session)
        except FusecapError as error:
            findings.add("error", "sensors", str(error))
    return session, clocks


def _sorted(findings: Findings) -> list[Finding]:
    order: dict[Severity, int] = {"error": 0, "warning": 1, "info": 2}
    return sorted(findings, key=lambda finding: order[finding.severity])


def _split(line: str) -> tuple[str, str]:
    where, _, found = line.partition(": ")
    return (where, found) if found else ("session", line)


def _check_rig(session: Session, findings: Findings) -> Rig | None:
    calibration = session.settings.calibration
    if not session.cameras or (calibration is not None and not calibration.exists()):
        return None
    if calibration is None:
        findings.add("error", "calibration", "is missing under [session]", PRINT_A_BOARD)
        return None
    try:
        rig, odd = open_rig(session)
    except FusecapError as error:
        findings.add("error", "calibration", str(error))
        return None
    findings += odd
    return rig


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
