from __future__ import annotations

import io
import tarfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.errors import InputError
from fusecap.motion.files.amc import parse_amc, parse_asf
from fusecap.motion.files.bvh import parse_bvh
from fusecap.motion.files.expmap import parse_expmap
from fusecap.motion.motion import CMU_UNIT_M
from fusecap.motion.motion_folder import MotionFolder
from motion_texts import BVH_TEXT, amc_text, asf_text, expmap_text


@pytest.fixture
def skeleton():
    return parse_asf(asf_text(), "01.asf")


def test_asf_lengths_become_metres(skeleton):
    femur = skeleton.joint_names.index("lfemur")
    assert np.linalg.norm(skeleton.bone_vector_m[femur]) == pytest.approx(7.0 * CMU_UNIT_M)


def test_amc_knee_turns_about_the_splayed_axis(skeleton):
    motion = parse_amc(amc_text([{"ltibia": (90.0,)}]), skeleton, "01_01.amc")
    tilt = Rotation.from_euler("z", 20, degrees=True)
    expected = tilt * Rotation.from_euler("x", 90, degrees=True) * tilt.inv()
    tibia = motion.joint_names.index("ltibia")
    np.testing.assert_allclose(motion.rotation_in_world[0, tibia], expected.as_matrix(), atol=1e-12)


def test_amc_root_carries_position_and_rotation(skeleton):
    motion = parse_amc(amc_text([{"root": (1, 2, 3, 0, 90, 0)}]), skeleton, "01_01.amc")
    np.testing.assert_allclose(motion.root_position_m[0], np.array([1, 2, 3]) * CMU_UNIT_M)
    head = motion.joint_names.index("head")
    np.testing.assert_allclose(motion.rotation_in_world[0, head] @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    assert motion.rate_hz == 120.0


def test_amc_cut_inside_a_frame_names_the_frame(skeleton):
    text = amc_text([{}, {}, {}])
    with pytest.raises(InputError, match="ends in the middle of frame 3"):
        parse_amc(text[: text.rindex("rwrist")], skeleton, "01_01.amc")


def test_amc_garbled_number_is_an_input_error(skeleton):
    with pytest.raises(InputError, match=r"01_01\.amc"):
        parse_amc(amc_text([{}, {}]).replace("rradius 0.0", "rradius 0.x0"), skeleton, "01_01.amc")


def test_amc_of_another_skeleton_names_the_bone(skeleton):
    with pytest.raises(InputError, match="bone 'tail' is not in"):
        parse_amc(amc_text([{}]).replace("head", "tail"), skeleton, "01_01.amc")


@pytest.mark.parametrize("section", [":units", ":root", ":bonedata", ":hierarchy"])
def test_asf_without_a_section_says_which(section):
    with pytest.raises(InputError, match=section):
        parse_asf(asf_text().replace(section, ":other"), "01.asf")


def test_asf_cut_short_is_an_input_error():
    text = asf_text()
    for share in np.linspace(0.05, 0.95, 10):
        with pytest.raises(InputError):
            parse_asf(text[: int(share * len(text))], "01.asf")


def test_bvh_channels_turn_about_moving_axes():
    motion = parse_bvh(BVH_TEXT, "a.bvh", unit_m=1.0)
    hips = Rotation.from_euler("z", 90, degrees=True)
    arm = Rotation.from_euler("ZYX", [10, 20, 30], degrees=True)
    np.testing.assert_allclose(motion.rotation_in_world[0, 1], (hips * arm).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(motion.root_position_m, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(motion.bone_vector_m, [[1, 0, 0], [2, 0, 0], [0.5, 0, 0]])
    assert motion.rate_hz == pytest.approx(100.0)


def test_bvh_rest_pose_that_opens_a_take_is_dropped():
    text = BVH_TEXT.replace("1 2 3 90 0 0 10 20 30", "1 2 3 0 0 0 0 0 0")
    assert len(parse_bvh(text, "a.bvh")) == 1


def test_bvh_cut_anywhere_is_an_input_error():
    for end in range(0, len(BVH_TEXT) - 3, 7):
        with pytest.raises(InputError, match=r"a\.bvh"):
            parse_bvh(BVH_TEXT[:end], "a.bvh")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("OFFSET 1 0 0", "OFFSET 1 nan 0"),
        ("Frame Time: 0.01", "Frame Time: zero"),
        ("Frames: 2", "Frames: 3"),
        ("JOINT Arm", "BONE Arm"),
        ("CHANNELS 3 Zrotation Yrotation", "CHANNELS 3 Zrotation Wrotation"),
        ("4 5 6", "4 5 inf"),
    ],
)
def test_bvh_garbled_is_an_input_error(old, new):
    with pytest.raises(InputError, match=r"a\.bvh"):
        parse_bvh(BVH_TEXT.replace(old, new), "a.bvh")


def test_expmap_rotations_act_on_rows(rng):
    vectors = np.zeros((1, 38, 3))
    vectors[0, 3] = [-0.4, 0.0, 0.0]
    motion = parse_expmap(expmap_text(vectors), "walk.txt")
    shank = motion.joint_names.index("LeftLeg")
    backwards = motion.rotation_in_world[0, shank] @ [0.0, -1.0, 0.0]
    assert backwards[2] < -0.3
    np.testing.assert_allclose(motion.root_position_m[0], np.array([1, 17, 2]) * CMU_UNIT_M)


def test_expmap_root_that_turns_round_turns_evenly():
    heading = np.linspace(0.0, 4 * np.pi, 400)
    tilt = np.full_like(heading, 0.1)
    # The angles of Rz Ry Rx, put together as the files have them.
    as_filed = Rotation.from_euler("ZXY", np.stack([0.5 * tilt, tilt, heading], axis=1))
    vectors = np.zeros((400, 38, 3))
    vectors[:, 0] = -as_filed.as_rotvec()
    motion = parse_expmap(expmap_text(vectors), "turn.txt")
    expected = Rotation.from_euler("ZYX", np.stack([0.5 * tilt, heading, tilt], axis=1))
    np.testing.assert_allclose(motion.rotation_in_world[:, 0], expected.as_matrix(), atol=1e-9)


def test_expmap_row_of_wrong_width_is_named():
    text = expmap_text(np.zeros((3, 38, 3)))
    with pytest.raises(InputError, match="row 4 has 115 numbers; expected 117"):
        parse_expmap(text.rsplit(",", 2)[0], "walk.txt")
    with pytest.raises(InputError, match="at least one row"):
        parse_expmap("", "walk.txt")


def test_a_folder_finds_takes_loose_and_in_archives(tmp_path):
    (tmp_path / "bvh").mkdir()
    (tmp_path / "bvh" / "06_01.bvh").write_text(BVH_TEXT)
    (tmp_path / "notes.txt").write_text("nothing to read")
    with tarfile.open(tmp_path / "asfamc.tar.xz", "w:xz") as tar:
        for name, text in {
            "asfamc/01/01.asf": asf_text(),
            "asfamc/01/01_01.amc": amc_text([{}]),
        }.items():
            info = tarfile.TarInfo(name)
            info.size = len(text)
            tar.addfile(info, io.BytesIO(text.encode()))
    folder = MotionFolder(tmp_path)
    assert folder.keys == ["asfamc/01/01_01", "bvh/06_01"]
    assert folder["asfamc/01/01_01"].joint_names[0] == "root"
    with pytest.raises(InputError, match="did you mean 'bvh/06_01'"):
        folder["bvh/06_10"]


def test_an_amc_without_its_skeleton_says_so(tmp_path):
    (tmp_path / "01_01.amc").write_text(amc_text([{}]))
    with pytest.raises(InputError, match=r"expected its skeleton '01\.asf'"):
        MotionFolder(tmp_path)["01_01"]


def test_a_folder_without_motion_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="holds no motion"):
        MotionFolder(tmp_path)
    with pytest.raises(InputError, match="no folder of motion"):
        MotionFolder(tmp_path / "absent")


def test_a_broken_archive_is_an_input_error(tmp_path):
    (tmp_path / "a.tar.xz").write_bytes(b"not an archive")
    with pytest.raises(InputError, match="cannot be unpacked"):
        MotionFolder(tmp_path)
