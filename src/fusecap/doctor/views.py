"""Whether the cameras agree about the people in front of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusecap.findings import Findings
from fusecap.geometry.camera import Rig
from fusecap.sources import view_agreement
from fusecap.sources.calibration_files.loader import Y_UP_FROM
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import Session

SAMPLED_INSTANTS = 60
MAX_DISAGREEMENT_SHARE = 0.01
"""Of the image's diagonal: 22 px of a 1920 x 1080 image."""
NOTABLE_DISAGREEMENT_SHARE = 0.005
"""The same of a camera that disagrees twice as much as the others, and of a typical pair."""
SHIFT_RANGE_S = 1.0
PEOPLE_HEIGHT_M = (0.7, 2.2)
"""From ankle to nose, standing or bent."""


def check_views(
    session: Session, rig: Rig | None, tracks: dict[str, KeypointTrack], findings: Findings
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


def _check_looseness(rig: Rig, pairs_px: np.ndarray, findings: Findings) -> None:
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
        "fusecap calibrate sync where clocks may differ; else fusecap calibrate extrinsics "
        "--from-people, which needs no board",
    )


def _report_disagreement(
    rig: Rig,
    tracks: Sequence[KeypointTrack],
    index: int,
    median_px: float,
    times_s: np.ndarray,
    findings: Findings,
) -> None:
    frames = np.round(SHIFT_RANGE_S * tracks[index].rate_hz)
    shifts_s = np.arange(-frames, frames + 1, max(1, frames // 20)) / tracks[index].rate_hz
    shift_s, left_px = view_agreement.best_shift_s(rig, tracks, index, times_s[::3], shifts_s)
    remedy = (
        "if it was moved: fusecap calibrate extrinsics, --from-people without a board; "
        "if its clock is off: fusecap calibrate sync"
    )
    if left_px < 0.5 * median_px:
        remedy = (
            f"add about {shift_s:+.2f} s to its offset_s: then {left_px:.0f} px are left; "
            "fusecap calibrate sync finds it exactly"
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
    findings: Findings,
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
            else "fusecap calibrate world turns the calibration so that y points up",
        )
        return
    low, high = PEOPLE_HEIGHT_M
    if not low <= tall <= high:
        findings.add(
            "warning",
            "calibration",
            f"people measure {tall:.2f} m from ankle to head",
            "the calibration is not in metres: fusecap calibrate world scales it",
        )
        return
    ankle_m = float(np.median(feet[:, 1]))
    if session.settings.floor and not -0.15 <= ankle_m <= 0.35:
        findings.add(
            "warning",
            "calibration",
            f"ankles are {ankle_m:+.2f} m from the floor (y = 0)",
            "fusecap calibrate world moves the origin to the floor; or set floor = false",
        )
