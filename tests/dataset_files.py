"""Small data sets in the layouts of docs/datasets.md, made from people in motion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.pose import forward_kinematics, landmarks_in_world
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.evaluate.datasets.dip import SENSORS as DIP_SENSORS
from fusecap.evaluate.datasets.dip import SMPL_BONES, SMPL_PARENTS
from fusecap.evaluate.datasets.human36m import H36M17, SCORED
from fusecap.evaluate.datasets.panoptic import COCO19
from fusecap.evaluate.datasets.total_capture import JOINTS, METRES_PER_INCH, SENSORS
from fusecap.evaluate.simulator import camera_ring, placed
from fusecap.geometry.camera import Y_UP_FROM_Z_UP, Camera, Rig
from fusecap.sources.calibration_files.loader import Y_UP_FROM
from motions import person, walk

BODY25 = landmark_set_named("body25")
FRAMES = 12
GRAVITY = np.array([0.0, 9.80665, 0.0])


def rig(count: int, **settings) -> Rig:
    """Cameras that see the walkers."""
    return camera_ring(count, **settings)


def motion(shape: BodyShape, frames: int = FRAMES, rate_hz: float = 60.0) -> np.ndarray:
    return placed(walk(shape, frames, rate_hz=rate_hz), turn_rad=0.7, centre_m=(0.2, -0.1))


def landmarks_of(shape, theta, landmark_set) -> np.ndarray:
    position, rotation = forward_kinematics(shape, theta)
    return landmarks_in_world(
        position, rotation, landmark_set.bones(shape.skeleton), landmark_set.offsets_m(shape)
    )


def write_keypoints(folders: dict[str, Path], cameras: Rig, points: list[np.ndarray]) -> None:
    """OpenPose BODY_25 of people whose landmarks (T, 25, 3) are given."""
    for name, folder in folders.items():
        folder.mkdir(parents=True)
        for frame in range(len(points[0])):
            people = []
            for each in points:
                pixels = cameras[name].project(each[frame])
                rows = np.column_stack([pixels, np.full(len(pixels), 0.9)])
                people.append({"pose_keypoints_2d": np.nan_to_num(rows).ravel().tolist()})
            text = json.dumps({"version": 1.3, "people": people})
            (folder / f"{name}_{frame:012d}_keypoints.json").write_text(text)


# Total Capture


def total_capture(root: Path, *, turn_deg: float = 180.0, aux: bool = False) -> np.ndarray:
    """One sequence, S1 acting1, whose bones' axes face `turn_deg` at rest; returns its theta."""
    shape = person(1.7, EXTENDED23)
    theta = motion(shape)
    position, rotation = forward_kinematics(shape, theta)
    rest = Rotation.from_euler("y", turn_deg, degrees=True).as_matrix()
    rows = [EXTENDED23.bone(bone) for bone in JOINTS.values()]
    inches = position[:, rows] / METRES_PER_INCH
    xyzw = Rotation.from_matrix((rotation[:, rows] @ rest.T).reshape(-1, 3, 3)).as_quat()
    vicon = root / "S1" / "acting1"
    vicon.mkdir(parents=True)
    write_skeleton(vicon / "gt_skel_gbl_pos.txt", inches)
    # One frame less, as in the data set.
    write_skeleton(vicon / "gt_skel_gbl_ori.txt", xyzw.reshape(FRAMES, len(rows), 4)[:-1])
    write_imus(root, rotation, rest, aux=aux)
    cameras = rig(8)
    (root / "calibration.cal").write_text(calibration_cal(cameras))
    folders = {f"cam{i}": root / "keypoints" / "S1" / "acting1" / f"cam{i}" for i in range(1, 9)}
    write_keypoints(folders, cameras, [landmarks_of(shape, theta, BODY25)])
    return theta


def write_skeleton(path: Path, values: np.ndarray) -> None:
    lines = ["\t".join(JOINTS) + "\t"]
    lines += ["".join(" ".join(f"{v:.6f}" for v in joint) + "\t" for joint in f) for f in values]
    path.write_text("\n".join(lines) + "\n")


def write_imus(root: Path, rotation: np.ndarray, rest: np.ndarray, *, aux: bool) -> None:
    rng = np.random.default_rng(4)
    bones = [EXTENDED23.bone(bone) for bone in SENSORS.values()]
    vicon = rotation[:, bones] @ rest.T
    reference = Rotation.from_quat(rng.standard_normal((13, 4)))
    mounting = Rotation.from_quat(rng.standard_normal((13, 4)))
    # R_bone = R_ref R_imu R_mounting^-1
    imu = np.swapaxes(reference.as_matrix(), 1, 2) @ vicon @ mounting.as_matrix()
    world = reference.as_matrix() @ imu
    force = np.einsum("tiab,a->tib", world, GRAVITY)
    frames = len(imu)
    wxyz = np.roll(Rotation.from_matrix(imu.reshape(-1, 3, 3)).as_quat(), 1, axis=1)
    rows = np.concatenate([wxyz.reshape(frames, 13, 4), force], axis=2)
    separator = "\t" if aux else " "
    lines = [f"13 {frames}"]
    for frame in range(frames):
        lines.append(str(frame + 1))
        for name, row in zip(SENSORS, rows[frame], strict=True):
            extra = [0.0] * 6 if aux else []
            lines.append(separator.join([name, *(f"{v:.8f}" for v in [*row, *extra])]))
    text = "\n".join(lines) + "\n"
    imus = root / "S1" / "imu"
    imus.mkdir(parents=True)
    name = "Acting1_Xsens_AuxFields.sensors" if aux else "s1_acting1_Xsens.sensors"
    (imus / name).write_text(text)
    for what, turns in (("ref", reference), ("bone", mounting)):
        quaternions = zip(SENSORS, turns.as_quat(), strict=True)
        lines = ["13", *(f"{n} " + " ".join(f"{v:.8f}" for v in q) for n, q in quaternions)]
        (imus / f"s1_acting1_calib_imu_{what}.txt").write_text("\n".join(lines) + "\n")


def calibration_cal(cameras: Rig) -> str:
    lines = [f"{len(cameras)} 1"]
    for camera in cameras.cameras:
        width, height = camera.size_px
        m = camera.matrix
        lines.append(f"0 {height - 1} 0 {width - 1}")
        lines.append(f"{m[0, 0]} {m[1, 1]} {m[0, 2]} {m[1, 2]}")
        lines.append(f"{camera.distortion[0]}")
        lines += [" ".join(map(repr, map(float, row))) for row in camera.rotation]
        lines.append(" ".join(map(repr, map(float, camera.translation))))
    return "\n".join(lines) + "\n"


# Human3.6M


def centre_entry(camera: Camera, new_from_old: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R and T (mm) of x_cam = R (X - T) in another world."""
    rotation = camera.rotation @ new_from_old.T
    return rotation, 1000.0 * new_from_old @ camera.position_in_world


def human36m(root: Path, actions=("Directions 1", "Directions", "Sitting"), packed=False):
    """Subjects S9 and S11; returns the true 17 points (T, 17, 3) in our world."""
    z_up = Y_UP_FROM_Z_UP.T
    ids = ("54138969", "55011271", "58860488", "60457274")
    cameras = rig(4, size_px=(1000, 1000), focal_px=1100.0, radius_m=5.5)
    named = Rig(
        cameras=tuple(
            Camera(
                name=name,
                size_px=c.size_px,
                matrix=c.matrix,
                distortion=c.distortion,
                rotation=c.rotation,
                translation=c.translation,
            )
            for name, c in zip(ids, cameras.cameras, strict=True)
        )
    )
    entries = {}
    for subject in ("S9", "S11"):
        for index, camera in enumerate(named.cameras, start=1):
            rotation, centre_mm = centre_entry(camera, z_up)
            entries[f"{subject}_cam{index}"] = {
                "id": camera.name,
                "R": rotation.tolist(),
                "T_camera_centre_mm": centre_mm.tolist(),
                "f": [camera.matrix[0, 0], camera.matrix[1, 1]],
                "c": [camera.matrix[0, 2], camera.matrix[1, 2]],
                "k123": [0, 0, 0],
                "p12": [0, 0],
            }
    root.mkdir(exist_ok=True)
    (root / "cameras.json").write_text(json.dumps(entries))
    shape = person(1.7)
    theta = motion(shape, rate_hz=50.0)
    points = landmarks_of(shape, theta, H36M17)
    joints_m = np.zeros((FRAMES, 32, 3))
    joints_m[:, SCORED] = points @ z_up.T
    packed_positions: dict = {}
    for subject in ("S9", "S11"):
        for action in actions:
            seen = {name: root / "keypoints" / subject / action / name for name in ids}
            write_keypoints(seen, named, [landmarks_of(shape, theta, BODY25)])
            packed_positions.setdefault(subject, {})[action] = joints_m.astype(np.float32)
            if not packed:
                (root / "positions" / subject).mkdir(parents=True, exist_ok=True)
                values = 1000.0 * joints_m.reshape(FRAMES, 96)
                np.save(root / "positions" / subject / f"{action}.npy", values)
    if packed:
        np.savez(root / "data_3d_h36m.npz", positions_3d=np.array(packed_positions, dtype=object))
    return points


# Panoptic


def panoptic(root: Path) -> np.ndarray:
    """Two people before four cameras; returns the 19 points (2, T, 19, 3) in our world."""
    down = Y_UP_FROM["-y"].T
    cameras = rig(4)
    names = [f"00_{index:02d}" for index in range(4)]
    entries = []
    for name, camera in zip(names, cameras.cameras, strict=True):
        entries.append(
            {
                "name": name,
                "resolution": list(camera.size_px),
                "K": camera.matrix.tolist(),
                "distCoef": [0, 0, 0, 0, 0],
                "R": (camera.rotation @ down.T).tolist(),
                "t": (100 * camera.translation).reshape(3, 1).tolist(),
            }
        )
    root.mkdir(parents=True, exist_ok=True)
    (root / "calibration_test.json").write_text(json.dumps({"cameras": entries}))
    shape = person(1.7)
    thetas = [
        placed(walk(shape, FRAMES, rate_hz=29.97), centre_m=(x, 0.0), turn_rad=3 * x)
        for x in (-0.8, 0.8)
    ]
    points = np.stack([landmarks_of(shape, theta, COCO19) for theta in thetas])
    poses = root / "hdPose3d_stage1_coco19"
    poses.mkdir()
    for frame in range(FRAMES):
        bodies = []
        for who, each in zip((3, 7), points, strict=True):
            rows = np.column_stack([100 * each[frame] @ down.T, np.full(19, 0.5)])
            bodies.append({"id": who, "joints19": rows.ravel().tolist()})
        text = json.dumps({"version": 0.7, "bodies": bodies})
        (poses / f"body3DScene_{frame:08d}.json").write_text(text)
    renamed = Rig(
        cameras=tuple(
            Camera(**{**_fields(camera), "name": name})
            for name, camera in zip(names, cameras.cameras, strict=True)
        )
    )
    folders = {name: root / "keypoints" / name for name in names}
    write_keypoints(folders, renamed, [landmarks_of(shape, theta, BODY25) for theta in thetas])
    return points


def _fields(camera: Camera) -> dict:
    return {
        name: getattr(camera, name)
        for name in ("size_px", "matrix", "distortion", "rotation", "translation")
    }


# DIP


def dip(frames: int = 30) -> tuple[dict, np.ndarray]:
    """A sequence's dict, and our bones' true rotations (T, 21, 3, 3)."""
    shape = person()
    theta = walk(shape, frames)
    _, rotation = forward_kinematics(shape, theta)
    smpl = np.tile(np.eye(3), (frames, 24, 1, 1))
    for bone, joint in SMPL_BONES.items():
        smpl[:, joint] = rotation[:, PAPER21.bone(bone)]
    # Joints that we have no bone for move with their parents.
    for joint, parent in enumerate(SMPL_PARENTS):
        if joint and joint not in SMPL_BONES.values():
            smpl[:, joint] = smpl[:, parent]
    local = smpl.copy()
    for joint, parent in enumerate(SMPL_PARENTS):
        if joint:
            local[:, joint] = np.swapaxes(smpl[:, parent], 1, 2) @ smpl[:, joint]
    pose = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(frames, 72)
    orientation = np.tile(np.eye(3), (frames, 17, 1, 1))
    for sensor, bone in enumerate(DIP_SENSORS):
        if bone:
            orientation[:, sensor] = rotation[:, PAPER21.bone(bone)]
    data = {"imu_ori": orientation, "imu_acc": np.zeros((frames, 17, 3)), "gt": pose}
    return data, rotation
