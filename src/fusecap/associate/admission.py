"""Who of the people that are tracked takes a subject's place.

A newcomer may be a subject whom nobody found yet, or one who is missing and then continues under
that name and track id. Sensors say it first, then clothes, then place, size and order of birth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusecap.associate.anatomy import Anatomy, size_misfit
from fusecap.associate.looks import CLOTHES, SAME, WAIT_S, by_looks, differences
from fusecap.associate.matching import cheapest
from fusecap.associate.options import TrackerOptions
from fusecap.associate.sensor_vote import FITS, MARGIN, SOON_S, SensorVote
from fusecap.associate.subjects import Cast, Place
from fusecap.associate.track import Track
from fusecap.geometry.camera import Rig

_BESIDE_M = 0.5
"""From a start: somebody whose torso is as far may stand beside who begins there."""


class Admission:
    """Gives places of a cast to tracks."""

    def __init__(self, cast: Cast, rig: Rig, anatomy: Anatomy, options: TrackerOptions) -> None:
        self._cast = cast
        self._rig = rig
        self._anatomy = anatomy
        self._options = options
        self._begun_ns: int | None = None
        self.kept_out: list[Track] = []
        """Who is established and has no place while a subject is missing."""
        self.undecided: list[Track] = []
        """Who may soon turn out to be a missing subject, or to stand beside who begins there."""

    def admit(self, tracks: Sequence[Track], now_ns: int, vote: SensorVote) -> None:
        """Give established newcomers inside the volume a subject's place while there is one.

        Whoever appears where a subject may be whom no two views see waits a moment: either the
        subject is measured again, or the newcomer is who the subject was.
        """
        if self._begun_ns is None:
            self._begun_ns = now_ns
        for place in self._cast.places:
            long = (now_ns - self._begun_ns) * 1e-9 > self._options.patience_s
            if place.name in vote.heard and long:
                place.start_m = None
        self.kept_out, self.undecided, self._cast.returned = [], [], {}
        subjects = self._cast.ids()
        strangers = [
            t for t in tracks if t.track_id not in subjects and self._cast.is_there(t, now_ns)
        ]
        away = [p for p in self._cast.places if p.name in vote.heard and self._is_away(p, now_ns)]
        named = self._admit_wearers(strangers, away, tracks, vote)
        newcomers = [t for t in strangers if t.is_established(self._options) and t not in named]
        gone = [p for p in away if p.track and p.track not in named]
        early = self._early(newcomers, gone, tracks, now_ns)
        others = [t for t in early if all(self._away(t, p, vote) >= FITS for p in gone)]
        newcomers = [t for t in newcomers if t not in early or t in others]
        rest = self._admit_known(newcomers, (others, gone), tracks, vote, now_ns)
        self._admit_rest(rest, tracks, vote, now_ns)

    def _admit_known(
        self,
        newcomers: Sequence[Track],
        barred: tuple[Sequence[Track], Sequence[Place]],
        tracks: Sequence[Track],
        vote: SensorVote,
        now_ns: int,
    ) -> list[Track]:
        """Give places of who is missing, or begins somewhere; returns who may be anybody else.

        The `barred` tracks cannot be who had the places beside them.
        """
        known = [p for p in self._cast.places if p.track or p.start_m]
        looks = self._by_clothes(newcomers, known, now_ns, vote)
        hidden = [self._hidden(t, looks[n], known, now_ns) for n, t in enumerate(newcomers)]
        self.undecided = [t for t, is_hidden in zip(newcomers, hidden, strict=True) if is_hidden]
        newcomers = [t for t in newcomers if t not in self.undecided]
        if not newcomers:
            return []
        looks = looks[~np.array(hidden)]
        cost = np.array(
            [
                [self._claim(t, p, alike=bool(looks[n, k] < SAME)) for k, p in enumerate(known)]
                for n, t in enumerate(newcomers)
            ]
        )
        cost = np.where(by_looks(looks), cost.reshape(len(newcomers), len(known)), np.inf)
        cost[np.ix_([t in barred[0] for t in newcomers], [p in barred[1] for p in known])] = np.inf
        for n, k in np.argwhere(np.isfinite(cost)).tolist():
            if known[k].track is None and self._contradicts(newcomers[n], known[k], vote, now_ns):
                cost[n, k] = np.inf
        cost, settled = self._settled(cost, newcomers, known, now_ns)
        newcomers = [newcomers[n] for n in settled.tolist()]
        admitted = dict(cheapest(cost[settled]))
        for n, p in admitted.items():
            self._cast.admit(known[p], newcomers[n], tracks)
        return [t for n, t in enumerate(newcomers) if n not in admitted]

    def _settled(
        self, cost: np.ndarray, newcomers: Sequence[Track], known: Sequence[Place], now_ns: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Costs (n, p) without places that are not decided yet, and which newcomers need not wait.

        A subject may still be measured again, and who begins somewhere may be found later than who
        stands beside.
        """
        open_s = [self._options.doubt_s if p.live else 0.0 for p in known]
        silent_s = [(now_ns - p.track.triangulated_ns) * 1e-9 if p.track else 0.0 for p in known]
        undecided = np.tile(np.array(silent_s) < np.array(open_s), (len(newcomers), 1))
        if (now_ns - (self._begun_ns or 0)) * 1e-9 < self._options.two_view_birth_s:
            begin = np.array([p.track is None for p in known], dtype=bool)
            at_start = (begin & (cost <= _BESIDE_M)).any(axis=1, keepdims=True)
            beside = begin & np.isfinite(cost) & (cost > _BESIDE_M)
            cost = np.where(beside & at_start, np.inf, cost)
            beside &= ~at_start
            waiting = np.flatnonzero(beside.any(axis=1)).tolist()
            self.undecided += [newcomers[n] for n in waiting]
            undecided |= beside
        waits = (np.isfinite(cost) & undecided).any(axis=1)
        return np.where(undecided, np.inf, cost), np.flatnonzero(~waits)

    def _admit_rest(
        self, rest: list[Track], tracks: Sequence[Track], vote: SensorVote, now_ns: int
    ) -> None:
        """Give places of whom nothing is known, and new ones, to who is there for the longest."""
        rest = sorted(rest, key=lambda t: (-t.frames, self._from_middle(t)))
        waiting = [p for p in self._cast.places if not (p.live or p.track or p.start_m)]
        worn = [p for p in waiting if p.name in vote.heard]
        early = self._early(rest, worn, tracks, now_ns)
        rest = [track for track in rest if track not in early]
        chosen = rest[: len(waiting) + max(self._cast.room(), 0)]
        if any(p.track and not p.live for p in self._cast.places):
            self.kept_out = [track for track in rest if track not in chosen]
        for track in sorted(chosen, key=lambda t: t.track_id):
            if not waiting:
                waiting.append(Place(name=self._cast.free_name(), named=False, start_m=None))
                self._cast.places.append(waiting[0])
            self._cast.admit(waiting.pop(0), track, tracks)

    def _admit_wearers(
        self,
        strangers: Sequence[Track],
        worn: Sequence[Place],
        tracks: Sequence[Track],
        vote: SensorVote,
    ) -> list[Track]:
        """Give places of whoever wears sensors to whom these fit by a margin; returns whom.

        That says more than how many views saw somebody: nobody need be established for it.
        """
        if not worn or not strangers:
            return []
        cost = np.array([[self._away(t, p, vote) for p in worn] for t in strangers])
        named = []
        for n, w in cheapest(np.where(cost < FITS, cost, np.inf)):
            others = np.concatenate([np.delete(cost[n], w), np.delete(cost[:, w], n)])
            if not (others < cost[n, w] + MARGIN).any():
                self._cast.admit(worn[w], strangers[n], tracks)
                named.append(strangers[n])
        return named

    def _early(
        self,
        newcomers: Sequence[Track],
        worn: Sequence[Place],
        tracks: Sequence[Track],
        now_ns: int,
    ) -> list[Track]:
        """Who is too young for these wearers' places, as sensors may still tell who it is.

        Later they are admitted like everybody; who was mistaken is paired anew.
        """
        if not worn or len(tracks) == len(worn) == 1:
            return []
        return [t for t in newcomers if now_ns - t.born_ns < self._options.patience_s * 1e9]

    def _contradicts(self, track: Track, place: Place, vote: SensorVote, now_ns: int) -> bool:
        """Whether sensors say that a young newcomer is not who begins at this place."""
        young = now_ns - track.born_ns < self._options.patience_s * 1e9
        return young and vote.misfit(track, place.name, SOON_S) >= FITS

    def _away(self, track: Track, place: Place, vote: SensorVote) -> float:
        """How badly a newcomer fits a wearer's sensors; infinite: is known to be somebody else.

        Whom the sensors did not fit either, who was followed there, is no evidence.
        """
        was = place.track if place.misfit_since_ns is None else None
        if was is not None and track.is_other_than(was):
            return np.inf
        if place.track is None and self._from_start_m(track, place) > _BESIDE_M:
            return np.inf
        return vote.misfit(track, place.name, SOON_S)

    def _by_clothes(
        self, newcomers: Sequence[Track], places: Sequence[Place], now_ns: int, vote: SensorVote
    ) -> np.ndarray:
        """How differently newcomers and who had a place look (n, p); NaN where nothing tells.

        Sensors tell better, and after a while people may have changed.
        """
        away = np.full((len(newcomers), len(places)), np.nan)
        told = [
            k
            for k, p in enumerate(places)
            if p.track is not None
            and CLOTHES.name in p.track.traits
            and p.name not in vote.heard
            and (now_ns - p.track.seen_ns) * 1e-9 <= self._options.memory_s
        ]
        shown = [n for n, t in enumerate(newcomers) if CLOTHES.name in t.traits]
        looks = [
            p.track.traits[CLOTHES.name] for k, p in enumerate(places) if k in told and p.track
        ]
        away[np.ix_(shown, told)] = differences(
            [newcomers[n].traits[CLOTHES.name] for n in shown], looks
        )
        return away

    def _hidden(self, track: Track, away: np.ndarray, places: Sequence[Place], now_ns: int) -> bool:
        """Whether clothes may soon tell if a newcomer is somebody who is missing."""
        if CLOTHES.name not in track.traits or (now_ns - track.born_ns) * 1e-9 >= WAIT_S:
            return False
        told = [
            not p.live
            and p.track is not None
            and CLOTHES.name in p.track.traits
            and p.track.traits[CLOTHES.name].is_known
            for p in places
        ]
        return bool((np.isnan(away) & np.array(told, dtype=bool)).any())

    def _claim(self, track: Track, place: Place, *, alike: bool) -> float:
        """How badly a newcomer fits a waiting or missing subject [m]; infinite: not at all.

        Of who is dressed `alike` size says less.
        """
        o = self._options
        if place.track is None:
            away = self._from_start_m(track, place)
            return away if away < o.start_radius_m else np.inf
        lost = place.track
        doubtful = lost.triangulated_ns < track.born_ns
        if track.is_other_than(lost) or (place.live and not doubtful):
            return np.inf
        expected = self._anatomy.centre(lost.predict(track.born_ns))
        away = np.nan_to_num(np.linalg.norm(track.born_m - expected))
        if np.isnan(expected).all():
            return 2.0  # Nothing is known but the name: whoever is known goes first.
        misfit = size_misfit(lost.limb_lengths_m(), track.limb_lengths_m())
        since_s = max(track.born_ns - lost.triangulated_ns, 0) * 1e-9
        reach = o.reach_m + 2 * o.reach_speed_m_s * since_s
        optional = (
            place.live or self._cast.room() > 0 or any(p.track is None for p in self._cast.places)
        )
        sized = not place.live or min(track.frames, lost.frames) >= o.size_frames
        tolerance = 2 * o.size_tolerance if alike else o.size_tolerance
        if optional and ((sized and misfit > tolerance) or away > reach):
            return np.inf
        return float(away / reach + misfit / o.size_tolerance)

    def _from_start_m(self, track: Track, place: Place) -> float:
        """How far from where a subject can have gone from its start a newcomer was first seen.

        0 where nobody knows.
        """
        if place.start_m is None or self._cast.single:
            return 0.0  # One camera gives no place to compare with.
        centre = self._anatomy.centre(track.landmarks)
        first_m = np.where(np.isfinite(track.born_m), track.born_m, centre)
        away_m = float(np.hypot(first_m[0] - place.start_m[0], first_m[2] - place.start_m[1]))
        since_s = max(track.born_ns - (self._begun_ns or 0), 0) * 1e-9
        if since_s > self._options.patience_s:
            return away_m  # Who comes later comes to the start.
        return max(away_m - self._options.reach_speed_m_s * since_s, 0.0)

    @staticmethod
    def _is_away(place: Place, now_ns: int) -> bool:
        """Whether a subject is not there, or will not be unless somebody sees it again."""
        track = place.track
        return track is None or not place.live or now_ns - track.seen_ns > SOON_S * 1e9

    def _from_middle(self, track: Track) -> float:
        """Distance on the floor [m] to the middle of the volume, or of where the cameras look."""
        centre = self._anatomy.centre(track.landmarks)[[0, 2]]
        if self._options.volume_m is None:
            middle = np.mean([c.position_in_world[[0, 2]] for c in self._rig.cameras], axis=0)
        else:
            x_min, x_max, z_min, z_max = self._options.volume_m
            middle = np.array([x_min + x_max, z_min + z_max]) / 2
        return float(np.linalg.norm(centre - middle))
