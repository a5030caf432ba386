"""Who is to be tracked: the subjects' places, and the memory of who left one.

A place waits for its first track, is live while that track is followed, and is missing once it is
lost. Who takes one is decided in `admission.py`, who turned out to be another in `renaming.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from fusecap.associate.anatomy import Anatomy
from fusecap.associate.options import TrackerOptions
from fusecap.associate.track import Track
from fusecap.errors import SessionError
from fusecap.geometry.camera import Rig


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
    """All places of a session."""

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
        self._anatomy = anatomy
        self._options = options
        self.places = [Place(name=s.name, named=True, start_m=s.start_m) for s in subjects]
        self.returned: dict[int, tuple[int, int]] = {}
        """At this instant, by the id a newcomer had, whose it has, and since when [ns]."""
        self.single = len(rig) == 1
        self.size = options.max_subjects or len(subjects) or sys.maxsize
        """Subjects there may be at most."""
        if self.size < len(subjects):
            raise SessionError(
                f"max_subjects is {self.size}, but {len(subjects)} subjects are named"
            )
        if self.single:
            if 1 < self.size < sys.maxsize:
                raise SessionError(
                    f"one camera cannot tell {self.size} people apart; "
                    "set max_subjects = 1 or add a camera"
                )
            self.size = 1

    @property
    def is_full(self) -> bool:
        """Every place is taken by somebody who is being followed."""
        return sum(place.live for place in self.places) >= self.size

    @property
    def start_m(self) -> tuple[float, float] | None:
        """Where the first subject begins, if it is known."""
        return self.places[0].start_m if self.places else None

    def followed(self) -> list[tuple[str, Track]]:
        """Names and tracks of the live places, in their order."""
        return [(p.name, p.track) for p in self.places if p.live and p.track is not None]

    def ids(self) -> set[int]:
        """Track ids of the live places."""
        return {track.track_id for _, track in self.followed()}

    def reinitialise(self, name: str) -> list[Track | None]:
        """Empty the place of that name, start position included, or all; whoever had them."""
        places = [place for place in self.places if name in ("", place.name)]
        gone = [place.track for place in places]
        for place in places:
            place.track, place.live = None, False
            if name:
                place.start_m = None
        return gone

    def add(self, name: str) -> None:
        """Make room for one more; raises `SessionError` for a second before a single camera."""
        if self.single and self.size > 0:
            raise SessionError("one camera cannot tell two people apart; add a camera")
        if name and all(place.name != name for place in self.places):
            self.places.append(Place(name=name, named=True, start_m=None))
        if self.size < sys.maxsize:
            self.size += 1

    def remove(self, name: str) -> None:
        """Take a place away; whoever was followed there becomes no subject by itself."""
        for place in [place for place in self.places if place.name == name]:
            self.places.remove(place)
            if place.live and place.track is not None:
                place.track.dismissed = True
            if self.size < sys.maxsize:
                self.size -= 1

    def forget(self, tracks: Sequence[Track], now_ns: int) -> None:
        """Places of tracks that are no more are missing, and after a while nobody's."""
        o = self._options
        for place in self.places:
            place.live = place.live and place.track in tracks
        self.places = [
            place
            for place in self.places
            if place.live
            or place.named
            or (place.track and (now_ns - place.track.seen_ns) * 1e-9 <= o.memory_s)
        ]

    def admit(self, place: Place, track: Track, everyone: Sequence[Track]) -> None:
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

    def give(self, given: dict[str, Track], left: Sequence[Place], now_ns: int) -> dict[int, int]:
        """Give places other tracks; by the id that a track had, the one it has then.

        The places `left` keep their identity and wait for whom it is; of others that lose a track,
        each gets one that was given up, or waits too.
        """
        followed = {p.name: p.track for p in self.places if p.live and p.track}
        number = {p.name: p.track.track_id for p in self.places if p.track}
        taken = list(given.values())
        freed = [t for name, t in followed.items() if name in given and t not in taken]
        robbed = [p for p in self.places if p.live and p.name not in given and p.track in taken]
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
        for place in self.places:
            if place.name in given:
                place.track, place.live = given[place.name], True
        for track in (*given.values(), *freed):
            track.track_id = renumbered[track.track_id]
            track.may_be_another()
        return renumbered

    def is_there(self, track: Track, now_ns: int) -> bool:
        """Whether somebody is seen now, within the volume, who was not said to be no subject."""
        return not track.dismissed and track.seen_ns == now_ns and self.inside(track)

    def may_enter(self, track: Track, now_ns: int) -> bool:
        """Whether somebody is there now who may become a subject."""
        return self.is_there(track, now_ns) and track.is_established(self._options)

    def inside(self, track: Track) -> bool:
        """Whether the torso is over the capture volume; an unknown place is."""
        if self._options.volume_m is None:
            return True
        x_min, x_max, z_min, z_max = self._options.volume_m
        x, _, z = self._anatomy.centre(track.landmarks)
        return not (x < x_min or x > x_max or z < z_min or z > z_max)

    def room(self) -> int:
        """How many more subjects there may be."""
        return self.size - len(self.places)

    def free_name(self) -> str:
        taken = {place.name for place in self.places}
        number = 1
        while f"person{number}" in taken:
            number += 1
        return f"person{number}"
