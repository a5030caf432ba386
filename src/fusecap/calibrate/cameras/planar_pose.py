"""How a board lies before one camera, from one view of it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Camera


def planar_poses(
    camera: Camera, points_in_board_m: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"]
) -> list[tuple[Float[np.ndarray, "4 4"], float]]:
    """Both poses cam_from_board that a plane in one view may have, the better one first.

    With each its reprojection error in units of the focal length. They mirror each other where
    perspective is weak (Collins and Bartoli, IJCV 109, 2014). Empty where pixels lie beyond what
    the lens model can undistort.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        xy = camera.undistort(pixels)
    if not np.isfinite(xy).all():
        return []
    # IPPE wants the plane's points about its origin; the shift is undone below.
    middle = points_in_board_m.mean(axis=0)
    _, turns, shifts, errors = cv2.solvePnPGeneric(
        points_in_board_m - middle, xy[:, None], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )[:4]
    poses = []
    for turn, shift, error in zip(turns, shifts, np.ravel(np.asarray(errors)), strict=True):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.asarray(turn).ravel()).as_matrix()
        pose[:3, 3] = np.asarray(shift).ravel() - pose[:3, :3] @ middle
        poses.append((pose, float(error)))
    return poses
