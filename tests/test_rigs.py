"""Presets beside what their receivers publish: names, parents, rest poses, axes."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fusecap.body.rigs import PRESETS
from fusecap.body.shape import BodyShape, shape_with_clavicles
from fusecap.body.skeleton import PAPER21
from fusecap.exports.rest_rig import rest_rig

ARM = "{0}Shoulder {0}Arm {0}ForeArm {0}Hand"
LEG = "{0}UpLeg {0}Leg {0}Foot {0}ToeBase"
UNITY_ARM = "{0}Shoulder {0}UpperArm {0}LowerArm {0}Hand"
UNITY_LEG = "{0}UpperLeg {0}LowerLeg {0}Foot {0}Toes"
MANNY_ARM = "clavicle_{0} upperarm_{0} lowerarm_{0} hand_{0}"
MANNY_LEG = "thigh_{0} calf_{0} foot_{0} ball_{0}"
VRM_SPINE = "hips spine chest upperChest neck head"
MANNY_SPINE = "pelvis spine_01 spine_02 spine_03 spine_04 spine_05 neck_01 neck_02 head"
BIG, SMALL, SHORT = ("Left", "Right"), ("left", "right"), ("l", "r")
PUBLISHED = {
    # UE 5.4's IK Rig: templates "Mixamo" and "UE5 Mannequin" of its auto characterizer.
    "mixamo": ("Hips Spine Spine1 Spine2 Neck Head", "Spine2", ARM, LEG, BIG),
    "ue5": (f"root {MANNY_SPINE}", "spine_05", MANNY_ARM, MANNY_LEG, SHORT),
    # Autodesk's names that HIK maps by itself.
    "humanik": ("Hips Spine Spine1 Spine2 Neck Head", "Spine2", ARM, LEG, BIG),
    # HumanBodyBones; Unity maps names that are these.
    "unity": ("Hips Spine Chest UpperChest Neck Head", "UpperChest", UNITY_ARM, UNITY_LEG, BIG),
    # VRMC_vrm-1.0, humanoid.md.
    "vrm": (VRM_SPINE, "upperChest", UNITY_ARM, UNITY_LEG, SMALL),
    # Rokoko Studio's own skeleton ("Newton").
    "rokoko": (
        *("Hips Spine1 Spine2 Spine3 Spine4 Neck Head", "Spine4", ARM),
        *("{0}Thigh {0}Shin {0}Foot {0}Toe", BIG),
    ),
    # Segments of MVNX 4.
    "xsens": (
        *("Pelvis L5 L3 T12 T8 Neck Head", "T8"),
        *("{0}Shoulder {0}UpperArm {0}ForeArm {0}Hand", "{0}UpperLeg {0}LowerLeg {0}Foot {0}Toe"),
        BIG,
    ),
}
"""The line of the trunk, where arms begin, an arm, a leg, and the words for sides."""


def rest(rig):
    return rest_rig(PRESETS[rig], shape_with_clavicles(BodyShape.from_height(PAPER21, 1.8)))


@pytest.mark.parametrize("rig", PUBLISHED)
def test_names_and_parents_are_those_that_receivers_publish(rig):
    trunk, chest, arm, leg, sides = PUBLISHED[rig]
    line = trunk.split()
    expected = dict(zip(line, ["", *line], strict=False))
    hips = next(name for name in line if name != "root")
    for side in sides:
        for names, above in ((arm.format(side).split(), chest), (leg.format(side).split(), hips)):
            expected |= dict(zip(names, [above, *names], strict=False))
    bare = {j.name.removeprefix("mixamorig:"): j for j in PRESETS[rig].joints}
    parents = {name: joint.parent.removeprefix("mixamorig:") for name, joint in bare.items()}
    assert parents == expected


def test_segments_of_mvn_are_those_of_its_files(data_dir):
    sample = data_dir / "xsens_mvnx" / "test_mocap_mvnx_v4_upperbody.mvnx"
    found = {*re.findall(r'segment label="(\w+)"', sample.read_text())}
    assert found and found <= {joint.name for joint in PRESETS["xsens"].joints}


MANNY = {
    # Axes x, y in a world with y up that he faces along z: composed of the local rotations that
    # two public tables of Unreal's skeletons give (of UEFN's character, and of UE4's mannequin).
    "root": ((1, 0, 0), (0, 0, -1)),
    "pelvis": ((0, 1, 0.04), (0, 0.04, -1)),
    "clavicle_l": ((1, -0.06, -0.06), (-0.05, 0.21, -0.98)),
    "clavicle_r": ((1, 0.06, 0.06), (-0.05, -0.21, 0.98)),
    "upperarm_l": ((0.75, -0.64, -0.18), (-0.02, 0.25, -0.97)),
    "upperarm_r": ((0.75, 0.64, 0.18), (-0.02, -0.25, 0.97)),
    "lowerarm_l": ((0.64, -0.71, 0.3), (0.39, -0.04, -0.92)),
    "lowerarm_r": ((0.64, 0.71, -0.3), (0.39, 0.04, 0.92)),
    "hand_l": ((0.51, -0.84, 0.18), (-0.79, -0.54, -0.29)),
    "hand_r": ((0.51, 0.84, -0.18), (-0.79, 0.54, 0.29)),
    "thigh_l": ((-0.11, 0.99, 0), (0, 0.01, -1)),
    "thigh_r": ((-0.11, -0.99, 0), (0, -0.01, 1)),
    "calf_l": ((-0.08, 0.99, 0.08), (-0.01, 0.08, -1)),
    "calf_r": ((-0.08, -0.99, -0.08), (-0.01, -0.08, 1)),
    "foot_l": ((0, 1, 0.01), (-0.09, 0.01, -1)),
    "foot_r": ((0, -1, -0.01), (-0.09, -0.01, 1)),
    "ball_l": ((0.09, -0.01, 1), (0, 1, 0.01)),
    "ball_r": ((0.09, 0.01, -1), (0, -1, -0.01)),
}


def test_manny_s_limbs_rest_and_turn_as_the_published_ones():
    """Trunks differ by how a person's spine stands; clavicles by their roll of 12 degrees."""
    ours = rest("ue5")
    for name, (x, y) in MANNY.items():
        x = np.array(x) / np.linalg.norm(x)
        y = y - x * (x @ y)
        y /= np.linalg.norm(y)
        published = np.stack([x, y, np.cross(x, y)], axis=1)
        apart = published.T @ ours.rotation[ours.names.index(name)]
        degrees = np.degrees(Rotation.from_matrix(apart).magnitude())
        assert degrees < (14 if "clavicle" in name else 3), name


@pytest.mark.parametrize("rig", PRESETS)
def test_every_rig_faces_z_with_feet_as_high_as_standing(rig):
    ours, straight = rest(rig), rest("native")
    name_at = PRESETS[rig].name_at
    place = dict(zip(ours.names, ours.position_m, strict=True))
    standing = dict(zip(straight.names, straight.position_m, strict=True))
    for side, sign in (("left", 1), ("right", -1)):
        foot, toes = (place[name_at[f"{side}_{bone}"]] for bone in ("foot", "toes"))
        assert foot[1] == pytest.approx(standing[f"{side}_foot"][1], abs=1e-9)
        assert sign * foot[0] > 0.05 and toes[2] > foot[2] + 0.05
    dets = np.linalg.det(ours.rotation)
    assert np.abs(dets - 1).max() < 1e-9


@pytest.mark.parametrize("rig", ["humanik", "unity", "vrm", "rokoko", "xsens", "mixamo", "native"])
def test_t_poses_have_arms_along_x_and_legs_along_y(rig):
    """What HIK, Unity and VRM ask of a T-stance: facing z, limbs along axes, toes straight on."""
    place = dict(zip(rest(rig).names, rest(rig).position_m, strict=True))
    at = PRESETS[rig].name_at
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for one, other, way in (
            ("upper_arm", "hand", (sign, 0, 0)),
            ("thigh", "foot", (0, -1, 0)),
        ):
            away = place[at[f"{side}_{other}"]] - place[at[f"{side}_{one}"]]
            assert away / np.linalg.norm(away) @ np.array(way) == pytest.approx(1.0, abs=1e-9)
        toes = place[at[f"{side}_toes"]] - place[at[f"{side}_foot"]]
        assert abs(toes[0]) < 1e-9
