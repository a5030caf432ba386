"""A simulation written as a session folder, for `fusecap solve` and for readers' tests.

session.toml   calibration.toml   truth.npz
keypoints/<camera>/<camera>_<frame>_keypoints.json        OpenPose
imus/<subject>_<bone>.csv        time_s, qw, qx, qy, qz (imu_world_from_imu, y up), ax, ay, az,
                                 gx, gy, gz; lost samples have no row
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.shape import BodyShape
from fusecap.errors import InputError
from fusecap.evaluate.imu_noise import SimulatedImus
from fusecap.evaluate.simulator import Person, Simulation
from fusecap.files import safe_name, written_whole
from fusecap.geometry.quaternions import to_wxyz
from fusecap.progress import Progress
from fusecap.sources.calibration_files.formats import aniposelib
from fusecap.sources.toml_text import quoted
from fusecap.take import save_take


def write_session(
    simulation: Simulation,
    folder: Path | str,
    *,
    bone_lengths: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Write everything; returns the path of `session.toml`, which is written last.

    Bone lengths are written where they deviate from the stature's, unless told not to.
    """
    folder = Path(folder)
    _write(folder / "calibration.toml", aniposelib.dumps(simulation.rig.cameras))
    for name, view in zip(simulation.rig.names, simulation.views, strict=True):
        for frame, people in enumerate(view.people):
            _write(
                folder / "keypoints" / name / f"{name}_{frame:012d}_keypoints.json",
                _openpose_json(people),
            )
            if progress:
                progress(f"writing '{name}'", frame + 1, len(view.people))
    for subject, imus in simulation.imus.items():
        for sensor, bone in enumerate(imus.bones):
            _write(folder / _imu_file(subject, bone), _imu_csv(imus, sensor))
    save_take(simulation.truth, folder / "truth.npz")
    path = folder / "session.toml"
    with written_whole(path) as file:
        file.write(_session_toml(simulation, bone_lengths).encode())
    return path


def _session_toml(simulation: Simulation, bone_lengths: bool) -> str:
    fmt = f"openpose-{simulation.landmark_set.name}"
    head = [
        f"# Simulated; seed {simulation.seed}. The truth is in truth.npz.",
        "[session]",
        f"name = {quoted(simulation.name)}",
        f"rate_hz = {simulation.rate_hz!r}",
        *(['calibration = "calibration.toml"'] if len(simulation.rig) else []),
        'up = "y"',
        "floor = true",
        f"max_subjects = {len(simulation.subjects)}",
    ]
    if simulation.volume_m is not None:
        head.append(f"volume_m = {list(simulation.volume_m)}")
    tables = ["\n".join(head) + "\n"]
    tables += [
        "[[camera]]\n"
        f"name = {quoted(name)}\n"
        f"keypoints = {quoted(f'keypoints/{name}')}\n"
        f'format = "{fmt}"\n'
        f"rate_hz = {view.timing.rate_hz!r}\n"
        f"offset_s = {view.timing.offset_s!r}\n"
        for name, view in zip(simulation.rig.names, simulation.views, strict=True)
    ]
    for person in simulation.subjects:
        tables.append(_subject_toml(person, bone_lengths))
        if person.name in simulation.imus:
            tables += _imu_toml(person.name, simulation.imus[person.name])
    return "\n".join(tables)


def _subject_toml(person: Person, bone_lengths: bool) -> str:
    shape = person.shape
    proportions = BodyShape.from_height(shape.skeleton, shape.height_m).offsets_m
    lengths = [
        f"{name} = {float(np.linalg.norm(shape.offsets_m[bone]))!r}"
        for bone, name in enumerate(shape.skeleton.bone_names)
        if bone_lengths and not np.allclose(shape.offsets_m[bone], proportions[bone], atol=1e-9)
    ]
    return (
        "[[subject]]\n"
        f"name = {quoted(person.name)}\n"
        f"height_m = {shape.height_m!r}\n"
        f"start_m = {np.round(person.theta[0, [0, 2]], 2).tolist()}\n"
        + (f"bone_lengths_m = {{ {', '.join(lengths)} }}\n" if lengths else "")
    )


def _imu_toml(subject: str, imus: SimulatedImus) -> list[str]:
    quaternion = to_wxyz(Rotation.from_matrix(imus.bone_from_imu))
    return [
        "[[subject.imu]]\n"
        f"bone = {quoted(bone)}\n"
        f"file = {quoted(_imu_file(subject, bone))}\n"
        'format = "csv"\n'
        f"bone_from_imu_wxyz = {quaternion[sensor].tolist()}\n"
        f"position_m = {imus.position_in_bone_m[sensor].tolist()}\n"
        'imu_up = "y"\n'
        for sensor, bone in enumerate(imus.bones)
    ]


def _imu_file(subject: str, bone: str) -> str:
    return f"imus/{safe_name(subject)}_{bone}.csv"


def _imu_csv(imus: SimulatedImus, sensor: int) -> str:
    columns = [
        imus.times_s,
        imus.orientation_wxyz(sensor),
        imus.accel_m_s2[:, sensor],
        imus.gyro_rad_s[:, sensor],
    ]
    rows = np.column_stack(columns)[imus.received[:, sensor]]
    lines = ["time_s,qw,qx,qy,qz,ax,ay,az,gx,gy,gz"]
    lines += [",".join(f"{value:.9f}" for value in row) for row in rows]
    return "\n".join(lines) + "\n"


def _openpose_json(people: Float[np.ndarray, "n k 3"]) -> str:
    rows = [person.ravel().tolist() for person in np.nan_to_num(np.round(people, 3))]
    return json.dumps(
        {
            "version": 1.3,
            "people": [{"person_id": [-1], "pose_keypoints_2d": row} for row in rows],
        }
    )


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
