"""By what tracked people are told from each other where place and motion do not tell.

Of everybody a slow mean is kept of what does not change: the body's measures (`sizes.py`), and how
the clothes look where pictures show it (`looks.py`). From when people come near each other, or are
lost, what is seen of them is kept apart from what was known before; once there is enough of it the
two are compared, and only then become one mean again. Two that came out exchanged are so found out,
by a margin: people of one size in the same clothes are as near to each other as to themselves, and
nothing is decided then.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from fusecap.associate.matching import cheapest

if TYPE_CHECKING:
    from fusecap.associate.track import Track

NEAR_M = 0.8
"""People as near as that may be taken for each other."""
LOST_S = 0.3
"""Unseen by any two views for so long somebody may be taken for somebody else."""
DOUBT_S = 6.0
"""For so long after it an exchange may still be found out."""
DECIDE_NS = 200_000_000
"""Between comparisons of who is in doubt: what is seen at one moment is alike."""


class Trait:
    """Means of one person: what is known, and what was seen since the person may be another."""

    __slots__ = (
        "_enough",
        "_memory",
        "alone_ns",
        "doubtful",
        "fresh",
        "fresh_count",
        "known",
        "known_count",
    )

    def __init__(self, shape: tuple[int, int, int], *, memory: int, enough: int) -> None:
        """Of `shape` (c, p, s): p parts of s values each, as c cameras see them.

        A mean goes back `memory` sights, and is known from `enough` of all cameras together.
        """
        self._memory, self._enough = memory, enough
        self.known = np.zeros(shape)
        self.known_count = np.zeros(shape[:2])
        self.fresh = np.zeros(shape)
        self.fresh_count = np.zeros(shape[:2])
        self.doubtful = False
        self.alone_ns = -1
        """Since when nobody is near and two views agree, while it is doubtful."""

    def doubt(self, now_ns: int) -> None:
        """This may from now on be somebody else."""
        self.doubtful = self.is_known
        self.alone_ns = now_ns
        self.fresh[:] = 0.0
        self.fresh_count[:] = 0.0

    def learn(self, seen: Float[np.ndarray, "c p s"]) -> None:
        """One instant more; 0 where nothing was seen."""
        mean, count = (
            (self.fresh, self.fresh_count) if self.doubtful else (self.known, self.known_count)
        )
        heard = seen.any(axis=2)
        np.minimum(count + heard, self._memory, out=count)
        share = heard / np.maximum(count, 1.0)
        mean += share[:, :, None] * (seen - mean)

    def believe(self) -> None:
        """It is who it was: what was seen since joins what is known."""
        total = np.maximum(self.known_count + self.fresh_count, 1.0)
        share = (self.fresh_count / total)[:, :, None]
        self.known += share * (self.fresh - self.known)
        np.minimum(self.known_count + self.fresh_count, self._memory, out=self.known_count)
        self.fresh[:] = 0.0
        self.fresh_count[:] = 0.0
        self.doubtful = False

    def continues(self, old: Trait, since_ns: int) -> None:
        """It turned out to be who was lost; what was seen of it is held against others later."""
        if not self.doubtful:
            self.fresh, self.fresh_count = self.known, self.known_count
            self.doubtful, self.alone_ns = True, since_ns
        self.known, self.known_count = old.known.copy(), old.known_count.copy()

    @property
    def is_known(self) -> bool:
        """Whether enough was seen before doubt began."""
        return float(self.known_count.mean(axis=1).sum()) >= self._enough

    @property
    def count(self) -> float:
        """Of what was seen of this body."""
        return float(self.latest[1].mean(axis=1).sum())

    @property
    def latest(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and count of what surely is this body's."""
        if self.doubtful:
            return self.fresh, self.fresh_count
        return self.known, self.known_count


class Kind(NamedTuple):
    """One trait, and when it decides."""

    name: str
    """In `Track.traits`."""
    same: float
    """Difference up to which two may be one."""
    other: float
    """From which they surely are not."""
    own: float
    """Up to which somebody surely looks as before, and is given nobody else's name."""
    margin: float
    """By which one pairing must be better than another, per person."""
    enough: int
    """Sights from which somebody is given another's name."""
    differences: Callable[[Sequence[Trait], Sequence[Trait]], Float[np.ndarray, "n m"]]
    """Of bodies as they are seen now from what is known of people; NaN: too little is known."""
    settles: tuple[str, ...] = ()
    """Other traits that are believed where this one is as before."""


def doubt(tracks: Sequence[Track], centre_m: Float[np.ndarray, "t 3"], now_ns: int) -> None:
    """Whoever is near somebody, or has been lost, may from now on be somebody else."""
    away_m = np.linalg.norm(centre_m[:, None] - centre_m[None], axis=2)
    near = (away_m < NEAR_M).sum(axis=1) > 1
    for track, beside in zip(tracks, near, strict=True):
        if beside or (now_ns - track.triangulated_ns) * 1e-9 > LOST_S:
            for trait in track.traits.values():
                trait.doubt(now_ns)


def telling(track: Track, kind: str, now_ns: int) -> bool:
    """Whether what is seen of a track now is one person's for sure."""
    trait = track.traits[kind]
    return track.triangulated_ns == now_ns and trait.alone_ns != now_ns


def exchanged(kind: Kind, tracks: Sequence[Track], now_ns: int) -> dict[Track, Track]:
    """Of people in doubt whom a trait shows to be who else was in doubt: whom each then is.

    Who looks as before, and nobody else in doubt does, is believed again; so is whoever stays
    undecided for long.
    """
    doubtful = [t for t in tracks if kind.name in t.traits and t.traits[kind.name].doubtful]

    def of(track: Track) -> Trait:
        return track.traits[kind.name]

    ready = [t for t in doubtful if of(t).count >= kind.enough]
    if not ready:
        return {}
    away = kind.differences([of(t) for t in ready], [of(t) for t in doubtful])
    own = [doubtful.index(t) for t in ready]
    moves = _moves(kind, away[:, own])
    if moves:
        return {ready[a]: ready[b] for a, b in moves.items()}
    for row, track in enumerate(ready):
        mine, others = away[row, own[row]], np.delete(away[row], own[row])
        clear = not mine > kind.other and not (others < mine + kind.margin).any()
        if clear or (now_ns - of(track).alone_ns) * 1e-9 > DOUBT_S:
            of(track).believe()
        if clear and np.isfinite(mine):
            for name in track.traits.keys() & kind.settles:
                track.traits[name].believe()
    return {}


def exchange(moves: Mapping[Track, Track]) -> None:
    """What is known goes with the people; what was not in doubt is of the body that is there."""
    known = {
        (track, name): (trait.known, trait.known_count)
        for track, other in moves.items()
        for name, trait in other.traits.items()
        if name in track.traits and trait.doubtful and track.traits[name].doubtful
    }
    for (track, name), (mean, count) in known.items():
        track.traits[name].known, track.traits[name].known_count = mean, count
        track.traits[name].believe()


def _moves(kind: Kind, away: Float[np.ndarray, "n n"]) -> dict[int, int]:
    """The pairing of bodies (rows) with people that is clearly better than any other, if there is.

    Empty where everybody stays who they are, too.
    """
    known = np.flatnonzero(np.isfinite(np.diag(away)))
    cost = np.where(np.isfinite(away), away, np.inf)[np.ix_(known, known)]
    best = dict(cheapest(cost))
    moves = {a: b for a, b in best.items() if a != b}
    needless = [
        cost[a, a] <= kind.own or cost[a, b] > min(kind.same, cost[a, a] - kind.margin)
        for a, b in moves.items()
    ]
    if len(best) < len(known) or any(needless):
        return {}
    least = sum(cost[a, b] for a, b in best.items())
    for a, b in moves.items():
        without = cost.copy()
        without[a, b] = np.inf
        other = cheapest(without)
        if len(other) == len(known) and sum(without[p] for p in other) < least + 2 * kind.margin:
            return {}
    return {int(known[a]): int(known[b]) for a, b in moves.items()}
