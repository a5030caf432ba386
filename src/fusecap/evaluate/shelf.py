"""The Shelf sequence (TU Munich): its truth, and 3D PCP by the rules of the literature.

Truth is z up, metres, 15 joints per actor. Ten limbs count; a limb is correct when its two end
errors add up to less than its length, and an actor who was not found has ten wrong limbs. Actors
0-2 are scored, each over the frames that show it, and the result is the mean over actors.

Limb joints are our joints. Shelf's two head points follow the world and not the head bone; by the
rule of 4D association (Zhang et al. 2020) the chin lies midway between the shoulder centre and the
ear centre, and the head top 0.125 m in front of it and 0.145 m above, where "in front" is normal to
the triangle of the shoulders and the hip centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from fusecap.body.landmarks import LANDMARKS
from fusecap.errors import InputError
from fusecap.evaluate.metrics import correct_limbs, identity_switches, match_people
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.take import Take

RATE_HZ = 25.0
ACTORS = (0, 1, 2)
"""Those scored in the literature."""

JOINTS = (
    "right_foot",
    "right_shank",
    "right_thigh",
    "left_thigh",
    "left_shank",
    "left_foot",
    "right_hand",
    "right_forearm",
    "right_upper_arm",
    "left_upper_arm",
    "left_forearm",
    "left_hand",
)
"""Our bone at whose joint each of Shelf's joints 0-11 lies; 12 chin, 13 head top, 14 mid-hip."""

CHIN, HEAD_TOP, MID_HIP = 12, 13, 14
LIMBS: dict[str, tuple[tuple[int, int], ...]] = {
    "upper arms": ((9, 10), (8, 7)),
    "lower arms": ((10, 11), (7, 6)),
    "upper legs": ((3, 4), (2, 1)),
    "lower legs": ((4, 5), (1, 0)),
    "head": ((12, 13),),
    "torso": ((12, 14),),
}
_LIMBS = np.array([limb for group in LIMBS.values() for limb in group])
_HEAD_FORWARD_M, _HEAD_UP_M = 0.125, 0.145


@dataclass(frozen=True, kw_only=True)
class ShelfTruth:
    """Joints of actors 0..A-1 over T frames, in our world; NaN where there is no valid truth."""

    points_in_world_m: Float[np.ndarray, "a t 15 3"]


@dataclass(frozen=True, kw_only=True)
class ShelfScore:
    """3D PCP in percent."""

    pcp: float
    """Mean over the actors present."""
    actor_pcp: dict[int, float]
    limb_pcp: dict[str, float]
    """Per kind of limb, over all person-frames."""
    person_frames: int
    missed_person_frames: int
    """No estimate was left for the actor, or the nearest was farther away than half a metre."""
    identity_switches: int


def load_truth(path: Path | str) -> ShelfTruth:
    """Read `gt_*.txt`; raises `InputError` where it ends early or holds something else."""
    path = Path(path)
    try:
        words = path.read_text().split()
    except OSError as error:
        raise InputError(f"cannot read Shelf truth {path}: {error.strerror}") from error
    try:
        values = iter([float(word) for word in words])
        joints, frames = int(next(values)), int(next(values))
        if joints != 15:
            raise InputError(f"{path}: {joints} joints, expected Shelf's 15")
        people: list[dict[int, np.ndarray]] = []
        for _ in range(frames):
            people.append({})
            for _ in range(int(next(values))):
                actor = int(next(values))
                rows = np.array([next(values) for _ in range(4 * joints)]).reshape(4, joints)
                people[-1][actor] = np.where(rows[3, :, None] > 0, rows[:3].T, np.nan)
    except (StopIteration, ValueError) as error:
        raise InputError(f"{path} is not Shelf truth, or is cut short") from error
    count = 1 + max((actor for frame in people for actor in frame), default=-1)
    points = np.full((count, frames, joints, 3), np.nan)
    for frame, actors in enumerate(people):
        for actor, rows in actors.items():
            points[actor, frame] = rows @ Y_UP_FROM_Z_UP.T
    return ShelfTruth(points_in_world_m=points)


def shelf_points(take: Take) -> Float[np.ndarray, "s t 15 3"]:
    """The take's people as Shelf sees them, in our world; NaN where untracked."""
    bone = take.skeleton.bone
    position = take.bone_position_in_world_m
    points = np.full((*position.shape[:2], 15, 3), np.nan)
    points[:, :, : len(JOINTS)] = position[:, :, [bone(name) for name in JOINTS]]
    hips = (points[:, :, 2] + points[:, :, 3]) / 2
    right_shoulder, left_shoulder = points[:, :, 8], points[:, :, 9]
    forward = np.cross(left_shoulder - hips, right_shoulder - hips)
    forward /= np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-9)
    chin = ((left_shoulder + right_shoulder) / 2 + _ear_centre(take)) / 2
    points[:, :, CHIN] = chin
    points[:, :, HEAD_TOP] = chin + _HEAD_FORWARD_M * forward + [0.0, _HEAD_UP_M, 0.0]
    points[:, :, MID_HIP] = hips
    return points


def _ear_centre(take: Take) -> Float[np.ndarray, "s t 3"]:
    """Between the ears, where the default landmarks put them on the head bone [m]."""
    head = take.skeleton.bone("head")
    ears = np.array([LANDMARKS["left_ear"][1], LANDMARKS["right_ear"][1]]).mean(axis=0)
    centre = take.bone_position_in_world_m[:, :, head].copy()
    for subject, height_m in enumerate(take.heights_m):
        centre[subject] += take.bone_rotation_in_world(subject)[:, head] @ (ears * height_m)
    return centre


def frame_numbers(take: Take) -> Int[np.ndarray, " t"]:
    """Shelf frame shown by each frame of the take: time 0 is frame 0, at 25 Hz."""
    return np.round(take.timestamps_ns * 1e-9 * RATE_HZ).astype(np.int64)


def score_shelf(take: Take, truth_path: Path | str) -> ShelfScore:
    """`score_people` against a truth file."""
    return score_people(take, load_truth(truth_path))


def score_people(take: Take, shelf_truth: ShelfTruth) -> ShelfScore:
    """Score `take` on every frame that has truth; people are matched one to one, frame by frame."""
    truth = shelf_truth.points_in_world_m
    actors = [actor for actor in ACTORS if actor < len(truth)]
    truth = truth[actors]
    estimate = np.full((len(take.subject_names), *truth.shape[1:]), np.nan)
    numbers = frame_numbers(take)
    known = (numbers >= 0) & (numbers < truth.shape[1])
    estimate[:, numbers[known]] = shelf_points(take)[:, known]

    match = match_people(estimate, truth, gate_m=np.inf)
    actor, frame = np.nonzero(match >= 0)
    matched = np.full_like(truth, np.nan)
    matched[actor, frame] = estimate[match[actor, frame], frame]
    correct = correct_limbs(matched, truth, _LIMBS)
    scored = np.isfinite(truth[:, :, _LIMBS].sum(axis=(-2, -1)))
    near = match_people(estimate, truth)
    present = scored.any(axis=-1)
    actor_pcp = {
        actors[row]: 100.0 * float(correct[row][scored[row]].mean())
        for row in range(len(actors))
        if scored[row].any()
    }
    return ShelfScore(
        pcp=float(np.mean(list(actor_pcp.values()))) if actor_pcp else np.nan,
        actor_pcp=actor_pcp,
        limb_pcp=_per_kind(correct, scored),
        person_frames=int(present.sum()),
        missed_person_frames=int((present & (near < 0)).sum()),
        identity_switches=identity_switches(near),
    )


def _per_kind(correct: np.ndarray, scored: np.ndarray) -> dict[str, float]:
    result, first = {}, 0
    for kind, limbs in LIMBS.items():
        columns = slice(first, first + len(limbs))
        counted = scored[..., columns]
        result[kind] = (
            100.0 * float(correct[..., columns][counted].mean()) if counted.any() else np.nan
        )
        first += len(limbs)
    return result
