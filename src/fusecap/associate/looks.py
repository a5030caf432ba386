"""Who wears what: for the rare decisions in which place and motion do not tell people apart.

Of everybody who is tracked, each camera keeps a slow mean of how the clothes look to it
(`fusecap.appearance`); only cameras that saw both are compared, so their white balance does not
matter. Whether a newcomer is a subject who is missing, and which, and who came out of an overlap
exchanged, is decided with it by a margin.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, UInt8

from fusecap.appearance import PART_SIZE, PARTS, by_part, difference
from fusecap.associate import sizes
from fusecap.associate.track import Track
from fusecap.associate.traits import Kind, Trait, telling

NAME = "clothes"
SAME, OTHER = 0.3, 0.5
"""Difference up to which two are surely alike, and from which they surely are not.

In the same clothes light from one side alone makes 0.3, so a smaller one moves nobody.
"""
MARGIN = 0.15
"""By which one pairing must be better than another, per person."""
ENOUGH, ENOUGH_TO_MOVE = 6, 15
"""Pictures, of all cameras together, from which somebody is compared, and given another's name."""
MEMORY = 150
"""Pictures of one camera that the mean goes back: 5 s at 30 Hz of being seen alone."""
WAIT_S = 1.0
"""So long a newcomer waits to be seen alone where somebody is missing whose clothes are known."""


def looks(cameras: int) -> Trait:
    """Of somebody of whom nothing was seen yet."""
    return Trait((cameras, len(PARTS), PART_SIZE), memory=MEMORY, enough=ENOUGH)


def differences(new: Sequence[Trait], old: Sequence[Trait]) -> Float[np.ndarray, "n m"]:
    """How differently bodies look now from what is known of people, to the cameras that saw both.

    NaN where these took too few pictures.
    """
    if not new or not old:
        return np.full((len(new), len(old)), np.nan)
    a, a_count = (np.stack(some) for some in zip(*(trait.latest for trait in new), strict=True))
    b, b_count = np.stack([o.known for o in old]), np.stack([o.known_count for o in old])
    both = np.minimum(a_count[:, None], b_count[None])
    seen = both[..., None] > 0
    away = difference(np.where(seen, a[:, None], 0.0), np.where(seen, b[None], 0.0))
    weight = np.where(np.isfinite(away), np.sqrt(both.sum(axis=3)), 0.0)
    mean = np.where(weight > 0, away, 0.0) * weight
    enough = both.mean(axis=3).sum(axis=2) >= ENOUGH
    return np.where(enough, mean.sum(axis=2) / np.maximum(weight.sum(axis=2), 1e-9), np.nan)


CLOTHES = Kind(NAME, SAME, OTHER, SAME, MARGIN, ENOUGH_TO_MOVE, differences, settles=(sizes.NAME,))


def learn(
    tracks: Sequence[Track],
    person: Int[np.ndarray, "t c"],
    appearance: Sequence[UInt8[np.ndarray, "_ 40"]],
    now_ns: int,
) -> None:
    """What one instant's pictures show; `person` (t, c) are rows of the views' people, or -1."""
    rows = [by_part(some) for some in appearance]
    for t, track in enumerate(tracks):
        trait = track.traits.setdefault(NAME, looks(len(rows)))
        if telling(track, NAME, now_ns):
            seen = np.zeros(trait.known.shape)
            for c in np.flatnonzero(person[t] >= 0):
                seen[c] = rows[c][person[t, c]]
            trait.learn(seen)


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
