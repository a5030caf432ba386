"""Who wears what: for the rare decisions in which place and motion do not tell people apart.

Of everybody who is tracked, each camera keeps a slow mean of how the clothes look to it
(`fusecap.appearance`); only cameras that saw both are compared, so their white balance does not
matter. Two decisions are made with it, both only by a margin:

- Re-entry: whether a newcomer is a subject who is missing, and which.
- After an overlap or an occlusion: whether two have come out of it exchanged. From when people come
  near each other, or are lost, what is seen of them is kept apart from what was known before; once
  there is enough of it the two are compared, and only then become one mean again.

People in the same clothes are as near to each other as to themselves: nothing is decided then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from fusecap.appearance import by_part, difference
from fusecap.associate.clothes import ENOUGH, Looks
from fusecap.associate.matching import cheapest
from fusecap.associate.track import Track

SAME, OTHER = 0.3, 0.5
"""Difference up to which two are surely alike, and from which they surely are not."""
MARGIN = 0.15
"""By which one pairing must be better than another, per person."""
ENOUGH_TO_MOVE = 15
"""Pictures, of all cameras, from which somebody is given another's name."""
NEAR_M = 0.8
"""People as near as that may be taken for each other."""
LOST_S = 0.3
"""Unseen by any two views for so long somebody may be taken for somebody else."""
DOUBT_S = 6.0
"""For so long after it an exchange may still be found out."""
DECIDE_NS = 200_000_000
"""Between comparisons of who is in doubt: pictures of one moment are alike."""
WAIT_S = 1.0
"""So long a newcomer waits to be seen alone where somebody is missing whose clothes are known."""


def differences(new: Sequence[Looks], old: Sequence[Looks]) -> Float[np.ndarray, "n m"]:
    """How differently bodies look now from what is known of people, to the cameras that saw both.

    NaN where these took too few pictures.
    """
    if not new or not old:
        return np.full((len(new), len(old)), np.nan)
    a, a_count = (np.stack(some) for some in zip(*(looks.latest for looks in new), strict=True))
    b, b_count = np.stack([o.known for o in old]), np.stack([o.known_count for o in old])
    both = np.minimum(a_count[:, None], b_count[None])
    seen = both[..., None] > 0
    away = difference(np.where(seen, a[:, None], 0.0), np.where(seen, b[None], 0.0))
    weight = np.where(np.isfinite(away), np.sqrt(both.sum(axis=3)), 0.0)
    mean = np.where(weight > 0, away, 0.0) * weight
    enough = both.mean(axis=3).sum(axis=2) >= ENOUGH
    return np.where(enough, mean.sum(axis=2) / np.maximum(weight.sum(axis=2), 1e-9), np.nan)


def learn(
    tracks: Sequence[Track],
    person: Int[np.ndarray, "t c"],
    appearance: Sequence[UInt8[np.ndarray, "_ 40"]],
    centre_m: Float[np.ndarray, "t 3"],
    now_ns: int,
) -> None:
    """What one instant's pictures show; `person` (t, c) are rows of the views' people, or -1."""
    rows = [by_part(some) for some in appearance]
    for track in tracks:
        if track.looks is None:
            track.looks = Looks(len(rows))
        if (now_ns - track.triangulated_ns) * 1e-9 > LOST_S:
            track.looks.doubt(now_ns)
    away_m = np.linalg.norm(centre_m[:, None] - centre_m[None], axis=2)
    for a, b in zip(*np.nonzero(np.triu(away_m < NEAR_M, 1)), strict=True):
        for track in (tracks[a], tracks[b]):
            if track.looks is not None:
                track.looks.doubt(now_ns)
    for t, track in enumerate(tracks):
        assert track.looks is not None
        if track.triangulated_ns < now_ns or (
            track.looks.doubtful and track.looks.alone_ns == now_ns
        ):
            continue
        seen = np.zeros(track.looks.known.shape)
        for c in np.flatnonzero(person[t] >= 0):
            seen[c] = rows[c][person[t, c]]
        track.looks.learn(seen)


def exchanged(tracks: Sequence[Track], now_ns: int) -> dict[Track, Track]:
    """Of people in doubt whose clothes show who else they were before: whom each then is.

    Who looks as before, and nobody else in doubt does, is believed again; so is whoever stays
    undecided for long.
    """
    doubtful = [t for t in tracks if t.looks is not None and t.looks.doubtful]
    ready = [t for t in doubtful if _of(t).pictures >= ENOUGH_TO_MOVE]
    if not ready:
        return {}
    away = differences([_of(t) for t in ready], [_of(t) for t in doubtful])
    own = [doubtful.index(t) for t in ready]
    moves = _moves(away[:, own])
    if moves:
        return {ready[a]: ready[b] for a, b in moves.items()}
    for row, track in enumerate(ready):
        mine, others = away[row, own[row]], np.delete(away[row], own[row])
        clear = not mine > OTHER and not (others < mine + MARGIN).any()
        if clear or (now_ns - _of(track).alone_ns) * 1e-9 > DOUBT_S:
            _of(track).believe()
    return {}


def exchange(moves: Mapping[Track, Track]) -> None:
    """What is known goes with the people."""
    known = {track: (_of(other).known, _of(other).known_count) for track, other in moves.items()}
    for track, (mean, count) in known.items():
        _of(track).known, _of(track).known_count = mean, count
    for track in moves:
        _of(track).believe()


def _moves(away: Float[np.ndarray, "n n"]) -> dict[int, int]:
    """The pairing of bodies (rows) with people that is clearly better than any other, if there is.

    Empty where everybody stays who they are, too.
    """
    known = np.flatnonzero(np.isfinite(np.diag(away)))
    cost = np.where(np.isfinite(away), away, np.inf)[np.ix_(known, known)]
    best = dict(cheapest(cost))
    moves = {a: b for a, b in best.items() if a != b}
    if len(best) < len(known) or any(cost[a, b] > SAME for a, b in moves.items()):
        return {}
    least = sum(cost[a, b] for a, b in best.items())
    for a, b in moves.items():
        without = cost.copy()
        without[a, b] = np.inf
        other = cheapest(without)
        if len(other) == len(known) and sum(without[p] for p in other) < least + 2 * MARGIN:
            return {}
    return {int(known[a]): int(known[b]) for a, b in moves.items()}


def by_looks(away: Float[np.ndarray, "n p"]) -> np.ndarray:
    """Which of n newcomers may be which of p people, as far as clothes say.

    NaN says nothing, but who surely is alike goes before who is not known.
    """
    possible = ~(away > OTHER)
    assumed = np.where(np.isnan(away), SAME, away)
    for n, p in np.ndindex(away.shape):
        rivals = np.concatenate([np.delete(away[n], p), np.delete(away[:, p], n)])
        if (rivals + MARGIN < assumed[n, p]).any():
            possible[n, p] = False
    return possible


def _of(track: Track) -> Looks:
    assert track.looks is not None
    return track.looks
