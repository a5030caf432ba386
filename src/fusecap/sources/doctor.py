"""`fusecap doctor`: what is wrong with a session, before it is solved, and what to do.

Unlike `open_session` it does not stop at the first error.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.errors import FusecapError
from fusecap.geometry.camera import Camera, Rig
from fusecap.sources import view_agreement
from fusecap.sources.calibration_files.loader import Y_UP_FROM
from fusecap.sources.findings import Finding, Severity
from fusecap.sources.imu_files import read_imu
from fusecap.sources.imu_files.track import GRAVITY_M_S2, ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack, read_keypoints
from fusecap.sources.session import ImuSettings, Session, missing_files, parse_session, session_file
from fusecap.sources.session_data import (
    Progress,
    broken_files,
    common_landmarks,
    mount,
    open_rig,
    solve_times_s,
    unplaced_wearers,
)

SAMPLED_INSTANTS = 60
MAX_DISAGREEMENT_SHARE = 0.01
"""Of the image's diagonal: 22 px of a 1920 x 1080 image."""
NOTABLE_DISAGREEMENT_SHARE = 0.005
"""The same of a camera that disagrees twice as much as the others, and of a typical pair."""
LOW_COVERAGE = 0.1
SHIFT_RANGE_S = 1.0
PEOPLE_HEIGHT_M = (0.7, 2.2)
"""From ankle to nose, standing or bent."""


class _Findings(list[Finding]):
    def add(self, severity: Severity, where: str, found: str, remedy: str = "") -> None:
        self.append(Finding(severity=severity, where=where, found=found, remedy=remedy))


def diagnose(path: Path | str, progress: Progress | None = None) -> list[Finding]:
    """Everything that is wrong or odd, errors first; empty for a session without a flaw."""
    findings = _Findings()
    try:
        session = parse_session(path)
    except FusecapError as error:
        for line in str(error).splitlines():
            findings.add("error", *_split(line))
        return findings
    for line in missing_files(session):
        findings.add("error", *_split(line))
    rig = _check_rig(session, findings)
    tracks = _check_keypoints(session, rig, findings, progress)
    imus = _check_imus(session, findings)
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
    _check_views(session, rig, tracks, findings)
    order: dict[Severity, int] = {"error": 0, "warning": 1, "info": 2}
    return sorted(findings, key=lambda finding: order[finding.severity])


def _split(line: str) -> tuple[str, str]:
    where, _, found = line.partition(": ")
    return (where, found) if found else ("session", line)


def _check_rig(session: Session, findings: _Findings) -> Rig | None:
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


def _check_keypoints(
    session: Session, rig: Rig | None, findings: _Findings, progress: Progress | None
) -> dict[str, KeypointTrack]:
    """Per camera that could be read its track."""
    tracks: dict[str, KeypointTrack] = {}
    try:
        landmarks = common_landmarks(session)
    except FusecapError as error:
        findings.add("error", "cameras", str(error).split(": ", 1)[-1])
        return tracks
    for done, camera in enumerate(session.cameras, start=1):
        where = f"camera '{camera.name}'"
        if progress is not None:
            progress(where, done, len(session.cameras))
        if camera.keypoints is None:
            findings.add(
                "error", where, "has a video but no keypoints", "run a detector on the video"
            )
        if camera.keypoints is None or landmarks is None or not camera.keypoints.is_dir():
            continue
        try:
            track = read_keypoints(
                camera.keypoints,
                name=camera.name,
                landmarks=landmarks,
                rate_hz=session.camera_rate_hz(camera),
                offset_s=camera.offset_s,
            )
        except FusecapError as error:
            findings.add("error", where, str(error))
            continue
        tracks[camera.name] = track
        if track.broken:
            findings.append(broken_files(track))
        _check_coverage(track, findings)
        _check_order(track, findings)
        if rig is not None:
            _check_inside(track, rig[camera.name], findings)
    _check_lengths(tracks, findings)
    return tracks


def _check_coverage(track: KeypointTrack, findings: _Findings) -> None:
    spanned = int(track.frames[-1] - track.frames[0]) + 1
    share = sum(len(people) > 0 for people in track.people) / spanned
    if share < LOW_COVERAGE:
        findings.add(
            "warning",
            f"camera '{track.name}'",
            f"sees people in {share:.1%} of its {spanned} frames",
            "check the detector's output of this camera, or leave the camera out",
        )


def _check_inside(track: KeypointTrack, camera: Camera, findings: _Findings) -> None:
    points = _all_people(track)[:, :, :2].reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return
    width, height = camera.size_px
    outside = np.any((points < -0.05 * width) | (points > [1.05 * width, 1.05 * height]), axis=1)
    reach = points.max(0)
    if outside.mean() > 0.02:
        found = f"{outside.mean():.0%} of the keypoints lie outside the {width} x {height} image"
    elif np.all(reach < 0.5 * np.array([width, height])):
        found = f"no keypoint lies beyond {reach[0]:.0f}, {reach[1]:.0f} of {width} x {height} px"
    else:
        return
    findings.add(
        "warning",
        f"camera '{track.name}'",
        found,
        "the detector seems to have run at another resolution than the calibration",
    )


def _all_people(track: KeypointTrack) -> np.ndarray:
    """(n, K, 3) of up to a few hundred frames."""
    step = max(1, len(track.people) // 300)
    return np.concatenate(track.people[::step])


_LINKS = [
    *(("nose", "head_top"), ("head_top", "upper_neck"), ("nose", "neck"), ("mid_hip", "left_hip")),
    *(("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("neck", "left_shoulder")),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in ("left", "right")
        for a, b in (
            *(("eye", "nose"), ("ear", "eye"), ("shoulder", "hip"), ("shoulder", "elbow")),
            *(("elbow", "wrist"), ("hip", "knee"), ("knee", "ankle"), ("ankle", "heel")),
            *(("heel", "big_toe"), ("big_toe", "small_toe")),
        )
    ),
]
"""Neighbours on the body, so that every landmark has one."""


def _check_order(track: KeypointTrack, findings: _Findings) -> None:
    """Read in the wrong order, neighbours on the body lie far apart in the image."""
    people = _all_people(track)
    stated = track.landmarks
    lengths = {
        other.name: _link_length(people, other)
        for other in LANDMARK_SETS.values()
        if len(other.landmark_names) == len(stated.landmark_names)
    }
    best = min(lengths, key=lambda name: lengths[name])
    if lengths[best] < 0.85 * lengths[stated.name]:
        findings.add(
            "error",
            f"camera '{track.name}'",
            f"the keypoints are not in the order of 'openpose-{stated.name}'",
            f"they look like 'openpose-{best}': set format",
        )


def _link_length(people: np.ndarray, landmarks: LandmarkSet) -> float:
    """Mean distance of neighbours [px]; infinite when none are seen.

    All keypoints are linked, so that no order can look short by leaving the long ways out.
    """
    pairs = [(landmarks.index(a), landmarks.index(b)) for a, b in _LINKS]
    known = np.array([(a, b) for a, b in pairs if a is not None and b is not None])
    span = np.linalg.norm(people[:, known[:, 0], :2] - people[:, known[:, 1], :2], axis=2)
    return float(np.nanmean(span)) if np.isfinite(span).any() else np.inf


def _check_lengths(tracks: dict[str, KeypointTrack], findings: _Findings) -> None:
    if len(tracks) < 2:
        return
    first = {name: float(track.times_s[0]) for name, track in tracks.items()}
    last = {name: float(track.times_s[-1]) for name, track in tracks.items()}
    for what, at in (("start", first), ("end", last)):
        low, high = min(at, key=lambda n: at[n]), max(at, key=lambda n: at[n])
        if at[high] - at[low] > 0.5:
            findings.add(
                "warning",
                "cameras",
                f"{what} at different times: '{low}' at {at[low]:.2f} s, "
                f"'{high}' at {at[high]:.2f} s",
                "check rate_hz and offset_s, or frames missing from a folder",
            )


def _check_amount(session: Session, tracks: dict[str, KeypointTrack], findings: _Findings) -> None:
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


def _check_imus(session: Session, findings: _Findings) -> list[ImuTrack | None]:
    tracks: list[ImuTrack | None] = []
    for subject in session.subjects:
        for imu in subject.imus:
            where = f"imu '{imu.bone}' of '{subject.name}'"
            track = None
            if imu.file.is_file():
                try:
                    track = read_imu(
                        imu.file, format=imu.format, sensor=imu.sensor, rate_hz=imu.rate_hz
                    )
                    mount(subject.model_copy(update={"imus": (imu,)}), [track])
                except FusecapError as error:
                    findings.add("error", where, str(error))
            if track is not None:
                _check_imu(where, imu, track, findings)
            tracks.append(track)
    return tracks


def _check_imu(where: str, imu: ImuSettings, track: ImuTrack, findings: _Findings) -> None:
    for note in track.notes:
        findings.add("warning", where, note)
    if imu.rate_hz is not None and abs(track.rate_hz / imu.rate_hz - 1) > 0.02:
        findings.add(
            "warning",
            where,
            f"samples come at {track.rate_hz:.1f} Hz, rate_hz says {imu.rate_hz:g}",
            "correct rate_hz, or remove it",
        )
    if track.rate_hz < 20:
        findings.add(
            "warning",
            where,
            f"samples come at {track.rate_hz:.1f} Hz",
            "record at 60 Hz or more; below 20 Hz fast motion is lost",
        )
    _check_gravity(where, imu, track, findings)


def _check_gravity(where: str, imu: ImuSettings, track: ImuTrack, findings: _Findings) -> None:
    """On average an accelerometer reads gravity, upwards in the world."""
    measured = np.isfinite(track.accel_m_s2).all(axis=1)
    if measured.sum() < 10:
        return
    world_from_imu = Rotation.from_quat(track.orientation_wxyz[measured][:, [1, 2, 3, 0]])
    force = np.median(world_from_imu.apply(track.accel_m_s2[measured]), axis=0)
    size = float(np.median(np.linalg.norm(track.accel_m_s2[measured], axis=1)))
    if abs(size - 1) < 0.3:
        findings.add(
            "error",
            where,
            f"the accelerometer reads {size:.2f} on average: it is in units of g",
            f"multiply by {GRAVITY_M_S2}; expected m/s2",
        )
    elif size < 4:
        findings.add(
            "error",
            where,
            f"the accelerometer reads {size:.1f} m/s2 on average: gravity has been removed",
            "export the raw acceleration (specific force)",
        )
    else:
        up = np.array([0.0, 1.0, 0.0] if imu.imu_up == "y" else [0.0, 0.0, 1.0])
        angle = np.degrees(np.arccos(np.clip(force @ up / np.linalg.norm(force), -1, 1)))
        if angle > 15:
            findings.add(
                "warning",
                where,
                f"gravity points {angle:.0f} deg away from the sensor world's {imu.imu_up} axis",
                "check imu_up, and that the quaternion is w, x, y, z from sensor to world",
            )


def _check_views(
    session: Session, rig: Rig | None, tracks: dict[str, KeypointTrack], findings: _Findings
) -> None:
    if rig is None or len(tracks) < 2:
        return
    rig, every = view_agreement.without_distortion(rig.subset(list(tracks)), list(tracks.values()))
    start = max(float(track.times_s[0]) for track in every)
    end = min(float(track.times_s[-1]) for track in every)
    if start >= end:
        return
    fastest_hz = max(track.rate_hz for track in every)
    count = int((end - start) * fastest_hz) + 1
    step = max(1, count // SAMPLED_INSTANTS)
    times_s = start + np.arange(0, count, step) / fastest_hz
    pairs = view_agreement.disagreement_px(rig, every, times_s)
    own = view_agreement.per_camera_px(pairs)
    single = False
    for index, camera in enumerate(rig.cameras):
        share = own[index] / np.hypot(*camera.size_px)
        others = np.delete(own, index)
        others = others[np.isfinite(others)]
        outstanding = len(others) > 0 and own[index] > 2 * np.median(others)
        if share > MAX_DISAGREEMENT_SHARE or (outstanding and share > NOTABLE_DISAGREEMENT_SHARE):
            _report_disagreement(rig, every, index, own[index], times_s, findings)
            single = True
    if not single:
        _check_looseness(rig, pairs, findings)
    _check_people(session, rig, every, times_s, findings)


def _check_looseness(rig: Rig, pairs_px: np.ndarray, findings: _Findings) -> None:
    """Pairs that all disagree a little: nobody stands out, but the calibration is poor."""
    shares = pairs_px / np.mean([np.hypot(*camera.size_px) for camera in rig.cameras])
    if not np.isfinite(shares).any() or np.nanmedian(shares) <= NOTABLE_DISAGREEMENT_SHARE:
        return
    i, j = np.unravel_index(np.nanargmax(shares), shares.shape)
    findings.add(
        "warning",
        "calibration",
        f"cameras disagree by a median of {np.nanmedian(pairs_px):.0f} px; worst are "
        f"'{rig.cameras[i].name}' and '{rig.cameras[j].name}' with {pairs_px[i, j]:.0f} px",
        "recalibrate the extrinsics, or check offset_s and rate_hz",
    )


def _report_disagreement(
    rig: Rig,
    tracks: Sequence[KeypointTrack],
    index: int,
    median_px: float,
    times_s: np.ndarray,
    findings: _Findings,
) -> None:
    frames = np.round(SHIFT_RANGE_S * tracks[index].rate_hz)
    shifts_s = np.arange(-frames, frames + 1, max(1, frames // 20)) / tracks[index].rate_hz
    shift_s, left_px = view_agreement.best_shift_s(rig, tracks, index, times_s[::3], shifts_s)
    remedy = "recalibrate it, or check its offset_s"
    if left_px < 0.5 * median_px:
        remedy = (
            f"add about {shift_s:+.2f} s to its offset_s: then {left_px:.0f} px are left; "
            "or recalibrate it"
        )
    findings.add(
        "warning",
        f"camera '{tracks[index].name}'",
        f"disagrees with the others: median {median_px:.0f} px",
        remedy,
    )


def _check_people(
    session: Session,
    rig: Rig,
    tracks: Sequence[KeypointTrack],
    times_s: np.ndarray,
    findings: _Findings,
) -> None:
    """Which way people stand, how tall they are, and where their feet are."""
    heads, feet = view_agreement.standing_people(rig, tracks, tracks[0].landmarks, times_s)
    if len(heads) < 5:
        return
    body = heads - feet
    # The tallest posture counts: some sit or crouch, and units are wrong by a factor.
    tall = float(np.percentile(np.linalg.norm(body, axis=1), 90))
    direction = np.median(body / np.linalg.norm(body, axis=1, keepdims=True), axis=0)
    direction /= np.linalg.norm(direction)
    if direction[1] < np.cos(np.radians(45)):
        in_file = Y_UP_FROM[session.settings.up].T @ direction
        axis = max(Y_UP_FROM, key=lambda up: float(in_file @ Y_UP_FROM[up].T @ [0.0, 1.0, 0.0]))
        angle = np.degrees(np.arccos(np.clip(direction[1], -1, 1)))
        findings.add(
            "warning",
            "calibration",
            f"people stand {angle:.0f} deg away from up",
            f'set up = "{axis}" under [session]'
            if axis != session.settings.up
            else "rotate the calibration's world so that an axis points up",
        )
        return
    low, high = PEOPLE_HEIGHT_M
    if not low <= tall <= high:
        findings.add(
            "warning",
            "calibration",
            f"people measure {tall:.2f} m from ankle to head",
            "the calibration is not in metres: scale its translations",
        )
        return
    ankle_m = float(np.median(feet[:, 1]))
    if session.settings.floor and not -0.15 <= ankle_m <= 0.35:
        findings.add(
            "warning",
            "calibration",
            f"ankles are {ankle_m:+.2f} m from the floor (y = 0)",
            "move the origin to the floor, or set floor = false",
        )
