"""Everything that is wrong with a session; unlike `open_session` it does not stop at the first."""

from __future__ import annotations

from pathlib import Path

from fusecap.errors import FusecapError
from fusecap.geometry.camera import Rig
from fusecap.sources.doctor.folder import check_folder
from fusecap.sources.doctor.imus import check_imus
from fusecap.sources.doctor.keypoints import check_keypoints
from fusecap.sources.doctor.views import check_views
from fusecap.sources.findings import Finding, Findings, Severity
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import FILE_NAME, Session, missing_files, parse_session, session_file
from fusecap.sources.session_data import Progress, open_rig, solve_times_s, unplaced_wearers


def diagnose(path: Path | str, progress: Progress | None = None) -> list[Finding]:
    """Everything that is wrong or odd, errors first; empty for a session without a flaw."""
    findings = Findings()
    if Path(path).is_dir() and not (Path(path) / FILE_NAME).is_file():
        check_folder(Path(path), findings)
        return _sorted(findings)
    try:
        session = parse_session(path)
    except FusecapError as error:
        for line in str(error).splitlines():
            findings.add("error", *_split(line))
        return findings
    for line in missing_files(session):
        findings.add("error", *_split(line))
    rig = _check_rig(session, findings)
    tracks = check_keypoints(session, rig, findings, progress)
    imus = check_imus(session, findings)
    _check_amount(session, tracks, findings)
    findings += unplaced_wearers(session)
    complete = len(tracks) == len(session.cameras) and all(
        track is not None for track in (*tracks.values(), *imus)
    )
    if complete and (tracks or imus):
        try:
            solve_times_s(session, tuple(tracks.values()), [t for t in imus if t is not None])
        except FusecapError as error:
            findings.add("error", str(session_file(path).name), str(error).split(": ", 1)[-1])
    check_views(session, rig, tracks, findings)
    return _sorted(findings)


def _sorted(findings: Findings) -> list[Finding]:
    order: dict[Severity, int] = {"error": 0, "warning": 1, "info": 2}
    return sorted(findings, key=lambda finding: order[finding.severity])


def _split(line: str) -> tuple[str, str]:
    where, _, found = line.partition(": ")
    return (where, found) if found else ("session", line)


def _check_rig(session: Session, findings: Findings) -> Rig | None:
    calibration = session.settings.calibration
    if calibration is None or not calibration.exists():
        return None
    try:
        rig, odd = open_rig(session)
    except FusecapError as error:
        findings.add("error", "calibration", str(error))
        return None
    findings += odd
    return rig


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
