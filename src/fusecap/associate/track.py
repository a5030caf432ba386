"""One person over time, as the tracker knows them between two solves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from fusecap.associate.options import TrackerOptions
from fusecap.associate.traits import Trait
from fusecap.kernels import association as kernels

POSITION_GAIN = 0.8
"""Share of a triangulated landmark's news that is believed; the rest is detector noise."""
VELOCITY_GAIN = 0.4
"""Share of one interval's velocity that enters the running one."""
EXTRAPOLATION_S = 0.5
"""Velocity is worth this long: about a step of walking. Later a track waits where it is."""


SURELY_APART = 3.0
"""Instants: two skeletons of three views each do not lie thrice."""
FEW_VIEWS_APART = 0.2
"""What an instant counts in which one of the two rests on two views: these can be of two people."""


class Fork(NamedTuple):
    """Where a track left its way: either the person jumped, or somebody else is followed since."""

    at_ns: int
    expected_m: np.ndarray
    """Torso (3,) as it would have gone on."""
    velocity_m_s: np.ndarray
    jump_m: float

    def away_m(self, torso_m: np.ndarray, now_ns: int) -> float:
        """How far a torso (3,) is from where the way would have led until `now_ns`."""
        ahead_s = min((now_ns - self.at_ns) * 1e-9, EXTRAPOLATION_S)
        return float(np.linalg.norm(torso_m - self.expected_m - ahead_s * self.velocity_m_s))


class Track:
    """Landmarks with constant velocity, what was seen of them, and the body's measure."""

    __slots__ = (
        "alone_ns",
        "beside",
        "born_m",
        "born_ns",
        "dismissed",
        "fork",
        "frames",
        "landmarks",
        "limb_count",
        "limb_sum_m",
        "missed_ns",
        "overlap_since_ns",
        "replaced",
        "seen_ns",
        "strong_frames",
        "time_ns",
        "told",
        "track_id",
        "traits",
        "triangulated_ns",
        "velocity",
        "views",
    )

    def __init__(
        self,
        track_id: int,
        landmarks: np.ndarray,
        centre_m: np.ndarray,
        limb_lengths_m: np.ndarray,
        now_ns: int,
    ) -> None:
        self.track_id = track_id
        self.born_m = centre_m
        """Where the torso was first seen (3,)."""
        self.born_ns = self.seen_ns = self.triangulated_ns = self.time_ns = now_ns
        self.landmarks = landmarks
        """At `time_ns` in the world [m] (k, 3), NaN where never seen."""
        self.velocity = np.zeros(landmarks.shape)
        self.frames = 0
        """Updates in which at least two views agreed."""
        self.strong_frames = 0
        """Those of them in which enough views for a birth did."""
        self.limb_count = np.isfinite(limb_lengths_m).astype(np.float64)
        self.limb_sum_m = np.nan_to_num(limb_lengths_m)
        self.overlap_since_ns: int | None = None
        """Since when it has shared its place with another track."""
        self.missed_ns = 0
        """For how long enough cameras have looked and not seen it."""
        self.alone_ns = 0
        """For how long two cameras or more have looked and no two seen it."""
        self.beside: dict[Track, float] = {}
        """Instants in which it and another were measured apart; of few views each counts less."""
        self.traits: dict[str, Trait] = {}
        """By kind, what tells this person from others."""
        self.told = False
        """Whether a user knows that this person is left out."""
        self.replaced = False
        """Whether another track turned out to be who this one was thought to be."""
        self.dismissed = False
        """Whether it was said not to be a subject."""
        self.views = 0
        """Of which it was given detections last."""
        self.fork: Fork | None = None
        """Its last jump."""

    def predict(
        self, now_ns: int, solved: np.ndarray | None = None, reach_m: float = np.inf
    ) -> np.ndarray:
        """Landmarks [m] now: the solver's where it gives them, else extrapolated.

        A pose of one view farther than `reach_m` from where the track can be is no prediction:
        its depth is a guess.
        """
        ahead_s = min((now_ns - self.time_ns) * 1e-9, EXTRAPOLATION_S)
        own = self.landmarks + self.velocity * ahead_s
        if solved is None or (self.views == 1 and median_apart_m(solved, own) > reach_m):
            return own
        return np.where(np.isnan(solved), own, solved)

    def note_jump(
        self, expected_m: np.ndarray, found_m: np.ndarray, now_ns: int, gate_m: float, keep_s: float
    ) -> None:
        """Remember where a torso (3,) was expected that is found more than `gate_m` away.

        What is younger than `keep_s` stays: the way was left then.
        """
        jump_m = float(np.linalg.norm(found_m - expected_m))
        if jump_m > gate_m and (self.fork is None or now_ns - self.fork.at_ns > keep_s * 1e9):
            known = np.isfinite(self.velocity[:, 0])
            velocity = self.velocity[known].mean(axis=0) if known.any() else np.zeros(3)
            self.fork = Fork(now_ns, expected_m, velocity, jump_m)

    def restart(self, measured: np.ndarray, now_ns: int) -> None:
        """Begin anew where the person was found again."""
        self.landmarks = measured
        self.velocity = np.zeros(measured.shape)
        self.time_ns = self.seen_ns = self.triangulated_ns = now_ns

    def settle(self, landmarks: np.ndarray, now_ns: int) -> None:
        """Stand still where one view found the person again."""
        self.landmarks = landmarks
        self.velocity = np.zeros(landmarks.shape)
        self.time_ns = self.seen_ns = now_ns

    def wait(self, now_ns: int, elapsed_ns: int, looking: int, enough: int) -> None:
        """Count the time since the last instant, while `looking` cameras looked, as unseen.

        What fewer than `enough` cameras could see is no absence, and one camera that is left
        cannot triangulate.
        """
        if self.seen_ns == now_ns:
            self.missed_ns = 0
        elif looking >= enough:
            self.missed_ns += elapsed_ns
        if self.triangulated_ns == now_ns:
            self.alone_ns = 0
        elif looking > 1:
            self.alone_ns += elapsed_ns

    def is_other_than(self, other: Track) -> bool:
        """Whether the two were measured apart at once, and so are two people."""
        return self.beside.get(other, 0.0) >= SURELY_APART

    def becomes(self, old: Track, everyone: Sequence[Track]) -> None:
        """Take over the identity of a track that lost this person; who was not it still is not."""
        self.track_id = old.track_id
        self.limb_sum_m += old.limb_sum_m
        self.limb_count += old.limb_count
        for other in everyone:
            if old in other.beside and other is not self:
                met = max(other.beside[old], other.beside.get(self, 0.0))
                other.beside[self] = self.beside[other] = met

    def exchange(self, newcomer: Track) -> None:
        """Give a newcomer identity and size; who is followed here since the fork is another."""
        self.track_id, newcomer.track_id = newcomer.track_id, self.track_id
        newcomer.limb_sum_m += self.limb_sum_m
        newcomer.limb_count += self.limb_count
        self.limb_sum_m, self.limb_count = self.limb_sum_m * 0.0, self.limb_count * 0.0
        newcomer.continues(self.traits, newcomer.born_ns)
        self.traits, self.fork, newcomer.fork = {}, None, None
        self.may_be_another()

    def continues(self, known: Mapping[str, Trait], since_ns: int) -> None:
        """Be, since then, whom these traits are of; what was seen of it is held against them."""
        for name in self.traits.keys() & known.keys():
            self.traits[name].continues(known[name], since_ns)

    def may_be_another(self) -> None:
        """It follows somebody else now, or may: whom it was measured beside says nothing."""
        for other in self.beside:
            other.beside.pop(self, None)
        self.beside = {}

    def unknown(self, now_ns: int) -> Track:
        """The identity alone, of somebody who turned out not to be whom this followed."""
        nowhere = np.full(self.landmarks.shape, np.nan)
        sizes = np.full(self.limb_sum_m.shape, np.nan)
        return Track(self.track_id, nowhere, np.full(3, np.nan), sizes, now_ns)

    def is_established(self, options: TrackerOptions) -> bool:
        """Whether enough views saw it for long enough to be a person."""
        lasted_s = (self.triangulated_ns - self.born_ns) * 1e-9
        return self.strong_frames >= options.birth_frames or (
            self.frames >= options.birth_frames and lasted_s >= options.two_view_birth_s
        )

    def limb_lengths_m(self) -> np.ndarray:
        """Mean limb lengths [m] (m,); NaN where never seen."""
        count = np.where(self.limb_count > 0, self.limb_count, np.nan)
        return self.limb_sum_m / count


def median_apart_m(a: np.ndarray, b: np.ndarray) -> float:
    """Median distance [m] of common landmarks of two skeletons (k, 3); NaN without any."""
    away_m = np.linalg.norm(a - b, axis=1)
    away_m = away_m[np.isfinite(away_m)]
    return float(np.median(away_m)) if len(away_m) else np.nan


def measure(tracks: Sequence[Track], limb_lengths_m: np.ndarray) -> None:
    """Take limb lengths [m] (t, m) into the means; NaN where not seen."""
    known = np.isfinite(limb_lengths_m)
    lengths = np.where(known, limb_lengths_m, 0.0)
    for t, track in enumerate(tracks):
        track.limb_sum_m += lengths[t]
        track.limb_count += known[t]


def part(
    tracks: Sequence[Track], views: np.ndarray, centre_m: np.ndarray, apart_m: float, enough: int
) -> None:
    """Note who is measured beside whom: tracks, the `views` (t,) they rest on, torsos (t, 3).

    Those farther than `apart_m` from each other, of `enough` views each, are two people.
    """
    away_m = np.linalg.norm(centre_m[:, None] - centre_m[None], axis=2)
    for a, b in zip(*np.nonzero(np.triu(away_m > apart_m, 1)), strict=True):
        first, second = tracks[a], tracks[b]
        met = first.beside.get(second, 0.0)
        if met < SURELY_APART:
            strong = min(views[a], views[b]) >= enough
            first.beside[second] = second.beside[first] = met + (1.0 if strong else FEW_VIEWS_APART)


def absorb(
    tracks: Sequence[Track], measured: np.ndarray, predicted: np.ndarray, now_ns: int
) -> None:
    """Move tracks to what was measured (t, k, 3); landmarks without news go along with the body."""
    landmarks = np.array([track.landmarks for track in tracks])
    velocity = np.array([track.velocity for track in tracks])
    dt_s = np.array([(now_ns - track.time_ns) * 1e-9 for track in tracks])
    kernels.move_tracks(
        measured, predicted, dt_s, POSITION_GAIN, VELOCITY_GAIN, landmarks, velocity
    )
    for t, track in enumerate(tracks):
        track.landmarks, track.velocity = landmarks[t], velocity[t]
        track.time_ns = track.seen_ns = now_ns
