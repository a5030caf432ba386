"""The axes of game engines.

Ours at rest: x to the person's left, y up, z forward, right-handed, metres. A point p becomes
`scale * A p`, a rotation R becomes `A R Aᵀ`. Both engines are left-handed, so A has determinant -1.

    Unity   (-x, y, z)      x right, y up, z forward       metres
    Unreal  (x, z, y)       x left, y forward, z up        centimetres

A character of either stands there as its maker drew it: Unity's humanoid faces +z, Unreal's
mannequin faces +y in its own component. Flipping z instead of x, as programs do whose people face
-z (OpenVR, VRM 0.x files), would lower a left arm that is raised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Axes:
    """How another program counts directions and lengths."""

    from_ours: Float[np.ndarray, "3 3"]
    """A: signed permutation."""
    units_per_m: float

    def positions(self, position_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """In their axes and unit."""
        return self.units_per_m * position_m @ self.from_ours.T

    def rotations(self, rotation: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
        """In their axes."""
        return self.from_ours @ rotation @ self.from_ours.T


UNITY = Axes(from_ours=np.diag([-1.0, 1.0, 1.0]), units_per_m=1.0)
UNREAL = Axes(
    from_ours=np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]), units_per_m=100.0
)
