"""How tall and how long of limb: a body's measures tell people apart whom nothing else does.

One triangulated limb is off by centimetres, the mean over half a second of three views by one or
two per cent: two people differ by 9 % in the mean over their limbs (two men on Shelf by 5), one
person from themselves by 4 (1.5).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from fusecap.associate.anatomy import MIN_LIMBS
from fusecap.associate.track import Track
from fusecap.associate.traits import Kind, Trait, telling

NAME = "sizes"
SAME = 0.07
"""Mean relative difference up to which two may be one person."""
MARGIN = 0.025
"""By which one pairing must be better than another, per person."""
ENOUGH = 25
"""Instants from which a body is known, and given another's name."""
MEMORY = 1000
"""Instants that the mean goes back."""


def differences(new: Sequence[Trait], old: Sequence[Trait]) -> Float[np.ndarray, "n m"]:
    """Mean relative difference of limbs as they measure now and as they are known; NaN: too few."""
    if not new or not old:
        return np.full((len(new), len(old)), np.nan)
    now = np.stack([trait.latest[0][0, :, 0] for trait in new])[:, None]
    before = np.stack([trait.known[0, :, 0] for trait in old])[None]
    count = np.stack([trait.latest[1][0] for trait in new])[:, None]
    known = np.minimum(count, np.stack([trait.known_count[0] for trait in old])[None]) >= ENOUGH
    relative = np.abs(now - before) / np.maximum(0.5 * (now + before), 1e-9)
    limbs = known.sum(axis=2)
    mean = np.where(known, relative, 0.0).sum(axis=2) / np.maximum(limbs, 1)
    return np.where(limbs >= MIN_LIMBS, mean, np.nan)


SIZES = Kind(NAME, SAME, SAME, 0.0, MARGIN, ENOUGH, differences)


def learn(
    tracks: Sequence[Track],
    limb_lengths_m: Float[np.ndarray, "t m"],
    views: Int[np.ndarray, " t"],
    enough: int,
    now_ns: int,
) -> None:
    """Limbs as one instant measures them, NaN where not, of those whom `enough` views see."""
    lengths = np.nan_to_num(limb_lengths_m)[:, None, :, None]
    for track, length, count in zip(tracks, lengths, views, strict=True):
        fresh = Trait(length.shape, memory=MEMORY, enough=ENOUGH)
        trait = track.traits.setdefault(NAME, fresh)
        if count >= enough and telling(track, NAME, now_ns):
            trait.learn(length)
