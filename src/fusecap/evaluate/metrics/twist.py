"""Axial rotation, the error that joint positions do not show.

The rotation from the true to the estimated bone, in the true bone's frame, is a twist about the
bone's long axis followed by a swing of that axis. Video sees the swing; the twist of a straight arm
or leg moves no joint, only IMUs (or the hand and foot) tell it. A forearm that is 30 degrees
twisted and 10 degrees off has an orientation error of 31.6 degrees, and its wrist is 4.4 cm away.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fusecap.body.shape import BodyShape, end_offsets_m


def long_axes(shape: BodyShape) -> Float[np.ndarray, "b 3"]:
    """Unit vector along each bone, in its own frame: to its first child's joint, or to its end.

    The first child of the hips is the spine, that of the topmost spine bone the neck.
    """
    skeleton, ends = shape.skeleton, end_offsets_m(shape)
    axes = np.empty((skeleton.bone_count, 3))
    for bone, name in enumerate(skeleton.bone_names):
        children = skeleton.children(bone)
        axes[bone] = shape.offsets_m[children[0]] if children else ends[name]
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def axial_error_rad(
    estimate: Float[np.ndarray, "*n b 3 3"],
    truth: Float[np.ndarray, "*n b 3 3"],
    axes: Float[np.ndarray, "b 3"],
) -> Float[np.ndarray, "*n b"]:
    """Size of the twist about the bone's long axis, 0 to pi; NaN where the axis is turned round.

    For R = truthᵀ estimate with quaternion (w, v) and axis u the twist is 2 atan2(v·u, w); the
    matrix holds what that needs: 4w² = 1 + tr R, 4w v·u = (R - Rᵀ)∨·u, 4(v·u)² = 1 - tr R + 2 uᵀRu.
    """
    relative = np.swapaxes(truth, -1, -2) @ estimate
    trace = np.trace(relative, axis1=-2, axis2=-1)
    odd = np.stack(
        [
            relative[..., 2, 1] - relative[..., 1, 2],
            relative[..., 0, 2] - relative[..., 2, 0],
            relative[..., 1, 0] - relative[..., 0, 1],
        ],
        axis=-1,
    )
    cross = (odd * axes).sum(axis=-1)
    along = np.einsum("bi,...bij,bj->...b", axes, relative, axes)
    w2, v2 = np.maximum(1 + trace, 0.0), np.maximum(1 - trace + 2 * along, 0.0)
    # |twist| = 2 atan2(|v·u|, |w|) = atan2(2 |w v·u|, w² - (v·u)²)
    twist = np.arctan2(2 * np.abs(cross), w2 - v2)
    return np.where(w2 + v2 < 1e-9, np.nan, twist)


def swing_error_rad(
    estimate: Float[np.ndarray, "*n b 3 3"],
    truth: Float[np.ndarray, "*n b 3 3"],
    axes: Float[np.ndarray, "b 3"],
) -> Float[np.ndarray, "*n b"]:
    """Angle between the estimated and the true long axis, 0 to pi."""
    x = np.einsum("...bij,bj->...bi", estimate, axes)
    y = np.einsum("...bij,bj->...bi", truth, axes)
    return 2 * np.arctan2(np.linalg.norm(x - y, axis=-1), np.linalg.norm(x + y, axis=-1))
