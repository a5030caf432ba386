"""How sensors sit on bones by a pose that is known: N-pose, a trial of its own, MVN's own."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError, SessionError
from fusecap.sources.imu_files import read_imu
from fusecap.sources.sensor_bones import bone_of
from fusecap.sources.session_file import load_session
from fusecap.sources.session_sensors import mount, open_imus
from fusecap.sources.synchronizer import world_from_imu_world
from session_files import imu_csv

MOUNTED = Rotation.from_rotvec([0.4, -1.1, 0.7])
"""bone_from_imu."""
Z_UP = Rotation.from_matrix(world_from_imu_world("z", 0.0))
HANGING = {
    "left_forearm": Rotation.from_euler("z", -90, degrees=True),
    "right_upper_arm": Rotation.from_euler("z", 90, degrees=True),
    "left_thigh": Rotation.identity(),
}
TIMES_S = np.arange(121) / 60


def sensor(bone_in_world: Rotation) -> str:
    """Two seconds of a bone, in the sensor's z-up world."""
    wxyz = np.roll((Z_UP.inv() * bone_in_world * MOUNTED).as_quat(), 1)
    return imu_csv(TIMES_S, np.tile(wxyz, (len(TIMES_S), 1)))


def write(folder, pose: str, bones, *, static: bool = False):
    folder.mkdir(exist_ok=True)
    text = f'[session]\nname = "s"\n\n[[subject]]\nname = "anna"\n{pose}\n'
    for bone in bones:
        still = Rotation.from_euler("y", 40, degrees=True) * HANGING[bone]
        elsewhere = Rotation.from_rotvec([0.3, 0.5, -1.2])
        (folder / f"{bone}.csv").write_text(sensor(elsewhere if static else still))
        (folder / f"{bone}_static.csv").write_text(sensor(still))
        text += f'\n[[subject.imu]]\nbone = "{bone}"\nfile = "{bone}.csv"\n'
        text += f'static_file = "{bone}_static.csv"\n' if static else ""
    (folder / "session.toml").write_text(text)
    return folder


def mountings(folder):
    (anna,) = load_session(folder).subjects
    return [imu.bone_from_imu for imu in mount(anna, open_imus(anna))]


@pytest.mark.parametrize("static", [False, True], ids=["within", "trial of its own"])
def test_arms_hang_in_the_n_pose(tmp_path, static):
    pose = "npose_s = [0.5, 1.5]\ntpose_facing_deg = 40"
    for found in mountings(write(tmp_path, pose, HANGING, static=static)):
        assert np.allclose(found, MOUNTED.as_matrix(), atol=1e-6)


def test_both_poses_and_a_missing_trial_are_refused(tmp_path):
    write(tmp_path, "npose_s = [0.5, 1.5]\ntpose_s = [0.5, 1.5]", HANGING)
    with pytest.raises(SessionError, match="both tpose_s and npose_s"):
        load_session(tmp_path)
    write(tmp_path, "npose_s = [5, 7]", HANGING)
    with pytest.raises(SessionError, match=r"no sample in npose_s = \[5, 7\]"):
        mountings(tmp_path)
    write(tmp_path, "npose_s = [0.5, 1.5]", HANGING, static=True)
    (tmp_path / "left_thigh_static.csv").unlink()
    with pytest.raises(InputError, match="left_thigh_static"):
        mountings(tmp_path)


def mvnx(tmp_path, *, tilt: Rotation, segments: bool = True):
    """A pelvis whose axes are `tilt` in the T-pose, and that turns before the sensor's world."""
    permuted = Rotation.from_matrix([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    frames = ""
    for index, angle in enumerate(np.linspace(0, 1.5, 20)):
        bone = Z_UP.inv() * Rotation.from_rotvec([0.2 * angle, angle, 0.1])
        segment = bone * permuted * tilt
        both = [
            f"<{tag}>{' '.join(f'{v:.9f}' for v in np.roll(turned.as_quat(), 1))}</{tag}>"
            for tag, turned in (("orientation", segment), ("sensorOrientation", bone * MOUNTED))
            if segments or tag != "orientation"
        ]
        frames += f'<frame index="{index}" type="normal">{"".join(both)}</frame>\n'
    w, x, y, z = np.roll(tilt.as_quat(), 1)
    path = tmp_path / "a.mvnx"
    path.write_text(
        '<mvnx version="4"><subject frameRate="60"><segments><segment label="Pelvis"/></segments>'
        '<sensors><sensor label="Pelvis"/></sensors><frames>'
        f'<frame type="tpose"><orientation>{w} {x} {y} {z}</orientation></frame>{frames}'
        "</frames></subject></mvnx>"
    )
    return path


@pytest.mark.parametrize("tilt", [[0, 0, 0], [0, -0.1, 0], [np.pi / 2, 0, 0]])
def test_mvn_knows_how_its_sensors_sit(tmp_path, tilt):
    path = mvnx(tmp_path, tilt=Rotation.from_rotvec(tilt))
    found = read_imu(path, format="mvnx", sensor="Pelvis").bone_from_imu
    assert found is not None and np.allclose(found, MOUNTED.as_matrix(), atol=1e-6)


def test_what_a_session_states_comes_before_what_mvn_found(tmp_path):
    mvnx(tmp_path, tilt=Rotation.identity())
    text = '[session]\nname = "s"\n\n[[subject]]\nname = "anna"\n\n[[subject.imu]]\nbone = "hips"\n'
    text += 'file = "a.mvnx"\nformat = "mvnx"\nsensor = "Pelvis"\n'
    (tmp_path / "session.toml").write_text(text)
    assert np.allclose(mountings(tmp_path), MOUNTED.as_matrix(), atol=1e-6)
    (tmp_path / "session.toml").write_text(text + "bone_from_imu_wxyz = [1, 0, 0, 0]\n")
    assert np.allclose(mountings(tmp_path), np.eye(3))
    mvnx(tmp_path, tilt=Rotation.identity(), segments=False)
    (tmp_path / "session.toml").write_text(text)
    with pytest.raises(SessionError, match="how it sits on the bone is not known"):
        mountings(tmp_path)


LIMBS = {"RightUpperArm": -1, "RightForeArm": -1, "LeftUpperArm": 1, "LeftForeArm": 1}
"""Where they point in the rest pose, along x."""


@pytest.mark.parametrize(
    "name", ["test_mocap_mvnx_v4_upperbody.mvnx", "Meri-020_mvnx_v3_4frames.mvnx"]
)
def test_limbs_of_real_files_lie_where_mvn_has_them(data_dir, name):
    from fusecap.sources.imu_files.formats import mvnx as format

    path = data_dir / "xsens_mvnx" / name
    root = format._root(path)
    labels = [element.get("label") for element in root.iterfind(".//{*}segments/{*}segment")]
    frames = [f for f in root.iterfind(".//{*}frames/{*}frame") if f.get("type") == "normal"]
    for limb, sign in LIMBS.items():
        near, far = (
            format._vectors(frames, "position", labels.index(limb) + step, 3) for step in (0, 1)
        )
        along = Z_UP.apply(far - near)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        track = read_imu(path, format="mvnx", sensor=limb)
        turned = Rotation.from_quat(np.roll(track.orientation_wxyz, -1, axis=1))
        bone = Z_UP * turned * Rotation.from_matrix(track.bone_from_imu).inv()
        off = np.degrees(np.arccos(np.clip(np.sum(bone.apply([sign, 0, 0]) * along, 1), -1, 1)))
        assert off.max() < 6.0, (limb, bone_of(limb))
