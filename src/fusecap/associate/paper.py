"""Algorithm 1 of the paper, as printed, with start positions set by hand.

Every pair of detections in two views is triangulated; pairs that reproject well are gathered into
candidates in scan order; each subject takes the candidate closest to where it was last viewed.

Where the print leaves freedom, this file reads it so:

- Lines 2-5 let b run from a + 1, so every pair of cameras is visited once, the lower index first.
- `TriError` (line 7) is the mean over landmarks with non-zero confidence in both detections, and
  over the two views, of the reprojection error relative to that view's image width.
- A candidate lists several P3D. `AveDist` (line 8) compares with their mean, landmark by landmark,
  over the landmarks known on both sides; of several candidates that are near, the first is taken.
- A candidate may come to list two people of one camera. The person listed most often is the
  camera's; of equals the first listed.
- `Subjects3DLast` (line 25) starts as a point on the floor: then the distance is that of the
  torso's middle, seen from above. Later it is a skeleton, and the distance the mean over common
  landmarks.
- The text speaks of the closest *unused* candidate; the print takes the closest and gives the
  subject nothing when it is used. The print is followed.
- A keypoint that two views see along almost parallel rays has no depth and does not count.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from fusecap.associate.anatomy import Anatomy
from fusecap.associate.candidates import triangulate_pairs
from fusecap.associate.subjects import Subject, check_distinct
from fusecap.associate.views import Views
from fusecap.believable import believable_detections
from fusecap.body.landmarks import LandmarkSet
from fusecap.errors import SessionError
from fusecap.geometry.camera import REFERENCE_WIDTH_PX, Rig
from fusecap.geometry.triangulation import ROBUST_SCALE_PX
from fusecap.types import Detections, TrackState, TrackUpdate


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperSorterOptions:
    """The three thresholds of Algorithm 1."""

    max_error_of_width: float = 0.015
    """ThreshTriError as a fraction of the image width."""
    same_person_m: float = 0.30
    """ThreshDistSamePerson."""
    interframe_movement_m: float = 1.0
    """ThreshInterframeMovement."""


@dataclass(slots=True)
class _Gathered:
    """A candidate of CandsAll: its sources in order, and the running mean of its P3D."""

    sources: list[tuple[int, int]] = field(default_factory=list)
    total: np.ndarray | float = 0.0
    known: np.ndarray | int = 0

    def append(self, a: int, b: int, points: np.ndarray) -> None:
        known = np.isfinite(points[:, :1])
        self.sources.append((a, b))
        self.total = self.total + np.where(known, points, 0.0)
        self.known = self.known + known

    def mean(self) -> np.ndarray:
        return self.total / np.where(self.known, self.known, np.nan)

    def person(self, camera_of: np.ndarray, cameras: int) -> np.ndarray:
        """Per camera the row listed most often, the first of equals; -1 for none."""
        rows = [row for pair in self.sources for row in pair]
        person = np.full(cameras, -1)
        for row in reversed(list(dict.fromkeys(rows))):
            c = camera_of[row]
            if person[c] < 0 or rows.count(row) >= rows.count(int(person[c])):
                person[c] = row
        return person


class PaperSorter:
    """Sorts detections into designated subjects. Needs two cameras; everyone else is dropped."""

    def __init__(
        self,
        rig: Rig,
        landmark_set: LandmarkSet,
        subjects: Sequence[Subject],
        options: PaperSorterOptions | None = None,
    ) -> None:
        if len(rig) < 2:
            raise SessionError("associate = 'paper' triangulates and needs at least two cameras")
        if not subjects:
            raise SessionError("associate = 'paper' needs named subjects with start positions")
        check_distinct(subjects)
        for subject in subjects:
            if subject.start_m is None:
                raise SessionError(
                    f"associate = 'paper' needs a start position for subject '{subject.name}'; "
                    "set start_m = [x, z]"
                )
        self._rig = rig
        self._options = options or PaperSorterOptions()
        self._anatomy = Anatomy(landmark_set)
        self._landmarks = len(landmark_set.landmark_names)
        self._subjects = list(subjects)
        self._last: list[np.ndarray | None] = [None] * len(subjects)

    def update(
        self,
        detections: Detections,
        predicted: Mapping[int, Float[np.ndarray, "k 3"]],
        now_ns: int,
    ) -> list[TrackUpdate]:
        """Sort one instant. A subject is reported from its first sorted detection on.

        `predicted` and `now_ns` are there for the tracker's sake: Algorithm 1 knows only the last
        viewed locations.
        """
        detections = believable_detections(detections, len(self._rig), self._landmarks)
        views = Views.of(self._rig, detections)
        candidates = self._gather(views)
        means = [candidate.mean() for candidate in candidates]
        assigned = [False] * len(candidates)
        updates = []
        for s, subject in enumerate(self._subjects):
            distance = [self._distance_to_last(s, mean) for mean in means]
            best = int(np.argmin(distance)) if distance else -1
            person = np.full(len(self._rig), -1)
            if (
                best >= 0
                and distance[best] < self._options.interframe_movement_m
                and not assigned[best]
            ):
                assigned[best] = True
                person = candidates[best].person(views.camera_of, len(self._rig))
                self._last[s] = means[best]
            if self._last[s] is None:
                continue
            seen = bool((person >= 0).any())
            everyone = np.zeros((1, len(views.rays)))
            landmarks = views.triangulate(person[None].copy(), everyone, np.inf, ROBUST_SCALE_PX)
            updates.append(
                TrackUpdate(
                    track_id=s,
                    name=subject.name,
                    state=TrackState.CONFIRMED if seen else TrackState.COASTING,
                    person=views.local(person),
                    landmarks_in_world_m=landmarks[0],
                )
            )
        return updates

    def _gather(self, views: Views) -> list[_Gathered]:
        """CandsAll, lines 1-18."""
        o = self._options
        pairs = [
            (pa, pb)
            for a in range(len(self._rig))
            for pa in range(views.first[a], views.first[a + 1])
            for pb in range(views.first[a + 1], views.first[-1])
        ]
        rows = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        points, error_px = triangulate_pairs(
            views, rows, o.max_error_of_width * REFERENCE_WIDTH_PX, min_common=1
        )
        candidates: list[_Gathered] = []
        for h in np.flatnonzero(np.isfinite(error_px)):
            near = (c for c in candidates if _average(c.mean(), points[h]) < o.same_person_m)
            candidate = next(near, None)
            if candidate is None:
                candidate = _Gathered()
                candidates.append(candidate)
            candidate.append(*pairs[h], points[h])
        return candidates

    def _distance_to_last(self, s: int, landmarks: np.ndarray) -> float:
        last = self._last[s]
        if last is not None:
            return _average(last, landmarks)
        start_m = self._subjects[s].start_m
        centre = self._anatomy.centre(landmarks)
        return float(np.linalg.norm(centre[[0, 2]] - np.asarray(start_m)))


def _average(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance [m] over the landmarks known in both; infinite without any."""
    distance = np.linalg.norm(a - b, axis=1)
    distance = distance[np.isfinite(distance)]
    return float(distance.mean()) if len(distance) else np.inf
