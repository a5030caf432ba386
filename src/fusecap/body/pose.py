"""Poses as `theta` vectors: forward kinematics over whole motions, and canonical angle-axis.

Everything here is vectorised over frames for readers, writers and metrics; the solver has its own
forward kinematics in `fusecap.kernels`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.shape import BodyShape


def forward_kinematics(
    shape: BodyShape, theta: Float[np.ndarray, "t p"]
) -> tuple[Float[np.ndarray, "t b 3"], Float[np.ndarray, "t b 3 3"]]:
    """Joint positions [m] and bone rotations in the world for T poses [1, eq. 1, 9]."""
    frames, bones = len(theta), shape.skeleton.bone_count
    angle_axis = theta[:, 3:].reshape(frames * bones, 3)
    local = Rotation.from_rotvec(angle_axis).as_matrix().reshape(frames, bones, 3, 3)
    position = np.empty((frames, bones, 3))
    rotation = np.empty((frames, bones, 3, 3))
    position[:, 0] = theta[:, :3]
    rotation[:, 0] = local[:, 0]
    for bone, parent in enumerate(shape.skeleton.parents[1:], start=1):
        rotation[:, bone] = rotation[:, parent] @ local[:, bone]
        position[:, bone] = position[:, parent] + rotation[:, parent] @ shape.offsets_m[bone]
    return position, rotation


def theta_from_rotations(
    parents: tuple[int, ...],
    root_position_m: Float[np.ndarray, "t 3"],
    rotation_in_world: Float[np.ndarray, "t b 3 3"],
) -> Float[np.ndarray, "t p"]:
    """The inverse of `forward_kinematics` for known bone rotations; angles at most pi."""
    local = rotation_in_world.copy()
    for bone, parent in enumerate(parents[1:], start=1):
        local[:, bone] = np.swapaxes(rotation_in_world[:, parent], -1, -2) @ local[:, bone]
    frames, bones = local.shape[:2]
    vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()
    return np.concatenate([root_position_m, vectors.reshape(frames, 3 * bones)], axis=1)


def landmarks_in_world(
    position_in_world_m: Float[np.ndarray, "t b 3"],
    rotation_in_world: Float[np.ndarray, "t b 3 3"],
    landmark_bone: np.ndarray,
    landmark_offset_m: Float[np.ndarray, "k 3"],
) -> Float[np.ndarray, "t k 3"]:
    """Landmark positions [m]: bone-frame offsets carried by the bones [1, eq. 5]."""
    carried = np.einsum("tkij,kj->tki", rotation_in_world[:, landmark_bone], landmark_offset_m)
    return position_in_world_m[:, landmark_bone] + carried
