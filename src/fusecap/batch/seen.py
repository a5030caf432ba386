"""Who of a take was seen when, and by what: its poses beside the inputs that they were solved from.

The poses are projected into every camera and paired anew with the people detected there, so it
holds for takes that were edited and for recordings as well: a pair is what lies together, whatever
the solve thought. Detections that belong to nobody of the take are counted as others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from fusecap.batch.solve import Instants
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import landmarks_in_world
from fusecap.errors import TakeError
from fusecap.exports.take_format import AnyTake
from fusecap.geometry.camera import Camera
from fusecap.geometry.quaternions import from_wxyz
from fusecap.geometry.same_people import same_people
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.take import Take
from fusecap.types import Detections, ImuReading

GATE_EXTENTS = 0.15
"""Mean distance of keypoints, as a share of a person's extent in the picture, up to which a
detection is a pose's."""
MOST_INSTANTS = 6000
"""Of longer takes every second, third, ... instant is looked at."""


@dataclass(frozen=True, kw_only=True)
class SensorSeen:
    """One sensor against the pose of its bone."""

    subject: str
    bone: str
    off_deg: Float[np.ndarray, " n"]
    """NaN where it did not measure or the subject was not tracked."""


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What inputs say at N frames of a take of S subjects, by C cameras."""

    frames: Int[np.ndarray, " n"]
    every: int
    """So many instants of the inputs lie between two that were looked at."""
    cameras: tuple[str, ...]
    keypoints: Int[np.ndarray, "s c n"]
    """How many of the subject's a camera found; 0: not seen."""
    residual_px: Float[np.ndarray, "s c n"]
    """Median distance of those from the pose's image; NaN where not seen."""
    others: Int[np.ndarray, "c n"]
    """Detections that are nobody of the take: bystanders, ghosts, people not followed."""
    reprojection_px: dict[str, dict[str, float]]
    """Per camera over all keypoints: median, p90, keypoints."""
    sensors: tuple[SensorSeen, ...]


def look_back(
    take: AnyTake,
    setup: Setup,
    instants: Instants,
    progress: Progress | None = None,
) -> Seen:
    """Pairs a take with inputs on the same clock; raises `TakeError` where they share no instant.

    Also where the take has another skeleton than the inputs' session asks for.
    """
    if take.skeleton.bone_names != setup.skeleton.bone_names:
        raise TakeError(
            f"the take has skeleton '{take.skeleton.name}', its session asks for "
            f"'{setup.skeleton.name}'; solve it again"
        )
    every = max(1, -(-len(instants) // MOST_INSTANTS))
    looked = range(0, len(instants), every)
    found: list[Detections] = []
    readings: list[Mapping[str, ImuReading]] = []
    for instant in looked:
        found.append(instants.detections(instant))
        readings.append(instants.readings(instant))
        if progress is not None:
            progress("reading what was measured", len(found), len(looked))
    times_ns = np.array([each.timestamp_ns for each in found], dtype=np.int64)
    rows = frames_at(take, times_ns)
    kept = np.flatnonzero(rows >= 0)
    if not len(kept):
        raise TakeError("the take and its session share no instant; are they of one recording?")
    frames = rows[kept]
    known, at = np.unique(frames, return_inverse=True)
    part = take.at_frames(known)
    people, cameras = len(take.subject_names), setup.rig.cameras
    pixels = posed_keypoints(part, setup.landmarks, cameras, at)
    keypoints = np.zeros((people, len(cameras), len(frames)), dtype=np.int64)
    residual_px = np.full(keypoints.shape, np.nan)
    others = np.zeros((len(cameras), len(frames)), dtype=np.int64)
    spread: list[list[np.ndarray]] = [[] for _ in cameras]
    for column, instant in enumerate(kept):
        for row in range(len(cameras)):
            detected = found[instant].people[row]
            there = pixels[row, :, column]
            subjects, persons = paired(there, detected)
            others[row, column] = len(detected) - len(persons)
            for subject, person in zip(subjects, persons, strict=True):
                away = np.linalg.norm(there[subject, :, :2] - detected[person][:, :2], axis=1)
                away = away[np.isfinite(away) & (detected[person][:, 2] > 0)]
                if len(away):
                    keypoints[subject, row, column] = len(away)
                    residual_px[subject, row, column] = np.median(away)
                    spread[row].append(away)
        if progress is not None:
            progress("looking back", column + 1, len(kept))
    return Seen(
        frames=frames,
        every=every,
        cameras=setup.rig.names,
        keypoints=keypoints,
        residual_px=residual_px,
        others=others,
        reprojection_px={
            camera.name: _summary(parts) for camera, parts in zip(cameras, spread, strict=True)
        },
        sensors=_sensors(part, setup, at, [readings[instant] for instant in kept]),
    )


def frames_at(take: AnyTake, times_ns: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The take's frame at each time, -1 where none is within half a period."""
    known_ns = take.timestamps_ns
    if not len(known_ns):
        return np.full(len(times_ns), -1)
    later = np.searchsorted(known_ns, times_ns)
    both = np.stack([later - 1, later]).clip(0, len(known_ns) - 1)
    away_ns = np.abs(known_ns[both] - times_ns)
    nearest = np.where(away_ns[0] <= away_ns[1], both[0], both[1])
    return np.where(away_ns.min(axis=0) <= 0.5e9 / take.rate_hz, nearest, -1)


def posed_keypoints(
    take: Take, landmarks: LandmarkSet, cameras: Sequence[Camera], frames: Int[np.ndarray, " n"]
) -> Float[np.ndarray, "c s n k 3"]:
    """Everybody's landmarks as keypoints of every camera; NaN, NaN, 0 where nothing is imaged."""
    count = len(landmarks.landmark_names)
    pixels = np.zeros((len(cameras), len(take.subject_names), len(frames), count, 3))
    pixels[..., :2] = np.nan
    bones = landmarks.bones(take.skeleton)
    for subject, name in enumerate(take.subject_names):
        tracked = take.tracked[subject, frames]
        if not tracked.any():
            continue
        quaternion = take.bone_rotation_in_world_wxyz[subject, frames[tracked]]
        rotation = from_wxyz(quaternion.reshape(-1, 4)).as_matrix()
        points = landmarks_in_world(
            take.bone_position_in_world_m[subject, frames[tracked]],
            rotation.reshape(*quaternion.shape[:2], 3, 3),
            bones,
            landmarks.of(name).offsets_m(take.shape(subject)),
        )
        for row, camera in enumerate(cameras):
            seen = camera.project(points.reshape(-1, 3)).reshape(-1, count, 2)
            pixels[row, subject, tracked, :, :2] = seen
            pixels[row, subject, tracked, :, 2] = np.isfinite(seen).all(axis=2)
    return pixels


def paired(
    posed: Float[np.ndarray, "s k 3"], detected: Float[np.ndarray, "n k 3"]
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Which people's poses, and which detections in one picture, are of the same person."""
    return same_people(posed, detected, gate_extents=GATE_EXTENTS)


def _sensors(
    take: Take,
    setup: Setup,
    frames: Int[np.ndarray, " n"],
    readings: Sequence[Mapping[str, ImuReading]],
) -> tuple[SensorSeen, ...]:
    worn = [model for model in setup.subjects if model.name in take.subject_names]
    worn = [model for model in worn if model.sites.bone]
    if not worn:
        return ()
    sensors: list[SensorSeen] = []
    for model in worn:
        count = len(model.sites.bone)
        nothing = np.full((count, 3, 3), np.nan)
        measured = np.stack(
            [
                nothing if reading is None else reading.bone_rotation_in_world
                for reading in (each.get(model.name) for each in readings)
            ]
        )
        posed = take.bone_rotation_in_world(take.subject(model.name))[frames]
        cosine = (np.einsum("nbij,nbij->nb", posed[:, list(model.sites.bone)], measured) - 1) / 2
        off_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        sensors += [
            SensorSeen(subject=model.name, bone=take.bone_names[bone], off_deg=off_deg[:, column])
            for column, bone in enumerate(model.sites.bone)
        ]
    return tuple(sensors)


def _summary(parts: list[np.ndarray]) -> dict[str, float]:
    residual = np.concatenate(parts) if parts else np.zeros(0)
    return {
        "median": float(np.median(residual)) if len(residual) else float("nan"),
        "p90": float(np.percentile(residual, 90)) if len(residual) else float("nan"),
        "keypoints": len(residual),
    }
