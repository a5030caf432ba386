"""Who is to be tracked: the subjects' places, and the memory of who left one.

A place waits for its first track, is live while that track is followed, and is missing once it is
lost; a newcomer may be who is missing, and then continues under that name and track id.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np

from fusecap.associate.anatomy import Anatomy, size_misfit
from fusecap.associate.looks import CLOTHES, SAME, WAIT_S, by_looks, differences
from fusecap.associate.matching import cheapest
from fusecap.associate.options import TrackerOptions
from fusecap.associate.sensor_vote import FITS, MARGIN, SOON_S, SURE_S, SensorVote
from fusecap.associate.track import Track
from fusecap.associate.traits import Kind, exchange, exchanged
from fusecap.errors import SessionError
from fusecap.geometry.camera import Rig

_BESIDE_M = 0.5
"""From a start: somebody whose torso is as far may stand beside who begins there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """A named person, and where on the floor they begin."""

    name: str
    start_m: tuple[float, float] | None = None
    """World (x, z) at the first instant, or None: whoever is found."""
    sensors: tuple[str, ...] = ()
    """Bones that carry one, in the order of the subject's readings."""


def check_distinct(subjects: Sequence[Subject]) -> None:
    """Raises `SessionError` when two subjects share a name."""
    names = [subject.name for subject in subjects]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise SessionError(f"two subjects are called {', '.join(doubled)}; names must differ")


@dataclass(slots=True, kw_only=True)
class Place:
    """A subject's place in the session: waiting (no track yet), live, or missing."""

    name: str
    named: bool
    start_m: tuple[float, float] | None
    track: Track | None = None
    live: bool = False
    misfit_since_ns: int | None = None
    """Since when sensors say that whoever is followed here does not wear them."""
    told: bool = False
    """Whether a user knows that."""


class Cast:
    """All places of a session, and who may take one."""

    def __init__(
        self,
        subjects: Sequence[Subject],
        rig: Rig,
        anatomy: Anatomy,
        options: TrackerOptions,
        ids: Iterator[int],
    ) -> None:
        """`ids` has numbers that no track bears."""
        check_distinct(subjects)
        self._ids = ids
        self._rig = rig
        self._anatomy = anatomy
        self._options = options
        self._places = [Place(name=s.name, named=True, start_m=s.start_m) for s in subjects]
        self._begun_ns: int | None = None
        self.kept_out: list[Track] = []
        """Who is established and has no place while a subject is missing."""
        self.undecided: list[Track] = []
        """Who may soon turn out to be a missing subject, or to stand beside who begins there."""
        self.returned: dict[int, tuple[int, int]] = {}
        """At this instant, by the id a newcomer had, whose it has, and since when [ns]."""
        self._single = len(rig) == 1
        self.size = options.max_subjects or len(subjects) or sys.maxsize
        """Subjects there may be at most."""
        if self.size < len(subjects):
            raise SessionError(
                f"max_subjects is {self.size}, but {len(subjects)} subjects are named"
            )
        if self._single:
            if 1 < self.size < sys.maxsize:
                raise SessionError(
                    f"one camera cannot tell {self.size} people apart; "
                    "set max_subjects = 1 or add a camera"
                )
            self.size = 1

    @property
    def is_full(self) -> bool:
        """Every place is taken by somebody who is being followed."""
        return sum(place.live for place in self._places) >= self.size

    @property
    def start_m(self) -> tuple[float, float] | None:
        """Where the first subject begins, if it is known."""
        return self._places[0].start_m if self._places else None

    def followed(self) -> list[tuple[str, Track]]:
        """Names and tracks of the live places, in their order."""
        return [(p.name, p.track) for p in self._places if p.live and p.track is not None]

    def ids(self) -> set[int]:
        """Track ids of the live places."""
        return {track.track_id for _, track in self.followed()}

    def reinitialise(self, name: str) -> list[Track | None]:
        """Empty the place of that name, start position included, or all; whoever had them."""
        places = [place for place in self._places if name in ("", place.name)]
        gone = [place.track for place in places]
        for place in places:
            place.track, place.live = None, False
            if name:
                place.start_m = None
        return gone

    def add(self, name: str) -> None:
        """Make room for one more; raises `SessionError` for a second before a single camera."""
        if self._single and self.size > 0:
            raise SessionError("one camera cannot tell two people apart; add a camera")
        if name and all(place.name != name for place in self._places):
            self._places.append(Place(name=name, named=True, start_m=None))
        if self.size < sys.maxsize:
            self.size += 1

    def remove(self, name: str) -> None:
        """Take a place away; whoever was followed there becomes no subject by itself."""
        for place in [place for place in self._places if place.name == name]:
            self._places.remove(place)
            if place.live and place.track is not None:
                place.track.dismissed = True
            if self.size < sys.maxsize:
                self.size -= 1

    def forget(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Places of tracks that are no more are missing, and after a while nobody's."""
        o = self._options
        for place in self._places:
            place.live = place.live and place.track in tracks
        self._places = [
            place
            for place in self._places
            if place.live
            or place.named
            or (place.track and (now_ns - place.track.seen_ns) * 1e-9 <= o.memory_s)
        ]

    def pair_anew(self, tracks: Sequence[Track], vote: SensorVote, now_ns: int) -> dict[int, int]:
        """Give wearers the tracks that their sensors fit, where these are clearly others.

        Everyone who is tracked may be who wears them, and a wearer may be nobody of these: the
        place then waits, as one whom nobody fits does. The identity stays with the place, so who is
        followed under it must be solved anew. Returns, by the id that a track had, the one it has.
        """
        worn = [p for p in self._places if p.name in vote.heard]
        cost = np.array([[vote.misfit(t, p.name, SURE_S) for t in tracks] for p in worn])
        now = [tracks.index(p.track) if p.live and p.track in tracks else -1 for p in worn]
        told = [row for row, t in enumerate(now) if t < 0 or np.isfinite(cost[row, t])]
        if not told or not tracks:
            return {}
        unknown = [t for row, t in enumerate(now) if row not in told]
        cost[:, unknown] = np.inf
        strangers = [t not in [track for _, track in self.followed()] for t in tracks]
        # Who is not followed takes somebody's track only if it can be no other; see `admit`.
        lost = np.flatnonzero(np.array(now) < 0)
        least = np.fmin.reduce(cost[lost], axis=1, initial=np.inf)[:, None]
        alike = (cost[lost] < least + MARGIN).sum(axis=1) > 1
        rivals = (cost[lost] < FITS).sum(axis=0) > 1
        cost[lost] = np.where(alike[:, None] | rivals | np.array(strangers), np.inf, cost[lost])
        nobody = np.full((len(told), len(told)), FITS)
        choice = np.concatenate([np.where(cost < FITS, cost, np.inf)[told], nobody], axis=1)
        best = {told[r]: c if c < len(tracks) else -1 for r, c in cheapest(choice)}
        moves = {row: t for row, t in best.items() if t != now[row]}
        moves = {row: t for row, t in moves.items() if t >= 0 or now[row] in moves.values()}
        gain = sum(
            (cost[row, now[row]] if now[row] >= 0 else FITS) - (cost[row, t] if t >= 0 else FITS)
            for row, t in moves.items()
        )
        if not moves or gain < MARGIN * len(moves):
            return {}
        given = {worn[row].name: tracks[t] for row, t in moves.items() if t >= 0}
        left = [worn[row] for row, t in moves.items() if t < 0]
        known = {p.name: deepcopy(p.track.traits) for p in self._places if p.track}
        renumbered = self._give(given, left, now_ns)
        for name, track in given.items():
            track.continues(known.get(name, {}), now_ns)
        return renumbered

    def part_by(
        self, kind: Kind, tracks: Sequence[Track], now_ns: int, vote: SensorVote
    ) -> tuple[dict[int, int], int]:
        """Put right who came out of an overlap exchanged, as a trait shows; wearers are not asked.

        Returns what `pair_anew` does, and since when it has been so [ns].
        """
        worn = [p.track for p in self._places if p.live and p.name in vote.lately]
        seen = [t for t in tracks if t.seen_ns == now_ns and t not in worn]
        moves = exchanged(kind, seen, now_ns)
        if not moves:
            return {}, now_ns
        since_ns = min(t.traits[kind.name].alone_ns for t in moves)
        body_of = {person: body for body, person in moves.items()}
        exchange(moves)
        places = [p for p in self._places if p.live and p.track in body_of]
        given = {p.name: body_of[p.track] for p in places if p.track}
        return self._give(given, (), now_ns), since_ns

    def _give(self, given: dict[str, Track], left: Sequence[Place], now_ns: int) -> dict[int, int]:
        """Give places other tracks; by the id that a track had, the one it has then.

        The places `left` keep their identity and wait for whom it is; of others that lose a track,
        each gets one that was given up, or waits too.
        """
        followed = {p.name: p.track for p in self._places if p.live and p.track}
        number = {p.name: p.track.track_id for p in self._places if p.track}
        taken = list(given.values())
        freed = [t for name, t in followed.items() if name in given and t not in taken]
        robbed = [p for p in self._places if p.live and p.name not in given and p.track in taken]
        others = [p.name for p in robbed if p not in left]
        given.update({n: freed.pop() for n in others[: len(freed)]})
        left = [p for p in robbed if p.name not in given]
        spare = [track.track_id for track in taken if track not in followed.values()]
        spare += [next(self._ids) for _ in freed[len(spare) :]]
        number.update({n: next(self._ids) for n in given if n not in number})
        renumbered = {t.track_id: number[n] for n, t in given.items()}
        renumbered.update({t.track_id: i for t, i in zip(freed, spare, strict=False)})
        for place in left:
            assert place.track is not None
            place.track, place.live = place.track.unknown(now_ns), False
        for place in self._places:
            if place.name in given:
                place.track, place.live = given[place.name], True
        for track in (*given.values(), *freed):
            track.track_id = renumbered[track.track_id]
            track.may_be_another()
        return renumbered

    def return_to_way(
        self, tracks: Sequence[Track], vote: SensorVote, now_ns: int
    ) -> tuple[dict[int, int], int | None]:
        """Follow whoever goes on where a subject was expected, not whom its track jumped to.

        A track that left its way (`Track.fork`) may have been given somebody else's detections
        while the subject had none; the subject then comes as a newcomer. Returns, by the id that a
        track had, the one it has, and since when.
        """
        o, subjects = self._options, self.ids()
        newcomers = [t for t in tracks if t.track_id not in subjects and self._may_enter(t, now_ns)]
        for place in self._places:
            track = place.track
            if not place.live or track is None or track.fork is None:
                continue
            if vote.misfit(track, place.name, SOON_S) < FITS:
                continue
            fork, best = track.fork, None
            nearest_m = fork.jump_m - o.candidates.consistency_m
            for other in newcomers:
                after_s = (other.born_ns - fork.at_ns) * 1e-9
                away_m = fork.away_m(other.born_m, other.born_ns)
                if 0.0 <= after_s <= o.doubt_s and away_m < nearest_m:
                    best, nearest_m = other, away_m
            if best is not None:
                former, own = best.track_id, track.track_id
                track.exchange(best)
                place.track = best
                return {former: own, own: former}, fork.at_ns
        return {}, None

    def contradicted(self, vote: SensorVote, now_ns: int) -> list[str]:
        """Wearers whom their sensors have not fitted for `patience_s`; each is named once."""
        found = []
        for place in self._places:
            track = place.track if place.live else None
            misfit = vote.misfit(track, place.name, SURE_S) if track else np.nan
            if misfit < FITS:
                place.misfit_since_ns, place.told = None, False
            elif np.isfinite(misfit):
                if place.misfit_since_ns is None:
                    place.misfit_since_ns = now_ns
                for_s = (now_ns - place.misfit_since_ns) * 1e-9
                if for_s >= self._options.patience_s and not place.told:
                    place.told = True
                    found.append(place.name)
        return found

    def admit(self, tracks: Sequence[Track], now_ns: int, vote: SensorVote) -> None:
        """Give established newcomers inside the volume a subject's place while there is one.

        Whoever appears where a subject may be whom no two views see waits a moment: either the
        subject is measured again, or the newcomer is who the subject was.
        """
        o, subjects = self._options, self.ids()
        if self._begun_ns is None:
            self._begun_ns = now_ns
        for place in self._places:
            if place.name in vote.heard and (now_ns - self._begun_ns) * 1e-9 > o.patience_s:
                place.start_m = None
        self.kept_out, self.undecided, self.returned = [], [], {}
        strangers = [t for t in tracks if t.track_id not in subjects and self._is_there(t, now_ns)]
        away = [p for p in self._places if p.name in vote.heard and self._is_away(p, now_ns)]
        named = self._admit_wearers(strangers, away, tracks, vote)
        newcomers = [t for t in strangers if t.is_established(o) and t not in named]
        gone = [p for p in away if p.track and p.track not in named]
        early = self._early(newcomers, gone, tracks, now_ns)
        if early:
            others = [t for t in early if all(self._away(t, p, vote) >= FITS for p in gone)]
            newcomers = [t for t in newcomers if t not in early or t in others]
        known = [p for p in self._places if p.track or p.start_m]
        away = self._by_clothes(newcomers, known, now_ns, vote)
        self.undecided = [
            t for n, t in enumerate(newcomers) if self._hidden(t, away[n], known, now_ns)
        ]
        away = away[[t not in self.undecided for t in newcomers]]
        newcomers = [t for t in newcomers if t not in self.undecided]
        if not newcomers:
            return
        cost = np.array(
            [
                [self._claim(t, p, alike=bool(away[n, k] < SAME)) for k, p in enumerate(known)]
                for n, t in enumerate(newcomers)
            ]
        )
        cost = np.where(by_looks(away), cost.reshape(len(newcomers), len(known)), np.inf)
        cost[np.ix_([t in early for t in newcomers], [p in gone for p in known])] = np.inf
        for n, k in np.argwhere(np.isfinite(cost)).tolist():
            if known[k].track is None and self._contradicts(newcomers[n], known[k], vote, now_ns):
                cost[n, k] = np.inf
        open_s = [o.doubt_s if p.live else 0.0 for p in known]
        silent_s = [(now_ns - p.track.triangulated_ns) * 1e-9 if p.track else 0.0 for p in known]
        undecided = np.tile(np.array(silent_s) < np.array(open_s), (len(newcomers), 1))
        if (now_ns - self._begun_ns) * 1e-9 < o.two_view_birth_s:
            # Who begins there may be found later than who stands beside.
            begin = np.array([p.track is None for p in known], dtype=bool)
            at_start = (begin & (cost <= _BESIDE_M)).any(axis=1, keepdims=True)
            beside = begin & np.isfinite(cost) & (cost > _BESIDE_M)
            cost = np.where(beside & at_start, np.inf, cost)
            beside &= ~at_start
            self.undecided += [newcomers[n] for n in np.flatnonzero(beside.any(axis=1))]
            undecided |= beside
        settled = ~(np.isfinite(cost) & undecided).any(axis=1)
        newcomers = [newcomers[n] for n in np.flatnonzero(settled)]
        cost = np.where(undecided, np.inf, cost)[settled]
        admitted = cheapest(cost)
        for n, p in admitted:
            self._admit_to(known[p], newcomers[n], tracks)
        rest = [t for n, t in enumerate(newcomers) if n not in dict(admitted)]
        rest.sort(key=lambda t: (-t.frames, self._from_middle(t)))
        waiting = [p for p in self._places if not (p.live or p.track or p.start_m)]
        worn = [p for p in waiting if p.name in vote.heard]
        early = self._early(rest, worn, tracks, now_ns)
        rest = [track for track in rest if track not in early]
        chosen = rest[: len(waiting) + max(self._room(), 0)]
        if any(p.track and not p.live for p in self._places):
            self.kept_out = [track for track in rest if track not in chosen]
        for track in sorted(chosen, key=lambda t: t.track_id):
            if not waiting:
                waiting.append(Place(name=self._free_name(), named=False, start_m=None))
                self._places.append(waiting[0])
            self._admit_to(waiting.pop(0), track, tracks)

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
                self._admit_to(worn[w], strangers[n], tracks)
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
        optional = place.live or self._room() > 0 or any(p.track is None for p in self._places)
        sized = not place.live or min(track.frames, lost.frames) >= o.size_frames
        tolerance = 2 * o.size_tolerance if alike else o.size_tolerance
        if optional and ((sized and misfit > tolerance) or away > reach):
            return np.inf
        return float(away / reach + misfit / o.size_tolerance)

    def _from_start_m(self, track: Track, place: Place) -> float:
        """How far from where a subject can have gone from its start a newcomer was first seen.

        0 where nobody knows.
        """
        if place.start_m is None or self._single:
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

    def _admit_to(self, place: Place, track: Track, everyone: Sequence[Track]) -> None:
        """A place that was live is handed over: nobody follows there whom it had any more."""
        if place.track is not None:
            # Until it was last measured there, it was somebody else's way that the newcomer went.
            since_ns = max(track.born_ns, place.track.triangulated_ns)
            self.returned[track.track_id] = (place.track.track_id, since_ns)
            if place.live:
                place.track.replaced = True
            track.becomes(place.track, everyone)
            track.continues(place.track.traits, since_ns)
        place.track = track
        place.live = True

    def _is_there(self, track: Track, now_ns: int) -> bool:
        """Whether somebody is seen now, within the volume, who was not said to be no subject."""
        return not track.dismissed and track.seen_ns == now_ns and self.inside(track)

    def _may_enter(self, track: Track, now_ns: int) -> bool:
        """Whether somebody is there now who may become a subject."""
        return self._is_there(track, now_ns) and track.is_established(self._options)

    def inside(self, track: Track) -> bool:
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
        return self.size - len(self._places)

    def _free_name(self) -> str:
        taken = {place.name for place in self._places}
        number = 1
        while f"person{number}" in taken:
            number += 1
        return f"person{number}"
