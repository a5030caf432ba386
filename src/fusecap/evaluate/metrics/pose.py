"""Where the joints are and how the bones are turned: MPJPE, PA-MPJPE, orientation, 3D PCP."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int


def position_error_m(
    estimate: Float[np.ndarray, "*n j 3"], truth: Float[np.ndarray, "*n j 3"]
) -> Float[np.ndarray, "*n j"]:
    """Distance of each joint, in the world: MPJPE is its mean."""
    return np.linalg.norm(estimate - truth, axis=-1)


def root_relative_error_m(
    estimate: Float[np.ndarray, "*n j 3"], truth: Float[np.ndarray, "*n j 3"]
) -> Float[np.ndarray, "*n j"]:
    """Distance of each joint once the first joints coincide."""
    return position_error_m(estimate - estimate[..., :1, :], truth - truth[..., :1, :])


def aligned_error_m(
    estimate: Float[np.ndarray, "t j 3"], truth: Float[np.ndarray, "t j 3"]
) -> Float[np.ndarray, "t j"]:
    """Distance of each joint after the best similarity of each frame: PA-MPJPE is its mean."""
    return position_error_m(procrustes(estimate, truth), truth)


def procrustes(
    estimate: Float[np.ndarray, "t j 3"], truth: Float[np.ndarray, "t j 3"]
) -> Float[np.ndarray, "t j 3"]:
    """Each frame of `estimate` scaled, turned and moved onto `truth`; never mirrored.

    Frames with NaN stay NaN.
    """
    x = estimate - estimate.mean(axis=1, keepdims=True)
    y_mean = truth.mean(axis=1, keepdims=True)
    turned = x @ np.swapaxes(procrustes_rotation(estimate, truth), 1, 2)
    scale = (turned * (truth - y_mean)).sum(axis=(1, 2))
    scale = scale / np.maximum((x**2).sum(axis=(1, 2)), 1e-30)
    return scale[:, None, None] * turned + y_mean


def procrustes_rotation(
    estimate: Float[np.ndarray, "t j 3"], truth: Float[np.ndarray, "t j 3"]
) -> Float[np.ndarray, "t 3 3"]:
    """The proper rotation of each frame that turns `estimate` onto `truth`, by Kabsch's method."""
    rotation = np.full((len(truth), 3, 3), np.nan)
    whole = np.isfinite(estimate).all(axis=(1, 2)) & np.isfinite(truth).all(axis=(1, 2))
    x, y = estimate[whole], truth[whole]
    x, y = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(y, 1, 2) @ x)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    rotation[whole] = u @ vt
    return rotation


def orientation_error_rad(
    estimate: Float[np.ndarray, "*n 3 3"], truth: Float[np.ndarray, "*n 3 3"]
) -> Float[np.ndarray, "*n"]:
    """Angle of the rotation between the two, from |A - B| = 2√2 sin(angle / 2)."""
    chord = np.linalg.norm(estimate - truth, axis=(-2, -1)) / (2 * np.sqrt(2))
    return 2 * np.arcsin(np.minimum(chord, 1.0))


def aligned_orientation_error_rad(
    rotation: Float[np.ndarray, "t j 3 3"],
    true_rotation: Float[np.ndarray, "t j 3 3"],
    estimate: Float[np.ndarray, "t j 3"],
    truth: Float[np.ndarray, "t j 3"],
) -> Float[np.ndarray, "t j"]:
    """Orientation error once each frame is turned as Procrustes turns its joint positions."""
    turn = procrustes_rotation(estimate, truth)
    return orientation_error_rad(turn[:, None] @ rotation, true_rotation)


def correct_limbs(
    estimate: Float[np.ndarray, "*n j 3"],
    truth: Float[np.ndarray, "*n j 3"],
    limbs: Int[np.ndarray, "l 2"],
) -> Bool[np.ndarray, "*n l"]:
    """3D PCP: which limbs' two end errors add up to less than the limb's length.

    A limb without an estimate is wrong; so is one without truth, which the caller leaves out.
    """
    error = position_error_m(estimate, truth)
    first, second = limbs[:, 0], limbs[:, 1]
    length = np.linalg.norm(truth[..., first, :] - truth[..., second, :], axis=-1)
    with np.errstate(invalid="ignore"):
        return error[..., first] + error[..., second] < length
