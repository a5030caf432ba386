"""All checks of opened inputs, in the order in which their findings are told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fusecap.checks.imus import check_imus
from fusecap.checks.joints import check_joints
from fusecap.checks.keypoints import check_keypoints, check_lengths
from fusecap.checks.limbs import check_limbs
from fusecap.checks.people import check_people
from fusecap.checks.sizes import check_sizes
from fusecap.checks.views import ComparedViews, check_views
from fusecap.checks.wearers import wearers
from fusecap.findings import Findings
from fusecap.geometry.camera import Rig
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import Session
from fusecap.sources.session_cameras import rate_is_stated

SHORT_S = 0.5
"""A person is followed for about as long before becoming a subject."""


def check_measurements(
    session: Session,
    rig: Rig | None,
    keypoints: Sequence[KeypointTrack],
    imus: Mapping[str, Sequence[ImuTrack | None]],
    times_s: np.ndarray | None,
) -> Findings:
    """What is wrong or odd about a session's inputs on its clock, as far as they could be opened.

    `imus` are each subject's sensors in the session's order, `times_s` the instants of the solve.
    """
    findings = Findings()
    tracks = {track.name: track for track in keypoints}
    _check_rate(session, findings)
    check_lengths(tracks, findings)
    _check_amount(session, tracks, findings)
    if times_s is not None:
        _check_length(times_s, findings)
    check_motion(session, rig, keypoints, imus, findings)
    return findings


def check_motion(
    session: Session,
    rig: Rig | None,
    keypoints: Sequence[KeypointTrack],
    imus: Mapping[str, Sequence[ImuTrack | None]],
    findings: Findings,
) -> None:
    """What cameras and sensors say of people, whether from files or as a live run took it."""
    check_keypoints(session, {track.name: track for track in keypoints}, rig, findings)
    check_imus(session, imus, findings)
    views = None if rig is None else ComparedViews.of(rig, keypoints)
    told = {finding.where for finding in findings}
    if views is not None:
        check_views(views, findings)
        check_people(session, views, findings)
        worn = wearers(session, views, imus)
        check_sizes(session, views, worn, findings)
        told |= check_limbs(worn, findings)
    check_joints(session, imus, told, findings)


def _check_rate(session: Session, findings: Findings) -> None:
    if session.cameras and not rate_is_stated(session):
        findings.add(
            "warning",
            "session",
            f"states no rate_hz, and no video does: {session.settings.rate_hz:g} Hz is assumed",
            "write rate_hz under [session] as the cameras recorded: times and speeds are wrong by "
            "as much as it is",
        )


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


def _check_amount(
    session: Session, tracks: Mapping[str, KeypointTrack], findings: Findings
) -> None:
    with_imus = any(subject.imus for subject in session.subjects)
    seen = any(len(people) for track in tracks.values() for people in track.people)
    if tracks and not seen:
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
