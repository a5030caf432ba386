"""Where a point of one view can lie in another: on a line, which the essential matrix names."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def essential_matrix(
    rotations: tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3 3"]],
    positions_in_world: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]],
) -> Float[np.ndarray, "3 3"]:
    """E with y' E x = 0 for (X/Z, Y/Z, 1) of a point in the first (x) and second (y) of two views.

    `rotations` are cam_from_world. As for views one metre apart; zero for two in one place.
    """
    b_from_a = rotations[1] @ rotations[0].T
    x, y, z = rotations[1] @ (positions_in_world[0] - positions_in_world[1])
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a
    return essential / max(float(np.linalg.norm([x, y, z])), 1e-9)
