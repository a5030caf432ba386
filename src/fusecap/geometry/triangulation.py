"""Landmarks in the world from keypoints in several views.

Eq. 17 of the paper: the point of least confidence-weighted Cauchy reprojection cost. It starts from
the linear solution on undistorted coordinates or, where one view contradicts the rest, from the
best solution of two views; reweighted Gauss-Newton steps follow until they move it less than
0.1 mm. One outlier among three
views is so ignored; of two views that disagree neither can be believed, and the landmark is NaN.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.geometry.camera import Rig
from fusecap.kernels import association as kernels

ROBUST_SCALE_PX = 10.0
"""Where the Cauchy loss turns, in pixels of a 1920-pixel-wide image: twice the usual scatter of a
detector's keypoints (about 5 px there). Views beyond three times this did not image the landmark.
"""


def triangulate(
    rig: Rig, keypoints: Float[np.ndarray, "c k 3"], robust_scale_px: float = ROBUST_SCALE_PX
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Points in the world [m] and their mean reprojection error over the views that agree.

    NaN where fewer than two views agree. Errors are pixels of a 1920-pixel-wide image.
    """
    cameras, landmarks = keypoints.shape[:2]
    rays = np.empty((cameras, landmarks, 3))
    points, error_px = np.empty((landmarks, 3)), np.empty(landmarks)
    every = np.arange(cameras)
    kernels.undistort(rig.packed, every, np.ascontiguousarray(keypoints, np.float64), rays)
    kernels.triangulate_person(rig.packed, rays, every, robust_scale_px, points, error_px)
    return points, error_px
