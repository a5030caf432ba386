"""The first pose of a track: near enough to the person that the solver converges.

From triangulated landmarks the trunk's position and facing follow in closed form (the rotation
that best carries the rest pose's hips, shoulders and neck onto them, Kabsch 1976), whichever way
the person faces; limbs are pointed along the triangulated bones, and IMUs turn the bones they sit
on. Whatever nothing measures takes the prior's mean.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world, theta_from_rotations
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.geometry.camera import Rig
from fusecap.solve.pose_solver import ImuSites

_TRUNK = ("neck", "left_shoulder", "right_shoulder", "mid_hip", "left_hip", "right_hip")
_LIMBS = tuple(
    (f"{side}_{bone}", f"{side}_{near}", f"{side}_{far}", f"{side}_{child}")
    for side in ("left", "right")
    for bone, near, far, child in (
        ("upper_arm", "shoulder", "elbow", "forearm"),
        ("forearm", "elbow", "wrist", "hand"),
        ("thigh", "hip", "knee", "shank"),
        ("shank", "knee", "ankle", "foot"),
    )
)
"""(bone, its near landmark, its far landmark, the child whose offset is the bone's direction)."""


def neutral_pose(
    shape: BodyShape, prior: PosePrior, *, x_m: float, z_m: float, heading_rad: float
) -> Float[np.ndarray, " p"]:
    """The prior's mean pose, standing on the floor at (x, z); heading 0 faces +z, π/2 faces +x."""
    theta = np.zeros(shape.skeleton.pose_size)
    theta[:3] = [x_m, shape.standing_root_height_m, z_m]
    theta[4] = heading_rad
    theta[6:] = prior.mean
    return theta


def pose_from_landmarks(
    shape: BodyShape,
    landmarks: LandmarkSet,
    prior: PosePrior,
    points_in_world_m: Float[np.ndarray, "k 3"],
    sites: ImuSites,
    imu_rotation: Float[np.ndarray, "i 3 3"],
) -> Float[np.ndarray, " p"] | None:
    """A first pose from triangulated landmarks (NaN = missing) and measured bone orientations.

    None when the trunk cannot be placed: fewer than three of its landmarks, or all on a line.
    """
    rest = np.zeros((1, shape.skeleton.pose_size))
    position, rotation = forward_kinematics(shape, rest)
    rest_points = landmarks_in_world(
        position, rotation, landmarks.bones(shape.skeleton), landmarks.offsets_m(shape)
    )[0]
    trunk = [
        index
        for name in _TRUNK
        if (index := landmarks.index(name)) is not None
        and np.isfinite(points_in_world_m[index]).all()
    ]
    if len(trunk) < 3:
        return None
    source = rest_points[trunk] - rest_points[trunk].mean(axis=0)
    target_centre = points_in_world_m[trunk].mean(axis=0)
    if np.linalg.svd(source, compute_uv=False)[1] < 0.05:
        return None
    alignment = Rotation.align_vectors(points_in_world_m[trunk] - target_centre, source)
    trunk_rotation = alignment[0].as_matrix()
    root = target_centre - trunk_rotation @ rest_points[trunk].mean(axis=0)
    directions = {}
    for bone, near, far, child in _LIMBS:
        ends = [landmarks.index(near), landmarks.index(far)]
        if None not in ends:
            direction = points_in_world_m[ends[1]] - points_in_world_m[ends[0]]
            if np.isfinite(direction).all() and np.linalg.norm(direction) > 0.05:
                directions[bone] = (shape.offsets_m[shape.skeleton.bone(child)], direction)
    return _pose(shape, prior, root, trunk_rotation, directions, sites, imu_rotation)


def pose_from_imus(
    shape: BodyShape,
    prior: PosePrior,
    sites: ImuSites,
    imu_rotation: Float[np.ndarray, "i 3 3"],
    *,
    x_m: float,
    z_m: float,
) -> Float[np.ndarray, " p"] | None:
    """A first pose from bone orientations alone, standing at (x, z); None without any of them."""
    measured = np.isfinite(imu_rotation[:, 0, 0])
    if not measured.any():
        return None
    trunk = imu_rotation[int(np.flatnonzero(measured)[0])]
    if 0 in sites.bone and measured[sites.bone.index(0)]:
        trunk = imu_rotation[sites.bone.index(0)]
    root = np.array([x_m, shape.standing_root_height_m, z_m])
    heading = Rotation.from_euler("y", np.arctan2(trunk[0, 2], trunk[2, 2])).as_matrix()
    return _pose(shape, prior, root, heading, {}, sites, imu_rotation)


def poses_from_one_view(
    shape: BodyShape,
    prior: PosePrior,
    rig: Rig,
    keypoints: Float[np.ndarray, "c k 3"],
    *,
    headings: int = 8,
) -> list[Float[np.ndarray, " p"]]:
    """Neutral poses at the depth where a standing person fills the keypoints' extent.

    One for each of several headings, for the solver to choose from; empty when no view has at least
    four keypoints.
    """
    seen = np.array([np.count_nonzero(view[:, 2] > 0) for view in keypoints])
    if not len(seen) or seen.max() < 4:
        return []
    index = int(seen.argmax())
    camera, view = rig.cameras[index], keypoints[index]
    pixels = view[view[:, 2] > 0, :2]
    rays = camera.undistort(pixels)
    extent = np.linalg.norm(np.ptp(rays, axis=0))
    depth = 0.9 * shape.height_m / max(extent, 1e-3)
    centre_in_cam = np.array([*rays.mean(axis=0), 1.0]) * depth
    centre = camera.rotation.T @ (centre_in_cam - camera.translation)
    poses = []
    for heading in np.arange(headings) * 2 * np.pi / headings:
        theta = neutral_pose(shape, prior, x_m=centre[0], z_m=centre[2], heading_rad=heading)
        theta[1] = centre[1]
        poses.append(theta)
    return poses


def _pose(
    shape: BodyShape,
    prior: PosePrior,
    root: np.ndarray,
    trunk_rotation: np.ndarray,
    directions: dict[str, tuple[np.ndarray, np.ndarray]],
    sites: ImuSites,
    imu_rotation: np.ndarray,
) -> np.ndarray:
    skeleton = shape.skeleton
    mean = Rotation.from_rotvec(prior.mean.reshape(-1, 3)).as_matrix()
    measured = {
        bone: imu_rotation[i]
        for i, bone in enumerate(sites.bone)
        if np.isfinite(imu_rotation[i, 0, 0])
    }
    rotation = np.empty((skeleton.bone_count, 3, 3))
    for bone, parent in enumerate(skeleton.parents):
        name = skeleton.bone_names[bone]
        if bone in measured:
            rotation[bone] = measured[bone]
        elif parent < 0:
            rotation[bone] = trunk_rotation
        elif name in directions:
            rest_direction, direction = directions[name]
            before = rotation[parent] @ rest_direction
            rotation[bone] = _smallest_turn(before, direction) @ rotation[parent]
        elif directions and name.startswith("spine"):
            rotation[bone] = trunk_rotation
        else:
            rotation[bone] = rotation[parent] @ mean[bone - 1]
    return theta_from_rotations(skeleton.parents, root[None], rotation[None])[0]


def _smallest_turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The rotation of least angle that turns direction a into direction b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
        sine = float(np.linalg.norm(axis))
        return Rotation.from_rotvec(axis / sine * np.pi).as_matrix()
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
