"""Small synthetic scenes for tests: a ring of cameras, a body, perfect or broken measurements."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LANDMARK_SETS, LandmarkSet
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.prior import PosePrior
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.geometry.camera import Camera, Rig
from fusecap.solve.pose_solver import ImuSites, Measurements

IMU13 = ("head", "spine3", "hips") + tuple(
    f"{side}_{bone}"
    for bone in ("upper_arm", "forearm", "thigh", "shank", "foot")
    for side in ("left", "right")
)


def ring(count: int, radius_m: float = 4.0, distortion=(0.0, 0.0, 0.0, 0.0, 0.0)) -> Rig:
    cameras = []
    for index in range(count):
        angle = 2 * np.pi * index / max(count, 1) + 0.3
        centre = np.array([radius_m * np.sin(angle), 1.8, radius_m * np.cos(angle)])
        forward = np.array([0.0, 0.95, 0.0]) - centre
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cameras.append(
            Camera(
                name=f"cam{index}",
                size_px=(1920, 1080),
                matrix=np.array([[1100.0, 0, 960], [0, 1110.0, 540], [0, 0, 1]]),
                distortion=np.array(distortion, dtype=float),
                rotation=rotation,
                translation=-rotation @ centre,
            )
        )
    return Rig(cameras=tuple(cameras))


def flat_prior(skeleton: Skeleton = PAPER21, seed: int = 0) -> PosePrior:
    """A prior of the right size with a random subspace: enough for derivatives and algebra."""
    rng = np.random.default_rng(seed)
    size = 3 * skeleton.bone_count - 3
    rank = size // 3
    basis = np.linalg.qr(rng.normal(size=(size, size)))[0][:, :rank]
    return PosePrior(
        skeleton_name=skeleton.name,
        mean=rng.normal(scale=0.05, size=size),
        basis=np.ascontiguousarray(basis),
        sigma=np.linspace(0.8, 0.1, rank),
        acceleration=np.full(1 + skeleton.bone_count, 20.0),
        recipe={},
    )


def random_pose(rng: np.random.Generator, angle: float = 0.4, skeleton: Skeleton = PAPER21):
    theta = rng.normal(scale=angle, size=skeleton.pose_size)
    theta[:3] = [0.1, 0.95, -0.1]
    return theta


def measure(
    theta: np.ndarray,
    shape: BodyShape,
    rig: Rig,
    landmarks: LandmarkSet = LANDMARK_SETS["body25"],
    imu_bones: tuple[str, ...] = (),
    dt_s: float = 1 / 60,
) -> tuple[Measurements, ImuSites]:
    """Perfect measurements of a body that stands still."""
    skeleton = shape.skeleton
    position, rotation = forward_kinematics(shape, theta[None])
    bones = landmarks.bones(skeleton)
    points = landmarks_in_world(position, rotation, bones, landmarks.offsets_m(shape))[0]
    keypoints = np.full((len(rig), len(points), 3), np.nan)
    for index, camera in enumerate(rig.cameras):
        keypoints[index, :, :2] = camera.project(points)
        keypoints[index, :, 2] = np.where(np.isnan(keypoints[index, :, 0]), 0.0, 0.8)
    index = tuple(skeleton.bone(name) for name in imu_bones)
    sites = ImuSites(bone=index, position_m=np.full((len(index), 3), 0.03))
    site = position[0, list(index)] + rotation[0, list(index)] @ np.full(3, 0.03)
    data = Measurements(
        keypoints=keypoints,
        imu_rotation=rotation[0, list(index)].copy(),
        imu_accel=np.zeros((len(index), 3)),
        imu_history=np.stack([site, site]),
        dt_s=dt_s,
    )
    return data, sites


def pose_error_mm_deg(shape: BodyShape, a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Largest joint distance [mm] and bone angle [deg] between two poses."""
    pa, ra = forward_kinematics(shape, a[None])
    pb, rb = forward_kinematics(shape, b[None])
    relative = np.swapaxes(ra[0], -1, -2) @ rb[0]
    angle = np.linalg.norm(Rotation.from_matrix(relative).as_rotvec(), axis=-1)
    return 1e3 * float(np.linalg.norm(pa - pb, axis=-1).max()), float(np.degrees(angle.max()))
