"""Total Capture (Trumble et al. 2017): one person, 8 cameras, 13 IMUs, optical truth; 60 Hz.

    FOLDER/keypoints/S1/acting1/cam1/*.json ... cam8    OpenPose BODY_25, of the videos
    and, anywhere below FOLDER:
    calibration.cal
    S1/.../acting1/gt_skel_gbl_pos.txt, gt_skel_gbl_ori.txt
    s1_acting1_Xsens.sensors, or S1/.../Acting1_Xsens_AuxFields.sensors
    s1_acting1_calib_imu_ref.txt, s1_acting1_calib_imu_bone.txt

Truth: 21 joints in inches, y up; orientations x y z w. Cameras: `nCams order`, then per camera
`minRow maxRow minCol maxCol`, `fx fy cx cy`, the radial coefficients, R row by row, t in metres;
`x_cam = R X + t`. Sensors: w x y z into a z-up world, specific force in the sensor's axes;
AuxFields adds gyroscope and magnetometer. Calibrations x y z w:

    R_bone_in_vicon = R_ref R_imu R_bone^-1

The files can differ by a few frames: the shortest counts. Bones are parallel to the world in the
rest pose, but which way that faces is not documented, so the truth itself is asked: the line from
the right to the left thigh in the frame of the hips, turned about up in steps of 90 degrees until
it points along x as in our rest pose.

This loader has met files that were made to this description, not the data set.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet, landmark_set_named
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.errors import InputError
from fusecap.evaluate.datasets.files import floats, text_of
from fusecap.evaluate.datasets.recording import BoneTruth, DatasetSequence, last_frame, read_views
from fusecap.geometry.camera import Camera, Rig
from fusecap.geometry.quaternions import from_wxyz
from fusecap.solve.estimator import SubjectModel
from fusecap.solve.pose_solver import ImuSites
from fusecap.sources.calibration_files import fields
from fusecap.types import GRAVITY_M_S2, ImuReading

RATE_HZ = 60.0
METRES_PER_INCH = 0.0254
SENSORS = {
    "Head": "head",
    "Sternum": "spine3",
    "Pelvis": "hips",
    "L_UpArm": "left_upper_arm",
    "R_UpArm": "right_upper_arm",
    "L_LowArm": "left_forearm",
    "R_LowArm": "right_forearm",
    "L_UpLeg": "left_thigh",
    "R_UpLeg": "right_thigh",
    "L_LowLeg": "left_shank",
    "R_LowLeg": "right_shank",
    "L_Foot": "left_foot",
    "R_Foot": "right_foot",
}
"""In the files' order, and our bone that carries each."""
JOINTS = {
    "Hips": "hips",
    "Spine": "spine",
    "Spine1": "spine1",
    "Spine2": "spine2",
    "Spine3": "spine3",
    "Neck": "neck",
    "Head": "head",
    **{
        f"{side}{part}": f"{side.lower()}_{bone}"
        for side in ("Right", "Left")
        for part, bone in (
            ("Shoulder", "clavicle"),
            ("Arm", "upper_arm"),
            ("ForeArm", "forearm"),
            ("Hand", "hand"),
            ("UpLeg", "thigh"),
            ("Leg", "shank"),
            ("Foot", "foot"),
        )
    },
}
"""The truth's 21 joints and our bones; the clavicles are in `extended23` only."""
TEST_SEQUENCES = ("walking2", "acting3", "freestyle3")
_FACING_TOLERANCE_DEG = 20.0


@dataclass(frozen=True, kw_only=True)
class Sequence:
    """Where one sequence's files are."""

    subject: str
    """"S1"."""
    name: str
    """"acting1"."""
    positions: Path
    orientations: Path
    sensors: Path | None
    imu_ref: Path | None
    imu_bone: Path | None
    calibration: Path | None
    keypoints: Path
    """Folder of cam1, cam2, ..."""

    @property
    def key(self) -> str:
        """Such as "S1 acting1"."""
        return f"{self.subject} {self.name}"


def list_sequences(folder: Path | str) -> tuple[Sequence, ...]:
    """Every sequence below `folder` that has truth, by subject and name; raises `InputError`."""
    folder = Path(folder)
    files = _files_below(folder)
    calibrations = [path for path in files if path.suffix == ".cal"]
    found = []
    for path in files:
        if path.name != "gt_skel_gbl_pos.txt":
            continue
        name = path.parent.name.lower()
        subjects = [part for part in path.parts if _is_subject(part)]
        if not subjects:
            raise InputError(
                f"{path}: no folder above it is called S1 ... S5; expected .../S1/.../{name}/"
            )
        subject = subjects[-1].upper()

        def of_sequence(suffix: str, subject: str = subject, name: str = name) -> Path | None:
            return _of_sequence(files, subject, name, suffix)

        found.append(
            Sequence(
                subject=subject,
                name=name,
                positions=path,
                orientations=path.with_name("gt_skel_gbl_ori.txt"),
                sensors=of_sequence("xsens.sensors") or of_sequence("xsens_auxfields.sensors"),
                imu_ref=of_sequence("calib_imu_ref.txt"),
                imu_bone=of_sequence("calib_imu_bone.txt"),
                calibration=calibrations[0] if calibrations else None,
                keypoints=folder / "keypoints" / subject / name,
            )
        )
    if not found:
        raise InputError(
            f"{folder}: no gt_skel_gbl_pos.txt below it; expected Total Capture, unpacked"
        )
    return tuple(sorted(found, key=lambda each: (each.subject, each.name)))


def load_sequence(
    sequence: Sequence,
    *,
    skeleton: Skeleton = PAPER21,
    landmarks: LandmarkSet | None = None,
    height_m: float | None = None,
) -> DatasetSequence:
    """One sequence; raises `InputError`.

    Bone lengths are the truth's, as in the paper, or with `height_m` those of a stature.
    """
    landmarks = landmarks or landmark_set_named("body25")
    truth = read_truth(sequence.positions, sequence.orientations)
    facing = rest_facing(truth, sequence.orientations)
    truth = BoneTruth(
        names=truth.names,
        points_in_world_m=truth.points_in_world_m,
        rotation_in_world=truth.rotation_in_world @ facing,
    ).on(skeleton)
    if sequence.calibration is None:
        raise InputError("no calibration.cal below the folder; expected Total Capture's cameras")
    rig = read_rig(sequence.calibration)
    views = read_views({name: sequence.keypoints / name for name in rig.names}, landmarks, RATE_HZ)
    imus = _read_imus(sequence, facing)
    counts = {
        "truth": truth.points_in_world_m.shape[1],
        "sensors": len(imus),
        "keypoints": last_frame(views),
    }
    frames = min(counts.values())
    notes = ()
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{what} {count}" for what, count in counts.items())
        notes = (f"{sequence.key}: frames differ ({listed}); the first {frames} are used",)
    shape = (
        BodyShape.from_height(skeleton, height_m)
        if height_m is not None
        else shape_of_truth(truth, skeleton)
    )
    sites = ImuSites(
        bone=tuple(skeleton.bone(bone) for bone in SENSORS.values()),
        position_m=np.zeros((len(SENSORS), 3)),
    )
    return DatasetSequence(
        name=sequence.key,
        rate_hz=RATE_HZ,
        frames=frames,
        rig=rig,
        landmarks=landmarks,
        views=views,
        subjects=(SubjectModel(name=sequence.subject, shape=shape, sites=sites),),
        imu={sequence.subject: imus[:frames]},
        truth=BoneTruth(
            names=truth.names,
            points_in_world_m=truth.points_in_world_m[:, :frames],
            rotation_in_world=truth.rotation_in_world[:, :frames],
        ),
        skeleton=skeleton,
        max_subjects=1,
        notes=notes,
    )


def read_rig(path: Path) -> Rig:
    """`calibration.cal`; cameras are called cam1, cam2, ... in the file's order."""
    words = text_of(path, "Total Capture's calibration.cal").split()
    values = floats(words, str(path))
    if len(values) < 2:
        raise InputError(f"{path}: is empty; expected the number of cameras and their parameters")
    count, order = int(values[0]), int(values[1])
    size = 8 + order + 12
    if not 0 <= order <= 3 or len(values) != 2 + count * size:
        raise InputError(
            f"{path}: {len(values)} numbers; expected {2 + count * size} for {count} cameras with "
            f"{order} distortion coefficients (at most 3)"
        )
    cameras = []
    for index, row in enumerate(values[2:].reshape(count, size), start=1):
        cameras.append(_camera(path, f"cam{index}", row, order))
    return Rig(cameras=tuple(cameras))


def _camera(path: Path, name: str, row: np.ndarray, order: int) -> Camera:
    min_row, max_row, min_column, max_column, fx, fy, cx, cy = row[:8]
    distortion = np.zeros(5)
    distortion[[0, 1, 4][:order]] = row[8 : 8 + order]
    return fields.camera(
        path,
        name=name,
        size_px=np.array([max_column - min_column + 1, max_row - min_row + 1]),
        matrix=np.array([[fx, 0, cx - min_column], [0, fy, cy - min_row], [0, 0, 1]]),
        distortion=distortion,
        rotation=row[8 + order : 17 + order].reshape(3, 3),
        translation=row[17 + order :],
    )


def read_truth(positions: Path, orientations: Path) -> BoneTruth:
    """Joints [m] and global rotations under our bones' names, in the files' own rest frame."""
    names, inches = _read_skeleton(positions, 3)
    other, xyzw = _read_skeleton(orientations, 4)
    if names != other:
        raise InputError(f"{orientations}: its joints differ from those of {positions.name}")
    frames = min(len(inches), len(xyzw))
    quaternion = xyzw[:frames].reshape(-1, 4)
    norm = np.linalg.norm(quaternion, axis=1)
    if (np.abs(norm - 1) > 0.01).any():
        raise InputError(f"{orientations}: holds quaternions that are not unit")
    rotation = Rotation.from_quat(quaternion).as_matrix().reshape(1, frames, len(names), 3, 3)
    return BoneTruth(
        names=tuple(JOINTS[name] for name in names),
        points_in_world_m=inches[None, :frames] * METRES_PER_INCH,
        rotation_in_world=rotation,
    )


def rest_facing(truth: BoneTruth, where: Path) -> Float[np.ndarray, "3 3"]:
    """Rotation about up that brings our rest pose, facing +z, onto that of the truth's axes.

    `rotation_in_world @ rest_facing` are rotations of our bones. Raises `InputError` when the
    axes are not those of a T-pose along the world's axes.
    """
    row = truth.names.index
    hips = truth.rotation_in_world[0, :, row("hips")]
    points = truth.points_in_world_m[0]
    across = points[:, row("left_thigh")] - points[:, row("right_thigh")]
    left = np.median(np.einsum("tji,tj->ti", hips, across), axis=0)
    above = points[:, row("spine3")] - points[:, row("hips")]
    up = np.median(np.einsum("tji,tj->ti", hips, above), axis=0)
    heading = np.arctan2(-left[2], left[0])
    turn = np.round(heading / (np.pi / 2)) * np.pi / 2
    rest = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
    for direction, expected in ((left, rest[:, 0]), (up, np.array([0.0, 1.0, 0.0]))):
        cosine = direction @ expected / max(np.linalg.norm(direction), 1e-9)
        if np.degrees(np.arccos(np.clip(cosine, -1, 1))) > _FACING_TOLERANCE_DEG:
            raise InputError(
                f"{where}: in the frame of the hips the left is {np.round(left, 2).tolist()} and "
                f"up {np.round(up, 2).tolist()}; expected axes of the world in a T-pose, y up "
                "(quaternions x y z w)"
            )
    return rest


def shape_of_truth(truth: BoneTruth, skeleton: Skeleton) -> BodyShape:
    """Bone lengths of the truth's skeleton; what it lacks (toes) by the stature that fits it."""
    reference = BodyShape.from_height(skeleton, REFERENCE_HEIGHT_M)
    row = {name: index for index, name in enumerate(truth.names)}
    measured: dict[int, np.ndarray] = {}
    for bone, parent in enumerate(skeleton.parents):
        name, above = skeleton.bone_names[bone], skeleton.bone_names[parent]
        if parent >= 0 and name in row and above in row:
            away = (
                truth.points_in_world_m[0, :, row[name]] - truth.points_in_world_m[0, :, row[above]]
            )
            rotation = truth.rotation_in_world[0, :, row[above]]
            measured[bone] = np.median(np.einsum("tji,tj->ti", rotation, away), axis=0)
    length = sum(float(np.linalg.norm(offset)) for offset in measured.values())
    expected = sum(float(np.linalg.norm(reference.offsets_m[bone])) for bone in measured)
    shape = BodyShape.from_height(skeleton, REFERENCE_HEIGHT_M * length / max(expected, 1e-9))
    offsets = shape.offsets_m.copy()
    for bone, offset in measured.items():
        offsets[bone] = offset
    return BodyShape(skeleton=skeleton, offsets_m=offsets, height_m=shape.height_m)


def read_sensors(path: Path) -> tuple[Float[np.ndarray, "t 13 4"], Float[np.ndarray, "t 13 3"]]:
    """Quaternions (w, x, y, z) and specific force [m/s²], in the order of `SENSORS`.

    A file that ends early gives the frames that are whole.
    """
    lines = text_of(path, "Xsens .sensors").splitlines()
    head = lines[0].split() if lines else []
    if len(head) != 2 or head[0] != str(len(SENSORS)):
        raise InputError(
            f"{path}: starts with '{' '.join(head)[:40]}', expected '{len(SENSORS)} <frames>'"
        )
    block = len(SENSORS) + 1
    frames = min(int(floats(head[1:], str(path))[0]), (len(lines) - 1) // block)
    if frames < 1:
        raise InputError(f"{path}: no whole frame of {len(SENSORS)} sensors")
    values = np.full((frames, len(SENSORS), 7), np.nan)
    order = list(SENSORS)
    for frame in range(frames):
        first = 1 + frame * block
        for line in range(first + 1, first + block):
            words = lines[line].split()
            where = f"{path}, line {line + 1}"
            if not words or words[0] not in SENSORS or len(words) not in (8, 14):
                raise InputError(
                    f"{where}: found '{lines[line][:40]}', expected a sensor's name and 7 numbers "
                    "(13 with gyroscope and magnetometer)"
                )
            values[frame, order.index(words[0])] = floats(words[1:8], where)
    if not np.isfinite(values).all():
        raise InputError(f"{path}: a frame lacks one of the {len(SENSORS)} sensors")
    return values[:, :, :4], values[:, :, 4:]


def read_imu_calibration(path: Path) -> Float[np.ndarray, "13 3 3"]:
    """Rotations in the order of `SENSORS`, from lines `Name x y z w`."""
    lines = text_of(path, "an IMU calibration").splitlines()
    found = {}
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words:
            continue
        if len(words) != 5 or words[0] not in SENSORS:
            raise InputError(f"{path}, line {number}: found '{line[:40]}', expected Name x y z w")
        quaternion = floats(words[1:], f"{path}, line {number}")
        if abs(np.linalg.norm(quaternion) - 1) > 0.05:
            raise InputError(f"{path}, line {number}: the quaternion is not unit")
        found[words[0]] = Rotation.from_quat(quaternion).as_matrix()
    missing = [name for name in SENSORS if name not in found]
    if missing:
        raise InputError(f"{path}: no calibration of {', '.join(missing)}")
    return np.stack([found[name] for name in SENSORS])


def _read_imus(sequence: Sequence, facing: Float[np.ndarray, "3 3"]) -> list[ImuReading]:
    for what, path in (
        ("<sequence>_Xsens.sensors", sequence.sensors),
        ("<subject>_<sequence>_calib_imu_ref.txt", sequence.imu_ref),
        ("<subject>_<sequence>_calib_imu_bone.txt", sequence.imu_bone),
    ):
        if path is None:
            raise InputError(f"{sequence.key}: no {what} below the folder")
    assert sequence.sensors and sequence.imu_ref and sequence.imu_bone
    wxyz, force = read_sensors(sequence.sensors)
    reference = read_imu_calibration(sequence.imu_ref)
    bone = read_imu_calibration(sequence.imu_bone)
    frames, sensors = wxyz.shape[:2]
    world_from_imu = from_wxyz(wxyz.reshape(-1, 4)).as_matrix().reshape(frames, sensors, 3, 3)
    world_from_imu = reference @ world_from_imu
    rotation = world_from_imu @ np.swapaxes(bone, 1, 2) @ facing
    accel = np.einsum("tiab,tib->tia", world_from_imu, force) - [0.0, GRAVITY_M_S2, 0.0]
    return [
        ImuReading(bone_rotation_in_world=r, accel_in_world_m_s2=a)
        for r, a in zip(rotation, accel, strict=True)
    ]


def _read_skeleton(path: Path, width: int) -> tuple[list[str], Float[np.ndarray, "t 21 w"]]:
    lines = text_of(path, "Total Capture's truth").splitlines()
    names = lines[0].split() if lines else []
    if sorted(names) != sorted(JOINTS):
        raise InputError(
            f"{path}: the first line names {len(names)} joints, expected the 21 of Total Capture "
            f"({', '.join(list(JOINTS)[:3])}, ...)"
        )
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        words = line.split()
        if not words:
            continue
        if len(words) != width * len(names):
            raise InputError(
                f"{path}, line {number}: {len(words)} numbers, expected {width * len(names)}"
            )
        rows.append(floats(words, f"{path}, line {number}"))
    if not rows:
        raise InputError(f"{path}: no frame below the names")
    return names, np.array(rows).reshape(len(rows), len(names), width)


def _files_below(folder: Path) -> list[Path]:
    """All files but keypoints, sorted."""
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; expected Total Capture, unpacked")
    found = []
    for root, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name != "keypoints")
        found += [Path(root) / name for name in sorted(files)]
    return found


def _of_sequence(files: Iterable[Path], subject: str, name: str, suffix: str) -> Path | None:
    """The file `s1_acting1_<suffix>`, or `acting1_<suffix>` below a folder S1; any case."""
    for path in files:
        lower = path.name.lower()
        if lower == f"{subject.lower()}_{name}_{suffix}":
            return path
        below = any(part.upper() == subject for part in path.parts)
        if below and lower == f"{name}_{suffix}":
            return path
    return None


def _is_subject(part: str) -> bool:
    return len(part) == 2 and part[0] in "sS" and part[1].isdigit()
