"""A folder without a session file: what it holds, what it lacks, which command comes next."""

from __future__ import annotations

from pathlib import Path

from fusecap.doctor.videos import check_videos
from fusecap.findings import Findings
from fusecap.sources.folder_survey import FolderSurvey, survey
from fusecap.sources.session import FILE_NAME

PRINT_A_BOARD = (
    "print a board (fusecap calibrate board), film it with every camera, then: "
    "fusecap calibrate intrinsics, fusecap calibrate extrinsics, fusecap calibrate world"
)


def check_folder(folder: Path, findings: Findings) -> None:
    """Raises `InputError` where `folder` is none."""
    found = survey(folder)
    if found.nothing:
        findings.add(
            "error",
            str(folder),
            "no video, no keypoint folder and no sensor file",
            "put the recording into this folder; fusecap demo --write-session shows one",
        )
        return
    findings.add(
        "error",
        FILE_NAME,
        f"is missing; the folder holds {_inventory(found)}",
        f"fusecap init {folder} writes a first one",
    )
    check_videos({path.stem: folder / path for path in found.videos}, findings)
    _check_calibration(found, findings)
    _check_sensors(found, findings)


def _inventory(found: FolderSurvey) -> str:
    parts = [
        (len(found.videos), "video"),
        (len(found.keypoints), "keypoint folder"),
        (len(found.sensors), "sensor"),
    ]
    listed = [f"{count} {what}{'s' * (count > 1)}" for count, what in parts if count]
    if found.calibration is not None:
        listed.append(f"the calibration {found.calibration}")
    return ", ".join(listed)


def _check_calibration(found: FolderSurvey, findings: Findings) -> None:
    seen = {path.stem for path in found.videos} | set(found.keypoints)
    if not seen:
        return
    if found.calibration is None:
        findings.add("error", "calibration", "is missing", PRINT_A_BOARD)
        return
    strangers = sorted(seen - set(found.cameras))
    if strangers:
        findings.add(
            "warning",
            str(found.calibration),
            f"has no camera called {', '.join(strangers)}, only {', '.join(found.cameras)}",
            "rename the files, or give each [[camera]] the calibration's name",
        )


def _check_sensors(found: FolderSurvey, findings: Findings) -> None:
    nameless = [str(sensor.file) for sensor in found.sensors if sensor.bone is None]
    if nameless:
        findings.add(
            "warning",
            "sensors",
            f"names tell no bone for {len(nameless)} of {len(found.sensors)}: "
            f"{', '.join(nameless[:4])}{', ...' * (len(nameless) > 4)}",
            "give each a bone in session.toml; with cameras, fusecap calibrate imu --identify "
            "finds them from the motion",
        )
    if found.sensors and (found.videos or found.keypoints):
        findings.add(
            "info",
            "clocks",
            "cameras and sensors were started separately",
            "fusecap calibrate sync, then fusecap calibrate imu",
        )
