"""Where keypoints lie in their bones' frames, by a take of the same instants (eq. 17-18)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import landmarks_in_world
from fusecap.evaluate.metrics import Summary, summarize
from fusecap.geometry.camera import Rig
from fusecap.geometry.triangulation import triangulate
from fusecap.take import Take
from fusecap.types import Detections

MIN_SAMPLES = 20
"""Of a landmark, before its median replaces the default."""
SAME_INSTANT_NS = 1_000_000
"""A take's frame this close to an instant shows it."""
_GATE = 0.2
"""A detection is a person when its keypoints' median distance from that person's landmarks, as
projected, is below this share of the person's size in the image."""


@dataclass(frozen=True, kw_only=True)
class OffsetSamples:
    """N person-instants of K landmarks in their bones' frames."""

    subjects: tuple[str, ...]
    person: Int[np.ndarray, " n"]
    """Index into `subjects`."""
    in_bone: Float[np.ndarray, "n k 3"]
    """t_pb of eq. 18 as fractions of stature; NaN where not triangulated."""

    def of(self, subject: str) -> OffsetSamples:
        """Those of one subject."""
        rows = self.person == self.subjects.index(subject)
        return OffsetSamples(
            subjects=self.subjects, person=self.person[rows], in_bone=self.in_bone[rows]
        )

    @property
    def count(self) -> Int[np.ndarray, " k"]:
        """Samples per landmark."""
        return np.isfinite(self.in_bone[:, :, 0]).sum(axis=0)

    @property
    def median(self) -> Float[np.ndarray, "k 3"]:
        """Per axis; NaN for landmarks with fewer than `MIN_SAMPLES`."""
        result = np.full(self.in_bone.shape[1:], np.nan)
        enough = self.count >= MIN_SAMPLES
        result[enough] = np.nanmedian(self.in_bone[:, enough], axis=0)
        return result

    @property
    def mad(self) -> Float[np.ndarray, "k 3"]:
        """Median absolute deviation per axis; NaN as `median`."""
        result = np.full(self.in_bone.shape[1:], np.nan)
        enough = self.count >= MIN_SAMPLES
        deviation = np.abs(self.in_bone[:, enough] - self.median[enough])
        result[enough] = np.nanmedian(deviation, axis=0)
        return result


def measure_offsets(
    rig: Rig, landmarks: LandmarkSet, take: Take, detections: Sequence[Detections]
) -> OffsetSamples:
    """Eq. 17-18 at every instant that the take also has; detections go to the people they fit."""
    bones = landmarks.bones(take.skeleton)
    person, in_bone = [], []
    for moment in _moments(rig, landmarks, take, detections):
        points, _ = triangulate(rig, moment.keypoints)
        away = points - moment.position_in_world_m[bones]
        local = np.einsum("kji,kj->ki", moment.rotation_in_world[bones], away)
        person.append(moment.subject)
        in_bone.append(local / take.heights_m[moment.subject])
    return OffsetSamples(
        subjects=take.subject_names,
        person=np.array(person, dtype=np.int64),
        in_bone=np.array(in_bone).reshape(-1, len(bones), 3),
    )


def reprojection_error_px(
    rig: Rig, landmarks: LandmarkSet, take: Take, detections: Sequence[Detections]
) -> Summary:
    """Distance of keypoints from the take's landmarks, in pixels of their cameras."""
    bones = landmarks.bones(take.skeleton)
    errors = [np.zeros(0)]
    for moment in _moments(rig, landmarks, take, detections):
        points = landmarks_in_world(
            moment.position_in_world_m[None],
            moment.rotation_in_world[None],
            bones,
            landmarks.of(take.subject_names[moment.subject]).offsets_m(take.shape(moment.subject)),
        )[0]
        for camera, seen in zip(rig.cameras, moment.keypoints, strict=True):
            used = seen[:, 2] > 0
            errors.append(np.linalg.norm(camera.project(points[used]) - seen[used, :2], axis=1))
    return summarize(np.concatenate(errors))


@dataclass(frozen=True, kw_only=True)
class _Moment:
    """One subject at one instant."""

    subject: int
    position_in_world_m: Float[np.ndarray, "b 3"]
    rotation_in_world: Float[np.ndarray, "b 3 3"]
    keypoints: Float[np.ndarray, "c k 3"]
    """Of the detections that fit; NaN, NaN, 0 elsewhere."""


def _moments(
    rig: Rig, landmarks: LandmarkSet, take: Take, detections: Sequence[Detections]
) -> Iterator[_Moment]:
    bones = landmarks.bones(take.skeleton)
    subjects = range(len(take.subject_names))
    rotation = [take.bone_rotation_in_world(subject) for subject in subjects]
    offsets_m = [
        landmarks.of(name).offsets_m(take.shape(subject))
        for subject, name in enumerate(take.subject_names)
    ]
    for moment in detections:
        frame = _frame_at(take, moment.timestamp_ns)
        there = [] if frame is None else [s for s in subjects if take.tracked[s, frame]]
        if not there:
            continue
        position = take.bone_position_in_world_m[there, frame]
        predicted = np.stack(
            [
                landmarks_in_world(position[row][None], rotation[s][frame][None], bones, offset)[0]
                for row, (s, offset) in enumerate((s, offsets_m[s]) for s in there)
            ]
        )
        keypoints = _assigned(rig, predicted, moment)
        for row, subject in enumerate(there):
            if (keypoints[row, :, :, 2] > 0).any():
                yield _Moment(
                    subject=subject,
                    position_in_world_m=position[row],
                    rotation_in_world=rotation[subject][frame],
                    keypoints=keypoints[row],
                )


def _frame_at(take: Take, timestamp_ns: int) -> int | None:
    """The take's frame at this instant, but for the rounding of files."""
    times = take.timestamps_ns
    if not len(times):
        return None
    right = min(int(np.searchsorted(times, timestamp_ns)), len(times) - 1)
    frame = min((max(right - 1, 0), right), key=lambda f: abs(int(times[f]) - timestamp_ns))
    return frame if abs(int(times[frame]) - timestamp_ns) <= SAME_INSTANT_NS else None


def _assigned(
    rig: Rig, landmarks_in_world_m: Float[np.ndarray, "s k 3"], detections: Detections
) -> Float[np.ndarray, "s c k 3"]:
    """Per person and camera the detection nearest to the projected landmarks, one to one."""
    people, count = landmarks_in_world_m.shape[:2]
    result = np.full((people, len(rig), count, 3), [np.nan, np.nan, 0.0])
    for camera, lens in enumerate(rig.cameras):
        seen = detections.people[camera]
        if not len(seen):
            continue
        pixels = lens.project(landmarks_in_world_m.reshape(-1, 3)).reshape(people, count, 2)
        distance = np.full((people, len(seen)), np.inf)
        for person, projected in enumerate(pixels):
            inside = np.isfinite(projected[:, 0])
            if not inside.any():
                continue
            # Someone beside the camera's plane projects to millions of pixels: the image bounds it.
            size = min(np.linalg.norm(np.ptp(projected[inside], axis=0)), np.hypot(*lens.size_px))
            for index, keypoints in enumerate(seen):
                shared = inside & (keypoints[:, 2] > 0)
                if shared.any():
                    away = np.linalg.norm(projected[shared] - keypoints[shared, :2], axis=1)
                    distance[person, index] = np.median(away) / max(size, 1.0)
        cost = np.minimum(distance, 1e3)
        for person, index in zip(*linear_sum_assignment(cost), strict=True):
            if distance[person, index] <= _GATE:
                result[person, camera] = seen[index]
    return result
