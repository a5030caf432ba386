"""How one tracked person's clothes look: per camera the mean of what was surely seen of them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.appearance import PART_SIZE, PARTS

ENOUGH = 6
"""Pictures, of all cameras together, from which somebody is compared."""
MEMORY = 150
"""Pictures of one camera that the mean goes back: 5 s at 30 Hz of being seen alone."""


class Looks:
    """Means of one person: what is known, and what was seen since the person may be another."""

    __slots__ = ("alone_ns", "doubtful", "fresh", "fresh_count", "known", "known_count")

    def __init__(self, cameras: int) -> None:
        shape = (cameras, len(PARTS))
        self.known = np.zeros((*shape, PART_SIZE))
        self.known_count = np.zeros(shape)
        self.fresh = np.zeros((*shape, PART_SIZE))
        self.fresh_count = np.zeros(shape)
        self.doubtful = False
        self.alone_ns = 0
        """Since when nobody is near and two views agree, while it is doubtful."""

    def doubt(self, now_ns: int) -> None:
        """This may from now on be somebody else."""
        self.doubtful = self.is_known
        self.alone_ns = now_ns
        self.fresh[:] = 0.0
        self.fresh_count[:] = 0.0

    def learn(self, seen: Float[np.ndarray, "c p s"]) -> None:
        """One instant more; 0 where a camera saw nothing."""
        mean, count = (
            (self.fresh, self.fresh_count) if self.doubtful else (self.known, self.known_count)
        )
        heard = seen.any(axis=2)
        np.minimum(count + heard, MEMORY, out=count)
        share = heard / np.maximum(count, 1.0)
        mean += share[:, :, None] * (seen - mean)

    def believe(self) -> None:
        """It is who it was: what was seen since joins what is known."""
        total = np.maximum(self.known_count + self.fresh_count, 1.0)
        share = (self.fresh_count / total)[:, :, None]
        self.known += share * (self.fresh - self.known)
        np.minimum(self.known_count + self.fresh_count, MEMORY, out=self.known_count)
        self.doubtful = False

    def continues(self, old: Looks) -> None:
        """It turned out to be who was lost; what was seen of it is held against others later."""
        if not self.doubtful:
            self.fresh, self.fresh_count = self.known, self.known_count
            self.doubtful = True
        self.known, self.known_count = old.known.copy(), old.known_count.copy()

    @property
    def is_known(self) -> bool:
        """Whether enough was seen before doubt began."""
        return float(self.known_count.mean(axis=1).sum()) >= ENOUGH

    @property
    def pictures(self) -> float:
        """That tell of this body."""
        return float(self.latest[1].mean(axis=1).sum())

    @property
    def latest(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and count of what surely is this body's."""
        if self.doubtful:
            return self.fresh, self.fresh_count
        return self.known, self.known_count
