"""Keypoints: order, resolution, coverage, length."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.findings import Findings
from fusecap.geometry.camera import Camera, Rig
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import Session

LOW_COVERAGE = 0.1
MOST_COUNTED = 3000
"""Frames, evenly, that say how often a camera sees anybody."""
_UNSEEN = 0.02
UNMEASURED = "what these limbs do is a guess"
"""By which the note of such limbs is known."""
_ENDS = {"elbow": "upper_arm", "wrist": "forearm", "knee": "thigh", "ankle": "shank"}
"""Landmarks without which nothing tells of a bone, unless a sensor does."""


def check_keypoints(
    session: Session, tracks: Mapping[str, KeypointTrack], rig: Rig | None, findings: Findings
) -> None:
    """Of every camera that could be read, and of all together."""
    _check_limbs_seen(session, [*tracks.values()], findings)
    for name, track in tracks.items():
        _check_coverage(track, findings)
        _check_order(track, findings)
        if rig is not None:
            _check_inside(track, rig[name], findings)


def _check_coverage(track: KeypointTrack, findings: Findings) -> None:
    spanned = int(track.frames[-1] - track.frames[0]) + 1
    some = track.people[:: -(-len(track.people) // MOST_COUNTED)]
    share = np.mean([len(people) > 0 for people in some]) * len(track.people) / spanned
    if share < LOW_COVERAGE:
        findings.add(
            "warning",
            f"camera '{track.name}'",
            f"sees people in {share:.1%} of its {spanned} frames",
            "check the detector's output of this camera, or leave the camera out",
        )


def _check_limbs_seen(
    session: Session, tracks: Sequence[KeypointTrack], findings: Findings
) -> None:
    """Legs behind tables: what they do is the prior's guess."""
    found = [_all_people(track)[:, :, :2] for track in tracks]
    if not sum(map(len, found)):
        return
    worn = [{imu.bone for imu in subject.imus} for subject in session.subjects]
    landmarks = tracks[0].landmarks
    seen = np.isfinite(np.concatenate(found)).all(axis=2).mean(axis=0)
    unseen = [
        f"{side}_{end}"
        for end, bone in _ENDS.items()
        for side in ("left", "right")
        if (index := landmarks.index(f"{side}_{end}")) is not None
        and seen[index] < _UNSEEN
        and not (worn and all(f"{side}_{bone}" in bones for bones in worn))
    ]
    if unseen:
        findings.add(
            "warning",
            "cameras",
            f"none sees {', '.join(unseen)} of anybody",
            "what these limbs do is a guess, and its error bars are too narrow: leave their angles "
            "out, or let cameras see them or sensors be worn there",
        )


def _check_inside(track: KeypointTrack, camera: Camera, findings: Findings) -> None:
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


def _check_order(track: KeypointTrack, findings: Findings) -> None:
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


def check_lengths(tracks: Mapping[str, KeypointTrack], findings: Findings) -> None:
    """Cameras that begin or end apart."""
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
