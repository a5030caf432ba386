"""The default association: tracks that are predicted, matched, found, lost and found again.

At every instant, in this order:

1. Match. Each track's landmarks are predicted (by the last solve, else at constant velocity), and
   compared with every detection: mean distance in metres at the landmark's depth, robust. Each
   view gives its detections away at least total distance, within a gate.
2. Check. A track's views must agree in space: while one contradicts the skeleton that the others
   triangulate, it is left out. No view is better than a wrong one.
3. Second round. What is still free is matched with the skeletons just measured.
4. Find. Candidates among the rest: a track unseen now takes the one it can have become; a
   duplicate of a track is nobody; anyone else is a new, tentative track.
5. Admit. A tentative track that enough views saw for long enough inside the volume becomes a
   subject: a named one that waits, one that went missing after the newcomer did not yet exist, or
   a new one while there is room. The others stay bystanders, tracked so that they cannot be
   mistaken for a subject, and unreported.
6. Forget. A track unseen for too long dies; its subject is missing until it returns.

Worked number: two people pass at 0.4 m with 1.5 m/s each at 30 Hz. Constant velocity is wrong by
0.02 m a frame; exchanging them would cost 0.4 m in each view, twice the gate of the check.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment

from fusecap.associate.anatomy import MIN_LIMBS, Anatomy
from fusecap.associate.assignment import assign_each_view
from fusecap.associate.candidates import Candidate, CandidateOptions, find_candidates
from fusecap.associate.subjects import Subject, check_distinct
from fusecap.associate.track import Track, absorb, measure
from fusecap.associate.views import MIN_COMMON, Views
from fusecap.body.landmarks import LandmarkSet
from fusecap.errors import SessionError
from fusecap.geometry.camera import Rig
from fusecap.kernels import association as kernels
from fusecap.types import Detections, TrackState, TrackUpdate

TRUNCATION = 2.0
"""No landmark counts as farther than so many gates: half a body may be wild before the mean is."""


_HIP_HEIGHT_M = 0.9
"""Of an adult, where only a start position on the floor is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerOptions:
    """Chosen from anatomy, human speed and detector noise; none from a recording."""

    max_subjects: int | None = None
    """People to report at most; None: as many as there are named subjects, else everyone."""
    volume_m: tuple[float, float, float, float] | None = None
    """x_min, x_max, z_min, z_max on the floor in which people become subjects; None: anywhere.
    A subject who walks out is still followed."""
    gate_m: float = 0.35
    """Mean landmark distance within which a detection can be a predicted track: hands and feet at
    5 m/s move 0.2 m between frames at 25 Hz, and a detector adds 0.05 m."""
    mirror_penalty_m: float = 0.1
    """Added to the distance to a detection with left and right exchanged: a person seen from the
    wrong side still is that person, but a plain match goes first."""
    birth_views: int = 3
    """Views that must agree on a newcomer, or all that see the place where these are fewer: two
    people can pretend a third to two cameras, hardly to three."""
    birth_frames: int = 3
    """Instants in which they must; a spurious detection seldom lasts longer."""
    two_view_birth_s: float = 1.0
    """A newcomer whom only two of the views detect must last this long: ghosts dissolve as soon as
    one of the two people who make them moves."""
    tentative_s: float = 0.5
    """A newcomer unseen for so long is dropped."""
    coast_s: float = 2.0
    """A subject unseen for so long is missing: longer than walking past a pillar or a person."""
    single_view_s: float = 5.0
    """A subject seen by one of several cameras only for so long is missing: depth is then a guess,
    and a stranger who stands behind cannot be told apart."""
    reach_m: float = 0.5
    """Distance from its prediction at which a track unseen for an instant may be found again."""
    reach_speed_m_s: float = 1.5
    """Growth of that distance with the time unseen: a person walking on another way."""
    start_radius_m: float = 1.0
    """A named subject is born within this distance of its start position: the paper's 1 m."""
    duplicate_m: float = 0.3
    """Median landmark distance below which two skeletons are one person: the paper's 30 cm."""
    overlap_s: float = 0.5
    """Two tracks that share one place for so long are one person; the younger goes."""
    size_tolerance: float = 0.15
    """Mean relative difference of limb lengths up to which a returning person may be a missing
    subject when there also is room for a new one: statures differ by 4 % (one standard deviation),
    a triangulated limb by 10 % in one frame."""
    memory_s: float = 60.0
    """How long an unnamed subject is remembered; named ones always are."""
    candidates: CandidateOptions = field(default_factory=CandidateOptions)

    def __post_init__(self) -> None:
        if self.max_subjects is not None and self.max_subjects < 1:
            raise SessionError(f"max_subjects is {self.max_subjects}; expected 1 or more")
        if self.volume_m is not None:
            x_min, x_max, z_min, z_max = self.volume_m
            if not (x_min < x_max and z_min < z_max):
                raise SessionError(
                    f"the capture volume is {self.volume_m}; expected x_min < x_max, z_min < z_max "
                    "in metres"
                )


@dataclass(slots=True, kw_only=True)
class _Place:
    """A subject's place in the session: waiting (no track yet), live, or missing."""

    name: str
    named: bool
    start_m: tuple[float, float] | None
    track: Track | None = None
    live: bool = False


class Tracker:
    """Assigns detections to people. Holds no clock: every update says what time it is."""

    def __init__(
        self,
        rig: Rig,
        landmark_set: LandmarkSet,
        options: TrackerOptions | None = None,
        subjects: Sequence[Subject] = (),
    ) -> None:
        self._rig = rig
        self._options = options or TrackerOptions()
        self._anatomy = Anatomy(landmark_set)
        self._mirror = landmark_set.mirror
        self._tracks: list[Track] = []
        check_distinct(subjects)
        self._places = [_Place(name=s.name, named=True, start_m=s.start_m) for s in subjects]
        self._max_subjects = self._options.max_subjects or len(subjects) or sys.maxsize
        if self._max_subjects < len(subjects):
            raise SessionError(
                f"max_subjects is {self._max_subjects}, but {len(subjects)} subjects are named"
            )
        self._next_id = 0
        self._single = len(rig) == 1
        if self._single:
            if 1 < self._max_subjects < sys.maxsize:
                raise SessionError(
                    f"one camera cannot tell {self._max_subjects} people apart; "
                    "set max_subjects = 1 or add a camera"
                )
            self._max_subjects = 1
        self._limits_px = np.array([camera.size_px for camera in rig.cameras]).reshape(-1, 2)
        self._looking = np.ones(len(rig), dtype=bool)
        self._last_ns: int | None = None

    def update(
        self,
        detections: Detections,
        predicted: Mapping[int, Float[np.ndarray, "k 3"]],
        now_ns: int,
    ) -> list[TrackUpdate]:
        """Assign the people of one instant.

        `predicted` holds, by track id, the landmarks [m] that the last solve expects now; NaN rows
        and absent tracks are predicted here. Subjects come first in the result, in their order,
        then newcomers under trial, without a name.
        """
        views = Views.of(self._rig, detections)
        self._looking = np.array(detections.looked or (True,) * len(self._rig))
        tracks = self._tracks
        expected = np.empty((len(tracks), *views.rays.shape[1:]))
        for t, track in enumerate(tracks):
            expected[t] = track.predict(now_ns, predicted.get(track.track_id))
        free = np.ones(len(views.rays), dtype=bool)
        person, measured = self._match(views, expected, free)
        self._absorb(person, measured, expected, now_ns)
        if not self._single and free.any():
            person, measured = self._find(views, person, measured, free, now_ns)
            if self._looking.sum() == 1:
                self._find_alone(views, person, expected, free, now_ns)
        self._follow(views, person, expected, now_ns)
        if self._single:
            person, measured = self._find_single(views, person, measured, expected, now_ns)
        self._forget(measured, now_ns)
        self._admit(now_ns)
        self._last_ns = now_ns
        return self._report(views.local(person), measured, tracks, now_ns)

    # ---------------------------------------------------------------------------------------- cast

    def reinitialise(self, name: str = "") -> None:
        """Forget a subject's track, body and start position, so that it is found anew anywhere.

        Without a name everybody is found as at the beginning.
        """
        places = [place for place in self._places if name in ("", place.name)]
        gone = [place.track for place in places]
        self._tracks = [track for track in self._tracks if name and track not in gone]
        for place in places:
            place.track, place.live = None, False
            if name:
                place.start_m = None

    def add_subject(self, name: str = "") -> None:
        """Make room for one more person, with a name or `personN`; who was removed may come too.

        Raises `SessionError` for a second person before a single camera.
        """
        if self._single and self._max_subjects > 0:
            raise SessionError("one camera cannot tell two people apart; add a camera")
        if name and all(place.name != name for place in self._places):
            self._places.append(_Place(name=name, named=True, start_m=None))
        if self._max_subjects < sys.maxsize:
            self._max_subjects += 1
        for track in self._tracks:
            track.dismissed = False

    def remove_subject(self, name: str) -> None:
        """Follow a subject no longer; there is one place less."""
        for place in [place for place in self._places if place.name == name]:
            self._places.remove(place)
            if place.live and place.track is not None:
                place.track.dismissed = True
            if self._max_subjects < sys.maxsize:
                self._max_subjects -= 1

    @property
    def is_full(self) -> bool:
        """Every place is taken by somebody who is being followed."""
        return sum(place.live for place in self._places) >= self._max_subjects

    # ------------------------------------------------------------------ match, check, second round

    def _match(
        self, views: Views, expected: np.ndarray, free: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of detections (t, c) and triangulated landmarks (t, k, 3); `free` is updated."""
        o = self._options
        person = np.full((len(expected), len(self._rig)), -1)
        if len(expected) == 0:
            return person, expected.copy()
        gate = np.full(len(expected), o.gate_m)
        distance = self._distance(views, expected, free)
        young = self._young()
        assign_each_view(
            distance, np.where(young, 0.0, gate), views.camera_of, views.first, free, person
        )
        if young.any():
            assign_each_view(distance, gate, views.camera_of, views.first, free, person)
        measured = self._check(views, person, distance, free)

        # Only what was not far from a prediction can be near the skeleton just measured.
        near = free & (distance < 1.5 * o.gate_m).any(axis=0)
        if near.any():
            current = np.where(np.isnan(measured), expected, measured)
            again = self._distance(views, current, near)
            tight = np.full(len(current), o.candidates.consistency_m)
            before = person.copy()
            assign_each_view(again, tight, views.camera_of, views.first, free, person)
            if (person != before).any():
                measured = self._check(views, person, np.fmin(again, distance), free)
            # What looks like somebody already found, doubled or mirrored, is nobody else.
            free &= ~(again < o.candidates.consistency_m).any(axis=0)
        return person, measured

    def _distance(self, views: Views, landmarks: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Distance [m] (t, n) of tracks to detections, right way round or mirrored."""
        truncation_m = TRUNCATION * self._options.gate_m
        plain = views.distances(landmarks, truncation_m, wanted)
        other_way = np.ascontiguousarray(landmarks[:, self._mirror])
        mirrored = views.distances(other_way, truncation_m, wanted)
        return np.minimum(plain, mirrored + self._options.mirror_penalty_m)

    def _check(
        self, views: Views, person: np.ndarray, distance: np.ndarray, free: np.ndarray
    ) -> np.ndarray:
        o = self._options.candidates
        measured = views.triangulate(person, distance, o.consistency_m, o.robust_scale_px)
        free[:] = True
        free[person[person >= 0]] = False
        return measured

    def _young(self) -> np.ndarray:
        """Newcomers under trial: they choose after everyone else."""
        subjects = self._subjects()
        return np.array(
            [t.track_id not in subjects and not self._established(t) for t in self._tracks],
            dtype=bool,
        )

    def _absorb(
        self, person: np.ndarray, measured: np.ndarray, expected: np.ndarray, now_ns: int
    ) -> None:
        """Move the tracks on which two views or more agree."""
        count = (person >= 0).sum(axis=1)
        agreed = np.isfinite(measured[:, :, 0]).sum(axis=1) >= MIN_COMMON
        moving = [self._tracks[t] for t in np.flatnonzero(agreed)]
        if not moving:
            return
        absorb(moving, measured[agreed], expected[agreed], now_ns)
        measure(moving, self._anatomy.limb_lengths(measured[agreed]))
        for track, views in zip(moving, count[agreed], strict=True):
            self._count_frame(track, int(views), now_ns)

    def _follow(self, views: Views, person: np.ndarray, expected: np.ndarray, now_ns: int) -> None:
        """Move the tracks that hardly more than one view shows: sideways, at the depth they had."""
        for t in range(len(expected)):
            track = self._tracks[t]
            if track.seen_ns < now_ns and (person[t] >= 0).any():
                camera = int(np.argmax(person[t] >= 0))
                ray = views.rays[person[t, camera]]
                seen = self._at_depth(camera, ray, track.landmarks)
                absorb([track], seen[None], expected[t : t + 1], now_ns)

    def _count_frame(self, track: Track, views: int, now_ns: int) -> None:
        track.triangulated_ns = now_ns
        track.frames += 1
        enough = self._options.birth_views
        if track.strong_frames < self._options.birth_frames:
            strong = views >= enough or views >= self._cameras_that_see(track.landmarks)
            track.strong_frames += strong

    def _at_depth(self, camera: int, ray: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
        """Where one view puts landmarks (k, 3) if their depth has not changed; NaN where unseen."""
        cam = self._rig.cameras[camera]
        depth = landmarks @ cam.rotation[2] + cam.translation[2]
        depth = np.where(ray[:, 2] > 0, depth, np.nan)
        in_cam = np.stack([ray[:, 0] * depth, ray[:, 1] * depth, depth], axis=1)
        return (in_cam - cam.translation) @ cam.rotation

    def _cameras_that_see(self, landmarks: np.ndarray) -> int:
        """Cameras that look, and image most of a skeleton."""
        known = landmarks[np.isfinite(landmarks[:, 0])]
        seeing = 0
        for c in np.flatnonzero(self._looking):
            camera, limit = self._rig.cameras[c], self._limits_px[c]
            pixels = camera.project(known)
            inside = ((pixels >= 0) & (pixels < limit)).all(axis=1)
            seeing += int(inside.mean() > 0.5)
        return seeing

    # ---------------------------------------------------------------------------------------- find

    def _find(
        self,
        views: Views,
        person: np.ndarray,
        measured: np.ndarray,
        free: np.ndarray,
        now_ns: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Candidates among the free detections continue unseen tracks or begin new ones.

        A detection that is a track's only one is free too: two views know better than one.
        """
        o = self._options
        alone = person[(person >= 0).sum(axis=1) == 1].max(axis=1)
        free[alone] = True
        if len(np.unique(views.camera_of[free])) < 2:
            return person, measured
        found = find_candidates(views, free, self._anatomy, o.candidates)
        if not found:
            return person, measured
        taken = set()
        for t, i in self._reunite(found, now_ns):
            person[t] = found[i].person
            measured[t] = found[i].landmarks_in_world_m
            self._tracks[t].restart(measured[t].copy(), now_ns)
            self._count_frame(self._tracks[t], int((person[t] >= 0).sum()), now_ns)
            taken.add(i)
        for i, candidate in enumerate(found):
            landmarks = candidate.landmarks_in_world_m
            if i in taken or self._is_duplicate(landmarks):
                continue
            person[np.isin(person, candidate.person[candidate.person >= 0])] = -1
            track = self._begin(landmarks.copy(), now_ns)
            self._count_frame(track, int((candidate.person >= 0).sum()), now_ns)
            person = np.concatenate([person, candidate.person[None]])
            measured = np.concatenate([measured, landmarks[None]])
        return person, measured

    def _find_alone(
        self,
        views: Views,
        person: np.ndarray,
        expected: np.ndarray,
        free: np.ndarray,
        now_ns: int,
    ) -> None:
        """The one camera that is left sees an unseen subject again, near where it is expected.

        At the depth it had, and nearer than it can have gone; who is who then is a guess.
        """
        o = self._options
        subjects = self._subjects()
        unseen = [
            t
            for t, track in enumerate(self._tracks)
            if track.track_id in subjects and (person[t] < 0).all()
        ]
        if not unseen:
            return
        away_s = [(now_ns - self._tracks[t].seen_ns) * 1e-9 for t in unseen]
        reach = o.reach_m + o.reach_speed_m_s * np.array(away_s)
        distance = views.distances(expected[unseen], 2 * float(reach.max()), free)
        for row, n in _cheapest(np.where(distance < reach[:, None], distance, np.inf)):
            track, camera = self._tracks[unseen[row]], int(views.camera_of[n])
            seen = self._at_depth(camera, views.rays[n], expected[unseen[row]])
            moved = np.nanmedian(seen - expected[unseen[row]], axis=0)
            track.settle(np.where(np.isnan(seen), track.landmarks + moved, seen), now_ns)
            person[unseen[row], camera] = n
            free[n] = False

    def _begin(self, landmarks: np.ndarray, now_ns: int) -> Track:
        track = Track(self._next_id, landmarks, self._anatomy.limb_lengths(landmarks), now_ns)
        self._next_id += 1
        self._tracks.append(track)
        return track

    def _reunite(self, found: list[Candidate], now_ns: int) -> list[tuple[int, int]]:
        """Which unseen track continues in which candidate: near enough, and the same size."""
        o = self._options
        unseen = [t for t, track in enumerate(self._tracks) if track.seen_ns < now_ns]
        if not unseen:
            return []
        centres = [self._anatomy.centre(c.landmarks_in_world_m) for c in found]
        limbs = [self._anatomy.limb_lengths(c.landmarks_in_world_m) for c in found]
        cost = np.full((len(unseen), len(found)), np.inf)
        for row, t in enumerate(unseen):
            track = self._tracks[t]
            reach = o.reach_m + o.reach_speed_m_s * (now_ns - track.triangulated_ns) * 1e-9
            expected = self._anatomy.centre(track.predict(now_ns, None))
            for column, centre in enumerate(centres):
                away = float(np.linalg.norm(centre - expected))
                misfit = _misfit(track.limb_lengths_m(), limbs[column])
                if away < reach and misfit < 2 * o.size_tolerance:
                    cost[row, column] = away + misfit
        return [(unseen[row], column) for row, column in _cheapest(cost)]

    def _is_duplicate(self, landmarks: np.ndarray) -> bool:
        return any(
            _apart(landmarks, track.landmarks, self._mirror) < self._options.duplicate_m
            for track in self._tracks
        )

    def _find_single(
        self,
        views: Views,
        person: np.ndarray,
        measured: np.ndarray,
        expected: np.ndarray,
        now_ns: int,
    ) -> tuple[np.ndarray, np.ndarray]:
        """With one camera the subject is the detection at the start position, or the surest one."""
        confidence = views.rays[:, :, 2].sum(axis=1)
        if not confidence.any():
            return person, measured
        chosen = int(np.argmax(confidence))
        if not self._tracks:
            start_m = self._places[0].start_m if self._places else None
            if start_m is not None:
                chosen = self._nearest_in_view(views, start_m)
                if chosen < 0:
                    return person, measured
            unknown = np.full(views.rays.shape[1:], np.nan)
            track = self._begin(unknown, now_ns)
            track.frames = track.strong_frames = self._options.birth_frames
            person, measured = np.full((1, 1), -1), unknown[None]
        else:
            track = self._tracks[0]
            lost_s = (now_ns - track.seen_ns) * 1e-9
            if lost_s <= self._options.tentative_s and np.isfinite(expected).any():
                return person, measured
            track.restart(np.full_like(track.landmarks, np.nan), now_ns)
        person[0, 0] = chosen
        return person, measured

    def _nearest_in_view(self, views: Views, start_m: tuple[float, float]) -> int:
        """The detection of the only camera nearest to a person at `start_m`; -1 if none is near."""
        camera = self._rig.cameras[0]
        hips = camera.rotation @ [start_m[0], _HIP_HEIGHT_M, start_m[1]] + camera.translation
        weight = views.rays[:, :, 2:]
        middle = (np.nan_to_num(views.rays[:, :, :2]) * weight).sum(axis=1)
        middle /= np.maximum(weight.sum(axis=1), 1e-9)
        away_m = np.linalg.norm(middle * hips[2] - hips[:2], axis=1)
        nearest = int(np.argmin(away_m))
        return nearest if away_m[nearest] < self._options.start_radius_m else -1

    # ------------------------------------------------------------------------------ forget, admit

    def _forget(self, measured: np.ndarray, now_ns: int) -> None:
        """Let go of tracks unseen for too long, and of the younger of two on one person."""
        o = self._options
        subjects = self._subjects()
        elapsed_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        looking = int(self._looking.sum())
        alive = []
        for track in self._tracks:
            known = track.track_id in subjects or self._established(track)
            enough = min(2, len(self._rig)) if known else 1
            track.wait(now_ns, elapsed_ns, looking, enough)
            missed_s, alone_s = track.missed_ns * 1e-9, track.alone_ns * 1e-9
            away_s = (now_ns - track.seen_ns) * 1e-9
            if (
                missed_s <= (o.coast_s if known else o.tentative_s)
                and alone_s <= o.single_view_s
                and away_s <= o.coast_s + o.memory_s
            ):
                alive.append(track)
        doubled = self._doubled(alive, measured, now_ns)
        self._tracks = [track for track in alive if track not in doubled]
        for place in self._places:
            place.live = place.live and place.track in self._tracks
        self._places = [
            place
            for place in self._places
            if place.live
            or place.named
            or (place.track and (now_ns - place.track.seen_ns) * 1e-9 <= o.memory_s)
        ]

    def _doubled(self, alive: list[Track], measured: np.ndarray, now_ns: int) -> list[Track]:
        """Tracks that have shared the place of a better established one for too long."""
        subjects = self._subjects()
        seen = [
            (track.track_id not in subjects, track.born_ns, r)
            for r, track in enumerate(self._tracks)
            if track.triangulated_ns == now_ns and track in alive
        ]
        order = [r for *_, r in sorted(seen)]
        same = np.empty((len(order), len(order)), dtype=bool)
        kernels.coincide(measured[order], self._options.duplicate_m / 2, MIN_COMMON, same)
        doubled = []
        for place, r in enumerate(order):
            track = self._tracks[r]
            if not same[place, :place].any():
                track.overlap_since_ns = None
            elif track.overlap_since_ns is None:
                track.overlap_since_ns = now_ns
            elif (now_ns - track.overlap_since_ns) * 1e-9 >= self._options.overlap_s:
                doubled.append(track)
        return doubled

    def _admit(self, now_ns: int) -> None:
        """Give established newcomers inside the volume a subject's place while there is one."""
        subjects = self._subjects()
        newcomers = [
            track
            for track in self._tracks
            if track.track_id not in subjects
            and not track.dismissed
            and track.seen_ns == now_ns
            and self._established(track)
            and self._inside(track)
        ]
        if not newcomers:
            return
        known = [p for p in self._places if not p.live and (p.track or p.start_m)]
        cost = np.array([[self._claim(t, p) for p in known] for t in newcomers])
        admitted = _cheapest(cost.reshape(len(newcomers), len(known)))
        for n, p in admitted:
            self._admit_to(known[p], newcomers[n])
        rest = [t for n, t in enumerate(newcomers) if n not in dict(admitted)]
        rest.sort(key=lambda t: (-t.frames, self._from_middle(t)))
        waiting = [p for p in self._places if not (p.live or p.track or p.start_m)]
        chosen = rest[: len(waiting) + max(self._room(), 0)]
        for track in sorted(chosen, key=lambda t: t.track_id):
            if not waiting:
                waiting.append(_Place(name=self._free_name(), named=False, start_m=None))
                self._places.append(waiting[0])
            self._admit_to(waiting.pop(0), track)

    def _claim(self, track: Track, place: _Place) -> float:
        """How badly a newcomer fits a waiting or missing subject [m]; infinite: not at all."""
        o = self._options
        centre = self._anatomy.centre(track.landmarks)
        if place.track is None:
            assert place.start_m is not None
            away = float(np.hypot(centre[0] - place.start_m[0], centre[2] - place.start_m[1]))
            if self._single:
                return 0.0  # One camera gives no place to compare with.
            return away if away < o.start_radius_m else np.inf
        lost = place.track
        if track.born_ns <= lost.seen_ns:
            return np.inf  # Both were seen at once: two people.
        away = np.nan_to_num(np.linalg.norm(centre - self._anatomy.centre(lost.landmarks)))
        misfit = _misfit(lost.limb_lengths_m(), track.limb_lengths_m())
        reach = o.reach_m + 2 * o.reach_speed_m_s * (track.born_ns - lost.seen_ns) * 1e-9
        optional = self._room() > 0 or any(p.track is None for p in self._places)
        if optional and (misfit > o.size_tolerance or away > reach):
            return np.inf
        return float(away / reach + misfit / o.size_tolerance)

    def _admit_to(self, place: _Place, track: Track) -> None:
        if place.track is not None:
            track.track_id = place.track.track_id
            track.limb_sum_m += place.track.limb_sum_m
            track.limb_count += place.track.limb_count
        place.track = track
        place.live = True

    # ------------------------------------------------------------------------------------- report

    def _report(
        self, person: np.ndarray, measured: np.ndarray, tracks: list[Track], now_ns: int
    ) -> list[TrackUpdate]:
        row = {id(track): r for r, track in enumerate(tracks)}
        updates = []
        for place in self._places:
            if place.live and place.track is not None:
                seen = place.track.seen_ns == now_ns
                state = TrackState.CONFIRMED if seen else TrackState.COASTING
                updates.append((place.track, place.name, state))
        if len(updates) < self._max_subjects:
            subjects = self._subjects()
            updates += [
                (track, "", TrackState.TENTATIVE)
                for track in self._tracks
                if track.track_id not in subjects
                and track.strong_frames > 0
                and not self._established(track)
                and self._inside(track)
            ]
        return [
            TrackUpdate(
                track_id=track.track_id,
                name=name,
                state=state,
                person=person[row[id(track)]],
                landmarks_in_world_m=measured[row[id(track)]],
            )
            for track, name, state in updates
        ]

    # ------------------------------------------------------------------------------------ helpers

    def _subjects(self) -> set[int]:
        return {p.track.track_id for p in self._places if p.live and p.track is not None}

    def _established(self, track: Track) -> bool:
        o = self._options
        lasted_s = (track.triangulated_ns - track.born_ns) * 1e-9
        return track.strong_frames >= o.birth_frames or (
            track.frames >= o.birth_frames and lasted_s >= o.two_view_birth_s
        )

    def _inside(self, track: Track) -> bool:
        """Whether the torso is over the capture volume; an unknown place is."""
        if self._options.volume_m is None:
            return True
        x_min, x_max, z_min, z_max = self._options.volume_m
        x, _, z = self._anatomy.centre(track.landmarks)
        return not (x < x_min or x > x_max or z < z_min or z > z_max)

    def _from_middle(self, track: Track) -> float:
        """Distance on the floor [m] to the middle of the volume, or of where the cameras look."""
        centre = self._anatomy.centre(track.landmarks)[[0, 2]]
        if self._options.volume_m is None:
            middle = np.mean([c.position_in_world[[0, 2]] for c in self._rig.cameras], axis=0)
        else:
            x_min, x_max, z_min, z_max = self._options.volume_m
            middle = np.array([x_min + x_max, z_min + z_max]) / 2
        return float(np.linalg.norm(centre - middle))

    def _room(self) -> int:
        """How many more subjects there may be."""
        return self._max_subjects - len(self._places)

    def _free_name(self) -> str:
        taken = {place.name for place in self._places}
        number = 1
        while f"person{number}" in taken:
            number += 1
        return f"person{number}"


def _apart(a: np.ndarray, b: np.ndarray, mirror: np.ndarray) -> float:
    """Median distance [m] of two skeletons' common landmarks, or of left to right if less."""
    distance = np.fmin(np.linalg.norm(a - b, axis=1), np.linalg.norm(a - b[mirror], axis=1))
    distance = distance[np.isfinite(distance)]
    return float(np.median(distance)) if len(distance) >= MIN_COMMON else np.inf


def _misfit(a: np.ndarray, b: np.ndarray) -> float:
    """Mean relative difference of two bodies' limb lengths; 0 where too few are known."""
    relative = np.abs(a - b) / (0.5 * (a + b))
    relative = relative[np.isfinite(relative)]
    return float(relative.mean()) if len(relative) >= MIN_LIMBS else 0.0


def _cheapest(cost: np.ndarray) -> list[tuple[int, int]]:
    """Pairs (row, column) of least total cost; infinite ones never."""
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e6))
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if np.isfinite(cost[r, c])]
