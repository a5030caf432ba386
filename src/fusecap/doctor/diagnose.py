"""Everything that is wrong with a session; unlike `open_session` it does not stop at the first."""

from __future__ import annotations

from pathlib import Path

from fusecap.checks import check_measurements
from fusecap.doctor.detection import check_detection
from fusecap.doctor.folder import PRINT_A_BOARD, check_folder
from fusecap.errors import FusecapError
from fusecap.findings import Finding, Findings
from fusecap.progress import Progress
from fusecap.sources.session import FILE_NAME, Session
from fusecap.sources.session_cameras import with_detections
from fusecap.sources.session_data import open_inputs
from fusecap.sources.session_file import (
    missing_files,
    parse_session,
    with_imu_calibration,
)


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
    findings += check_measurements(
        inputs.session,
        inputs.rig,
        [track for track in inputs.keypoints if track is not None],
        inputs.imus,
        inputs.times_s,
    )
    return findings.sorted()


def _told(session: Session) -> set[str]:
    """Where nothing can be opened, as missing files and missing keypoints are told already."""
    settings = session.settings
    told = {
        f"camera '{camera.name}'"
        for camera in session.cameras
        if camera.keypoints is None or not camera.keypoints.exists()
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
