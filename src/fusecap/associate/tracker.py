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

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from fusecap.associate import looks, renaming, sizes
from fusecap.associate.admission import Admission
from fusecap.associate.anatomy import Anatomy
from fusecap.associate.candidates import find_candidates
from fusecap.associate.matching import Matcher
from fusecap.associate.one_view import find_again, follow, nearest_in_view
from fusecap.associate.options import TrackerOptions
from fusecap.associate.population import Population
from fusecap.associate.sensor_vote import SensorVote
from fusecap.associate.subjects import Cast, Subject
from fusecap.associate.track import Track, absorb, measure, median_apart_m, part
from fusecap.associate.traits import DECIDE_NS, doubt
from fusecap.associate.views import MIN_COMMON, Views
from fusecap.believable import believable_detections, believable_points, checked_moment
from fusecap.body.landmarks import LandmarkSet
from fusecap.geometry.camera import Rig
from fusecap.types import Detections, ImuReading, TrackState, TrackUpdate


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
        self._landmarks = len(landmark_set.landmark_names)
        ids = itertools.count()
        self._cast = Cast(subjects, rig, self._anatomy, self._options, ids)
        self._admission = Admission(self._cast, rig, self._anatomy, self._options)
        self._population = Population(self._options, self._anatomy, landmark_set.mirror, ids)
        self._matcher = Matcher(self._options, landmark_set.mirror)
        self._single = len(rig) == 1
        self._limits_px = np.array([camera.size_px for camera in rig.cameras]).reshape(-1, 2)
        self._looking = np.ones(len(rig), dtype=bool)
        self._last_ns: int | None = None
        self._vote = SensorVote(landmark_set, {s.name: s.sensors for s in subjects if s.sensors})
        self._readings: Mapping[str, ImuReading] = {}
        self.renumbered: dict[int, int] = {}
        """Of tracks that at the last instant turned out to be others, by the former id the new."""
        self.renumbered_since_ns: int | None = None
        """When these went astray; None where sensors' readings must tell."""
        self.bystanders: list[TrackUpdate] = []
        """Of the last instant, where somebody wears sensors, whom they may still fit."""
        self.notes: list[str] = []
        """What a user should know of the last instant."""

    def hear(self, readings: Mapping[str, ImuReading]) -> None:
        """What subjects' sensors say at the instant of the next `update`."""
        self._readings = readings

    def update(
        self,
        detections: Detections,
        predicted: Mapping[int, Float[np.ndarray, "k 3"]],
        now_ns: int,
    ) -> list[TrackUpdate]:
        """Assign the people of one instant.

        `predicted` holds, by track id, the landmarks [m] that the last solve expects now; NaN rows
        and absent tracks are predicted here. Subjects come first in the result, in their order,
        then newcomers under trial, without a name. Raises `InputError` for arrays of another
        shape, crowds, and a time that is not after the last one, with everything as it was.
        """
        detections = believable_detections(detections, len(self._rig), self._landmarks)
        predicted = {k: believable_points(some, self._landmarks) for k, some in predicted.items()}
        now_ns = checked_moment(now_ns, self._last_ns)
        views = Views.of(self._rig, detections)
        self._looking = np.array(detections.looked or (True,) * len(self._rig))
        tracks = self._population.tracks
        expected = np.empty((len(tracks), *views.rays.shape[1:]))
        for t, track in enumerate(tracks):
            reach_m = self._reach_m(track, now_ns)
            expected[t] = track.predict(now_ns, predicted.get(track.track_id), reach_m)
        free = np.ones(len(views.rays), dtype=bool)
        looking = int(self._looking.sum())
        person, measured = self._matcher.match(views, expected, self._young(), free, looking)
        self._doubt(person, measured, expected, free, now_ns)
        self._absorb(person, measured, expected, now_ns)
        if not self._single and free.any():
            person, measured = self._find(views, person, measured, free, now_ns)
            # Somebody's sensors say how they are posed; else only who is left for the last camera.
            alone = self._looking.sum() == 1
            subjects = {
                track.track_id
                for name, track in self._cast.followed()
                if alone or name in self._vote.heard
            }
            unseen = {
                t: track
                for t, track in enumerate(tracks)
                if track.track_id in subjects and (person[t] < 0).all()
            }
            free[person[person >= 0]] = False
            if unseen:
                find_again(self._rig, views, unseen, person, expected, free, self._options, now_ns)
        follow(self._rig, views, tracks, person, expected, now_ns)
        if self._single:
            person, measured = self._find_single(views, person, measured, expected, now_ns)
        for track, count in zip(tracks, (person >= 0).sum(axis=1).tolist(), strict=True):
            track.views = count or track.views
        elapsed_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        self._population.forget(measured, self._cast.ids(), self._looking, elapsed_ns, now_ns)
        self._cast.forget(self._population.tracks, now_ns)
        everyone = self._population.tracks
        rows = [row for row, track in enumerate(tracks) if track in everyone]
        self._vote.hear(
            [tracks[row] for row in rows], measured[rows], self._readings, elapsed_ns * 1e-9
        )
        if not self._single:
            self._learn(
                [tracks[row] for row in rows], views, person[rows], measured[rows], detections
            )
        self.renumbered, self.renumbered_since_ns = renaming.return_to_way(
            self._cast, everyone, self._vote, now_ns, self._options
        )
        self.notes = self._renumbered_notes("somebody was found where they were going")
        self._admission.admit(everyone, now_ns, self._vote)
        if not self.renumbered:
            self.renumbered = renaming.pair_anew(self._cast, everyone, self._vote, now_ns)
            self.notes = self._renumbered_notes("sensors say so")
        for kind in (looks.CLOTHES, sizes.SIZES):
            if not self.renumbered and self._turns(now_ns):
                self.renumbered, self.renumbered_since_ns = renaming.part_by(
                    self._cast, kind, everyone, now_ns, self._vote
                )
                self.notes += self._renumbered_notes(f"{kind.name} say so")
        self.notes += [
            f"{name}: sensors and cameras contradict each other; either nobody who is seen wears "
            "these sensors, or their bones or headings are not as stated (fusecap calibrate imu)"
            for name in renaming.contradicted(self._cast, self._vote, now_ns, self._options)
        ]
        for track in self._admission.kept_out:
            if not track.told and (now_ns - track.born_ns) * 1e-9 >= self._options.patience_s:
                track.told = True
                self.notes.append(
                    "somebody is left out while a subject is missing: all places are taken "
                    "(max_subjects, or the people who are named)"
                )
        self._population.tracks = [t for t in self._population.tracks if not t.replaced]
        self._last_ns = now_ns
        return self._report(views.local(person), measured, tracks, now_ns)

    # ---------------------------------------------------------------------------------------- cast

    @property
    def returned(self) -> dict[int, tuple[int, int]]:
        """Who at the last instant turned out to be a subject; see `Step.returned`."""
        return self._cast.returned

    def reinitialise(self, name: str = "") -> None:
        """Forget a subject's track, body and start position, so that it is found anew anywhere.

        Without a name everybody is found as at the beginning.
        """
        gone = self._cast.reinitialise(name)
        tracks = self._population.tracks
        self._population.tracks = [track for track in tracks if name and track not in gone]

    def add_subject(self, name: str = "") -> None:
        """Make room for one more person, with a name or `personN`; who was removed may come too.

        Raises `SessionError` for a second person before a single camera.
        """
        self._cast.add(name)
        for track in self._population.tracks:
            track.dismissed = False

    def remove_subject(self, name: str) -> None:
        """Follow a subject no longer; there is one place less."""
        self._cast.remove(name)

    @property
    def is_full(self) -> bool:
        """Every place is taken by somebody who is being followed."""
        return self._cast.is_full

    # --------------------------------------------------------------------------------------- stages

    def _young(self) -> np.ndarray:
        """Newcomers under trial."""
        subjects, tracks = self._cast.ids(), self._population.tracks
        young = [t.track_id not in subjects and not t.is_established(self._options) for t in tracks]
        return np.array(young, dtype=bool)

    def _doubt(
        self,
        person: np.ndarray,
        measured: np.ndarray,
        expected: np.ndarray,
        free: np.ndarray,
        now_ns: int,
    ) -> None:
        """Of few views, what lies where nobody can have gone is two people's, and nobody's then."""
        o, count = self._options, (person >= 0).sum(axis=1)
        for t in np.flatnonzero((count > 1) & (count < o.birth_views)):
            reach_m = self._reach_m(self._population.tracks[t], now_ns)
            if median_apart_m(measured[t], expected[t]) > reach_m:
                free[person[t][person[t] >= 0]] = True
                person[t], measured[t] = -1, np.nan

    def _reach_m(self, track: Track, now_ns: int) -> float:
        """How far from its prediction a track can be."""
        since_s = (now_ns - track.triangulated_ns) * 1e-9
        return self._options.reach_m + self._options.reach_speed_m_s * since_s

    def _absorb(
        self, person: np.ndarray, measured: np.ndarray, expected: np.ndarray, now_ns: int
    ) -> None:
        """Move the tracks on which two views or more agree."""
        count = (person >= 0).sum(axis=1)
        agreed = np.isfinite(measured[:, :, 0]).sum(axis=1) >= MIN_COMMON
        moving = [self._population.tracks[t] for t in np.flatnonzero(agreed)]
        if not moving:
            return
        moved_m = self._anatomy.moved_m(expected[agreed], measured[agreed])
        for row in np.flatnonzero(moved_m > self._options.gate_m):
            self._note_jump(moving[row], expected[agreed][row], measured[agreed][row], now_ns)
        absorb(moving, measured[agreed], expected[agreed], now_ns)
        measure(moving, self._anatomy.limb_lengths(measured[agreed]))
        for track, views in zip(moving, count[agreed], strict=True):
            self._count_frame(track, int(views), now_ns)
        if len(moving) > 1:
            centre = self._anatomy.centre(np.stack([track.landmarks for track in moving]))
            enough = min(self._options.birth_views, int(self._looking.sum()))
            part(moving, count[agreed], centre, self._options.duplicate_m, enough)

    def _note_jump(
        self, track: Track, expected: np.ndarray, found: np.ndarray, now_ns: int
    ) -> None:
        centre, o = self._anatomy.centre, self._options
        known = np.isfinite(found[:, 0]) & np.isfinite(expected[:, 0])
        both = known[:, None]
        hoped_m = centre(np.where(both, expected, np.nan))
        track.note_jump(hoped_m, centre(np.where(both, found, np.nan)), now_ns, o.gate_m, o.doubt_s)

    def _learn(
        self,
        tracks: list[Track],
        views: Views,
        person: np.ndarray,
        measured: np.ndarray,
        detections: Detections,
    ) -> None:
        """What tells people from each other; `person` (t, c) are rows of all views' people."""
        if not tracks:
            return
        now_ns = detections.timestamp_ns
        doubt(tracks, self._anatomy.centre(np.stack([t.landmarks for t in tracks])), now_ns)
        limbs, count = self._anatomy.limb_lengths(measured), (person >= 0).sum(axis=1)
        sizes.learn(tracks, limbs, count, self._options.birth_views, now_ns)
        if detections.appearance is not None:
            looks.learn(tracks, views.local(person), detections.appearance, now_ns)

    def _turns(self, now_ns: int) -> bool:
        """Whether a new stretch of time begins in which clothes are compared."""
        return now_ns // DECIDE_NS != (self._last_ns or 0) // DECIDE_NS

    def _count_frame(self, track: Track, views: int, now_ns: int) -> None:
        if (now_ns - track.triangulated_ns) * 1e-9 > self._options.doubt_s:
            track.may_be_another()
        track.triangulated_ns = now_ns
        track.frames += 1
        enough = self._options.birth_views
        if track.strong_frames < self._options.birth_frames:
            strong = views >= enough or views >= self._cameras_that_see(track.landmarks)
            track.strong_frames += strong

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
        for t, i in self._population.reunite(found, now_ns):
            person[t] = found[i].person
            measured[t] = found[i].landmarks_in_world_m
            track = self._population.tracks[t]
            self._note_jump(track, track.predict(now_ns), measured[t], now_ns)
            self._count_frame(track, int((person[t] >= 0).sum()), now_ns)
            track.restart(measured[t].copy(), now_ns)
            taken.add(i)
        for i, candidate in enumerate(found):
            landmarks = candidate.landmarks_in_world_m
            if i in taken or self._population.is_duplicate(landmarks):
                continue
            person[np.isin(person, candidate.person[candidate.person >= 0])] = -1
            track = self._population.begin(landmarks.copy(), now_ns)
            self._count_frame(track, int((candidate.person >= 0).sum()), now_ns)
            person = np.concatenate([person, candidate.person[None]])
            measured = np.concatenate([measured, landmarks[None]])
        return person, measured

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
        o, tracks = self._options, self._population.tracks
        if not tracks:
            start_m = self._cast.start_m
            if start_m is not None:
                camera = self._rig.cameras[0]
                chosen = nearest_in_view(camera, views, start_m, o.start_radius_m)
                if chosen < 0:
                    return person, measured
            unknown = np.full(views.rays.shape[1:], np.nan)
            track = self._population.begin(unknown, now_ns)
            track.frames = track.strong_frames = o.birth_frames
            person, measured = np.full((1, 1), -1), unknown[None]
        else:
            track = tracks[0]
            lost_s = (now_ns - track.seen_ns) * 1e-9
            if lost_s <= o.tentative_s and np.isfinite(expected).any():
                return person, measured
            track.restart(np.full_like(track.landmarks, np.nan), now_ns)
        person[0, 0] = chosen
        return person, measured

    def _waits(self, track: Track, now_ns: int) -> bool:
        """Whether sensors or clothes may still tell who a newcomer is."""
        age_s = (now_ns - track.born_ns) * 1e-9
        soon = bool(self._vote.heard) and age_s < self._options.patience_s
        return soon or track in self._admission.undecided

    def _renumbered_notes(self, why: str) -> list[str]:
        return [
            f"{name} is somebody else than was followed: {why}"
            for name, track in self._cast.followed()
            if track.track_id in self.renumbered.values()
        ]

    def _report(
        self, person: np.ndarray, measured: np.ndarray, tracks: list[Track], now_ns: int
    ) -> list[TrackUpdate]:
        row = {id(track): r for r, track in enumerate(tracks)}

        def update(track: Track, name: str, state: TrackState) -> TrackUpdate:
            return TrackUpdate(
                track_id=track.track_id,
                name=name,
                state=state,
                person=person[row[id(track)]],
                landmarks_in_world_m=measured[row[id(track)]],
            )

        updates, newcomers, subjects = [], [], self._cast.ids()
        for name, track in self._cast.followed():
            seen = track.seen_ns == now_ns
            updates.append(
                update(track, name, TrackState.CONFIRMED if seen else TrackState.COASTING)
            )
        others = [track for track in self._population.tracks if track.track_id not in subjects]
        if len(updates) < self._cast.size:
            newcomers = [
                track
                for track in others
                if track.strong_frames > 0
                and (not track.is_established(self._options) or self._waits(track, now_ns))
                and self._cast.inside(track)
            ]
        self.bystanders = [
            update(track, "", TrackState.TENTATIVE)
            for track in others
            if self._vote.of_anybody and track not in newcomers
        ]
        return updates + [update(track, "", TrackState.TENTATIVE) for track in newcomers]
