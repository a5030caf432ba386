"""Shelf and Campus (TU Munich): several people, occlusion, 3D PCP.

    FOLDER/calibs/<camera>.json          Shelf as `fusecap solve` reads it: K, RT, imgSize
      or   calibration_<name>.json       x_cam = R (X - T), T in mm; the VoxelPose layout
    FOLDER/<camera>/*_keypoints.json     OpenPose BODY_25, a folder per camera
      or   openpose_body25.tar.xz        the same, packed
    FOLDER/gt_*.txt                      15 joints per actor [m]
      or   actorsGT.mat                  actor3D {actor} {frame} 14 x 3 [m]

Both worlds are z up; both are filmed at 25 Hz. Image sizes are not in the VoxelPose layout: 1032 x
776 for Shelf's 5 cameras, 360 x 288 for Campus' 3. The truth in `.mat` lacks the mid-hip, which is
midway between the hips.

Ten limbs count; a limb is correct when its two end
errors add up to less than its length, and an actor who was not found has ten wrong limbs. Actors
0-2 are scored, each over the frames that show it, and the result is the mean over actors.

Limb joints are our joints. Shelf's two head points follow the world and not the head bone; by the
rule of 4D association (Zhang et al. 2020) the chin lies midway between the shoulder centre and the
ear centre, and the head top 0.125 m in front of it and 0.145 m above, where "in front" is normal to
the triangle of the shoulders and the hip centre.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from fusecap.believable import MOST_PEOPLE
from fusecap.body.landmarks import LANDMARKS, landmark_set_named
from fusecap.errors import InputError
from fusecap.evaluate.datasets.files import camera_at_centre, floats, text_of, unpacked
from fusecap.evaluate.datasets.matlab import Cells, read_cells
from fusecap.evaluate.datasets.recording import DatasetSequence, last_frame, read_views
from fusecap.evaluate.metrics import correct_limbs, identity_switches, match_people
from fusecap.evaluate.tables import Table
from fusecap.geometry.camera import Y_UP_FROM_Z_UP, Rig
from fusecap.sources.calibration_files import fields, load_rig
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

LANDMARK_SET = "body25"
SIZES_PX = {5: (1032, 776), 3: (360, 288)}
"""By number of cameras: Shelf, Campus."""
_PACKED = "openpose_body25.tar.xz"


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


def load_shelf(folder: Path | str) -> DatasetSequence:
    """The sequence in a folder; raises `InputError`. Its truth is `load_shelf_truth`."""
    folder = Path(folder)
    rig = read_rig(folder)
    landmarks = landmark_set_named(LANDMARK_SET)
    packed = folder / _PACKED
    loose = all((folder / name).is_dir() for name in rig.names)
    with nullcontext(folder) if loose or not packed.is_file() else unpacked(packed) as root:
        views = read_views({name: root / name for name in rig.names}, landmarks, RATE_HZ)
    return DatasetSequence(
        name="campus" if len(rig) == 3 else "shelf",
        rate_hz=RATE_HZ,
        frames=last_frame(views),
        rig=rig,
        landmarks=landmarks,
        views=views,
    )


def read_rig(folder: Path) -> Rig:
    """The cameras in our world; raises `CalibrationError`."""
    if (folder / "calibs").is_dir():
        return load_rig(folder / "calibs", up="z")
    found = sorted(folder.glob("calibration*.json"))
    if len(found) != 1:
        raise InputError(
            f"{folder}: holds {len(found)} calibrations; expected calibs/<camera>.json or one "
            "calibration_<name>.json"
        )
    return read_voxelpose_rig(found[0])


def read_voxelpose_rig(path: Path) -> Rig:
    """`{"0": {R, T (camera centre, mm), fx, fy, cx, cy, k, p}, ...}` in our world."""
    data = fields.json_object(path)
    size_px = SIZES_PX.get(len(data))
    if size_px is None:
        raise InputError(f"{path}: {len(data)} cameras; expected Shelf's 5 or Campus' 3")
    cameras = []
    for name, entry in data.items():
        where = f"{path}: camera '{name}'"

        def numbers(key: str, *shape: int, entry: Any = entry, where: str = where) -> np.ndarray:
            if not isinstance(entry, dict) or key not in entry:
                raise InputError(f"{where} has no {key}; expected R, T, fx, fy, cx, cy, k, p")
            return fields.numbers(entry[key], shape, f"{where} {key}")

        cameras.append(
            camera_at_centre(
                path,
                name=name,
                size_px=size_px,
                focal_px=np.array([numbers("fx", 1)[0], numbers("fy", 1)[0]]),
                centre_px=np.array([numbers("cx", 1)[0], numbers("cy", 1)[0]]),
                radial=numbers("k", 3),
                tangential=numbers("p", 2),
                rotation=numbers("R", 3, 3),
                position_m=numbers("T", 3) / 1000.0,
            )
        )
    return Rig(cameras=tuple(cameras)).in_world(Y_UP_FROM_Z_UP)


def load_shelf_truth(folder: Path | str) -> ShelfTruth:
    """The joints in a folder, from its `.mat` or its text; raises `InputError`."""
    folder = Path(folder)
    texts = sorted(folder.glob("gt_*.txt"))
    matlab = sorted(folder.glob("*actorsGT*.mat"))
    if len(texts) == 1:
        return load_truth(texts[0])
    if len(matlab) == 1:
        return read_actors(matlab[0])
    raise InputError(
        f"{folder}: {len(texts)} gt_*.txt and {len(matlab)} actorsGT.mat; expected one truth file"
    )


def load_truth(path: Path | str) -> ShelfTruth:
    """Read `gt_*.txt`; raises `InputError` where it ends early or holds something else."""
    path = Path(path)
    words = text_of(path, "Shelf truth").split()
    try:
        values = iter(floats(words, str(path)).tolist())
        joints, frames = int(next(values)), int(next(values))
        if joints != 15:
            raise InputError(f"{path}: {joints} joints, expected Shelf's 15")
        people: list[dict[int, np.ndarray]] = []
        for _ in range(_natural(frames)):
            people.append({})
            for _ in range(_natural(int(next(values)))):
                actor = _natural(int(next(values)))
                if actor >= MOST_PEOPLE:
                    raise InputError(f"{path}: actor {actor}, expected under {MOST_PEOPLE}")
                rows = np.array([next(values) for _ in range(4 * joints)]).reshape(4, joints)
                people[-1][actor] = np.where(rows[3, :, None] > 0, rows[:3].T, np.nan)
    except (StopIteration, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not Shelf truth, or is cut short") from error
    count = 1 + max((actor for frame in people for actor in frame), default=-1)
    points = np.full((count, frames, joints, 3), np.nan)
    for frame, actors in enumerate(people):
        for actor, rows in actors.items():
            points[actor, frame] = rows @ Y_UP_FROM_Z_UP.T
    return ShelfTruth(points_in_world_m=points)


def _natural(number: int) -> int:
    if number < 0:
        raise ValueError(f"{number} of something")
    return number


def read_actors(path: Path) -> ShelfTruth:
    """`actor3D` of an `actorsGT.mat`; an actor without joints in a frame is not there."""
    actors = [_opened(actor) for actor in _opened(read_cells(path, "actor3D"))]
    frames = max((len(actor) for actor in actors), default=0)
    points = np.full((len(actors), frames, 15, 3), np.nan)
    for row, actor in enumerate(actors):
        for frame, cell in enumerate(actor):
            joints = _opened(cell)[0]
            if isinstance(joints, np.ndarray) and joints.shape == (14, 3):
                points[row, frame, :14] = joints @ Y_UP_FROM_Z_UP.T
            elif not isinstance(joints, np.ndarray) or joints.size > 1:
                found = len(joints) if isinstance(joints, list) else joints.shape
                raise InputError(
                    f"{path}: actor {row} frame {frame} has joints {found}, expected 14 x 3"
                )
    points[:, :, MID_HIP] = (points[:, :, 2] + points[:, :, 3]) / 2
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


def pcp_table(name: str, score: ShelfScore) -> Table:
    """3D PCP per actor and per kind of limb."""
    rows = [(f"actor {actor}", pcp) for actor, pcp in score.actor_pcp.items()]
    rows += [*score.limb_pcp.items(), ("mean over actors", score.pcp)]
    return Table(
        title=f"{name.capitalize()}: 3D PCP",
        columns=("of", "PCP %"),
        rows=tuple(rows),
        digits=2,
        note=f"{score.person_frames} person-frames, {score.missed_person_frames} of them missed, "
        f"{score.identity_switches} identity switches",
    )


def _opened(cells: Cells) -> list[Cells]:
    """The cells, of cells that hold a single cell; a matrix of one frame is itself the only one."""
    while isinstance(cells, list) and len(cells) == 1:
        cells = cells[0]
    return cells if isinstance(cells, list) else [cells]
