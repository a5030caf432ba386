"""Whether people triangulated from pairs of views are such as people are.

They stand upright unless cameras say that they do not: a world that lies on its side lets cameras
lie too, a handstand does not. Their limbs tell their stature in any posture, and a stature that
nobody has, or not the one stated, is the calibration's scale. Noses point where the chest does.
"""

from __future__ import annotations

import numpy as np

from fusecap.body.landmarks import LANDMARKS, LandmarkSet
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.checks.views import ComparedViews
from fusecap.findings import Findings
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files.loader import Y_UP_FROM
from fusecap.sources.session import Session, SubjectSettings

STATURES_M = (0.55, 2.45)
"""Of people from 0.6 to 2.3 m, with what limbs vary at the same stature."""
STATED_TOLERANCE = 0.15
"""Limbs of equally tall people differ by less; a calibration that is 1.2 or 0.8 times too large
differs by more."""
NEAR_SHARE = 0.3
"""Of people as tall as stated: with so many a scale is right, and others are somebody else."""
MOST_MEASURED = 2000
"""One by one; 64 cameras give twenty times as many."""
TILTED = np.cos(np.radians(45))
WITH_CAMERAS = 0.5
"""Cosine of people to the tops of pictures: who lies below cameras at the ceiling lies anyhow."""
ANKLE_M, FLOOR_TOLERANCE_M = 0.09, 0.16
"""The lower one of who stands or walks, and how far off a floor may be that is called one."""
LEAST_PEOPLE = 5
LEAST_FACES = 20
BACKWARDS_SHARE = 0.8
LIMBS = (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))


def check_people(session: Session, views: ComparedViews, findings: Findings) -> None:
    """Which way people stand, how tall they are, where their feet are, where they look."""
    landmarks = views.tracks[0].landmarks
    people = np.concatenate(views.people)
    if len(people) < LEAST_PEOPLE:
        return
    _check_sides(people, landmarks, findings)
    _check_stature(session, people, landmarks, findings)
    _check_upright(session, views.rig, people, landmarks, findings)


def _check_upright(
    session: Session, rig: Rig, people: np.ndarray, landmarks: LandmarkSet, findings: Findings
) -> None:
    top = next(i for n in ("nose", "head_top", "neck") if (i := landmarks.index(n)) is not None)
    left, right = landmarks.index("left_ankle"), landmarks.index("right_ankle")
    if left is None or right is None:
        return
    lower_m = np.minimum(people[:, left, 1], people[:, right, 1])
    feet = (people[:, left] + people[:, right]) / 2
    body = people[:, top] - feet
    whole = np.isfinite(body).all(axis=1)
    if np.count_nonzero(whole) < LEAST_PEOPLE:
        return
    body, lower_m = body[whole], lower_m[whole]
    direction = np.median(body / np.linalg.norm(body, axis=1, keepdims=True), axis=0)
    direction /= max(float(np.linalg.norm(direction)), 1e-9)
    if direction[1] < TILTED:
        up = _cameras_up(rig)
        if up[1] < TILTED and direction @ up > WITH_CAMERAS:
            _add_tilted(session, direction, findings)
        return
    ankle_m = float(np.median(lower_m))
    if session.settings.floor and abs(ankle_m - ANKLE_M) > FLOOR_TOLERANCE_M:
        findings.add(
            "warning",
            "calibration",
            f"lower ankles are {ankle_m:+.2f} m from the floor (y = 0)",
            "fusecap calibrate world moves the origin to the floor; or set floor = false",
        )


def _cameras_up(rig: Rig) -> np.ndarray:
    """(3,) where the tops of the pictures are, on average; short where cameras do not agree."""
    return np.mean([-camera.rotation[1] for camera in rig.cameras], axis=0)


def _add_tilted(session: Session, direction: np.ndarray, findings: Findings) -> None:
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


def _check_stature(
    session: Session, people: np.ndarray, landmarks: LandmarkSet, findings: Findings
) -> None:
    seen_m = stature_m(people, landmarks)
    if not np.isfinite(seen_m):
        return
    stated = [m for m in map(stated_stature_m, session.subjects) if m is not None]
    if not STATURES_M[0] <= seen_m <= STATURES_M[1]:
        findings.add(
            "warning",
            "calibration",
            f"people are {seen_m:.2f} m tall, as their limbs measure",
            "the calibration is not in metres: fusecap calibrate world scales it",
        )
    elif stated and len(stated) == len(session.subjects):
        nearest_m = min(stated, key=lambda m: abs(np.log(seen_m / m)))
        factor = seen_m / nearest_m
        off = abs(factor - 1) > STATED_TOLERANCE
        if off and _share_near(people, landmarks, stated) < NEAR_SHARE:
            findings.add(
                "warning",
                "calibration",
                f"limbs measure as of people {seen_m:.2f} m tall, the session states "
                f"{nearest_m:.2f} m",
                f"height_m or bone lengths are wrong, or the calibration is {factor:.2f} times too "
                "large: fusecap calibrate world scales it",
            )


def _share_near(people: np.ndarray, landmarks: LandmarkSet, stated: list[float]) -> float:
    """Of people at an instant, how many are about as tall as somebody is stated to be."""
    some = people[:: -(-len(people) // MOST_MEASURED)]
    each_m = np.array([stature_m(one[None], landmarks, least=1) for one in some])
    each_m = each_m[np.isfinite(each_m), None]
    off = np.abs(each_m / np.array(stated) - 1.0).min(axis=1)
    return float((off <= STATED_TOLERANCE).mean()) if len(off) else 0.0


def stature_m(people: np.ndarray, landmarks: LandmarkSet, least: int = LEAST_PEOPLE) -> float:
    """Median over limbs of the stature that they have in the reference proportions."""
    unit = _unit_lengths()
    found = []
    for limb in LIMBS:
        lengths = []
        for side in ("left", "right"):
            a, b = (landmarks.index(f"{side}_{end}") for end in limb)
            if a is not None and b is not None:
                lengths.append(np.linalg.norm(people[:, a] - people[:, b], axis=1))
        known = np.concatenate(lengths) if lengths else np.empty(0)
        known = known[np.isfinite(known)]
        if len(known) >= least:
            found.append(float(np.median(known)) / unit[limb])
    return float(np.median(found)) if found else float("nan")


def _unit_lengths() -> dict[tuple[str, str], float]:
    """Of a body of one metre."""
    shape = BodyShape.from_height(PAPER21, 1.0)
    return {limb: float(np.linalg.norm(shape.offsets_m[_bone(limb[1])])) for limb in LIMBS}


def _bone(landmark: str) -> int:
    return PAPER21.bone(LANDMARKS[f"left_{landmark}"][0])


def stated_stature_m(subject: SubjectSettings) -> float | None:
    if subject.height_m is not None:
        return subject.height_m
    unit = _unit_lengths()
    ratios = [
        subject.bone_lengths_m[name] / length
        for limb, length in unit.items()
        for side in ("left", "right")
        if (name := LANDMARKS[f"{side}_{limb[1]}"][0]) in subject.bone_lengths_m
    ]
    return float(np.median(ratios)) if ratios else None


def _check_sides(people: np.ndarray, landmarks: LandmarkSet, findings: Findings) -> None:
    """The nose lies before the ears, where before is left cross up of the trunk."""
    names = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
    trunk = [landmarks.index(name) for name in names]
    face = [landmarks.index(name) for name in ("nose", "left_ear", "right_ear")]
    if None in trunk or None in face:
        return
    left_shoulder, right_shoulder, left_hip, right_hip = (people[:, i] for i in trunk)
    nose, left_ear, right_ear = (people[:, i] for i in face)
    left = left_shoulder - right_shoulder + left_hip - right_hip
    up = left_shoulder + right_shoulder - left_hip - right_hip
    ahead = np.sum(np.cross(left, up) * (nose - (left_ear + right_ear) / 2), axis=1)
    ahead = ahead[np.isfinite(ahead)]
    if len(ahead) >= LEAST_FACES and np.mean(ahead < 0) > BACKWARDS_SHARE:
        findings.add(
            "warning",
            "cameras",
            f"left and right are exchanged in all views: {np.mean(ahead < 0):.0%} of the people "
            "look backwards",
            "pictures are mirrored, or the detector takes left for right: mend them and detect "
            "again",
        )
