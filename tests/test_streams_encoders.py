"""What is sent, read by parsers that are not ours, against numbers worked out by hand.

A person of 2 m stands at the origin in a T-pose. Of the body's proportions: hips at 1.100 m, the
left shoulder 0.195 m to the left at 1.636 m, the wrist 0.664 m further out, the head at 1.780 m.
"""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pythonosc.osc_bundle import OscBundle
from scipy.spatial.transform import Rotation

from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.streams.osc_packets import bundles, message
from fusecap.streams.person_pose import pose_of_estimate, pose_of_take, with_clavicles
from fusecap.streams.protocols.livelink import livelink_datagrams
from fusecap.streams.protocols.lsl import lsl_channels, lsl_sample
from fusecap.streams.protocols.osc import osc_datagrams, person_addresses
from fusecap.streams.protocols.rokoko import rokoko_datagrams
from fusecap.streams.protocols.vmc import vmc_datagrams
from fusecap.streams.protocols.ws import cast_message, frame_bytes, frame_text
from fusecap.types import Estimate, Status
from motions import any_poses, person
from stream_people import (
    LEFT_ARM_RAISED,
    ONE_STEP_FORWARD,
    TURNED_LEFT,
    frame_of,
    pose_of,
    theta_of,
)

H = np.sqrt(0.5)
AT_REST = theta_of()


def osc_messages(datagrams: list[bytes]) -> list[tuple[str, list]]:
    """By python-osc."""
    return [(m.address, m.params) for datagram in datagrams for m in OscBundle(datagram)]


# A receiver of VMC, after the marionette specification: local transforms on Unity's humanoid.

UNITY_PARENTS = {
    "Hips": None,
    "Spine": "Hips",
    "Chest": "Spine",
    "UpperChest": "Chest",
    "Neck": "UpperChest",
    "Head": "Neck",
} | {
    f"{side}{bone}": f"{side}{parent}" if parent not in ("UpperChest", "Hips") else parent
    for side in ("Left", "Right")
    for bone, parent in {
        "Shoulder": "UpperChest",
        "UpperArm": "Shoulder",
        "LowerArm": "UpperArm",
        "Hand": "LowerArm",
        "UpperLeg": "Hips",
        "LowerLeg": "UpperLeg",
        "Foot": "LowerLeg",
        "Toes": "Foot",
    }.items()
}


def vmc_local(theta, skeleton=PAPER21) -> dict[str, tuple[np.ndarray, Rotation]]:
    found = {}
    for address, values in osc_messages(vmc_datagrams(pose_of(theta, skeleton), 0.0)):
        if address == "/VMC/Ext/Bone/Pos":
            found[values[0]] = np.array(values[1:4]), Rotation.from_quat(values[4:8])
    return found


def vmc_world(theta, skeleton=PAPER21) -> dict[str, tuple[np.ndarray, Rotation]]:
    """What an engine makes of it: each transform on its parent's."""
    local, world = vmc_local(theta, skeleton), {}
    for name, parent in UNITY_PARENTS.items():
        position, rotation = local[name]
        if parent is not None:
            above, turned = world[parent]
            position, rotation = above + turned.apply(position), turned * rotation
        world[name] = position, rotation
    return world


def xyzw(rotation: Rotation) -> np.ndarray:
    return rotation.as_quat(canonical=True)


def test_vmc_sends_time_state_root_and_the_bones_of_unity_in_this_order():
    datagrams = vmc_datagrams(pose_of(AT_REST), 2.5)
    messages = osc_messages(datagrams)
    assert all(len(datagram) <= 1500 for datagram in datagrams)
    assert messages[0] == ("/VMC/Ext/T", [2.5])
    assert messages[1] == ("/VMC/Ext/OK", [1, 3, 0, 1])
    assert messages[2] == ("/VMC/Ext/Root/Pos", ["root", 0, 0, 0, 0, 0, 0, 1])
    assert [values[0] for _, values in messages[3:]] == list(vmc_local(AT_REST))
    assert set(vmc_local(AT_REST)) == set(UNITY_PARENTS)
    assert all(type(value) is float for _, values in messages[3:] for value in values[1:])


def test_vmc_of_someone_who_is_not_tracked_says_so():
    assert osc_messages(vmc_datagrams(None, 2.5)) == [
        ("/VMC/Ext/T", [2.5]),
        ("/VMC/Ext/OK", [1, 3, 0, 0]),
    ]


def test_vmc_t_pose_is_zero_rotation_facing_z_with_the_left_at_minus_x():
    world = vmc_world(AT_REST)
    assert all(np.allclose(xyzw(rotation), [0, 0, 0, 1]) for _, rotation in world.values())
    assert np.allclose(world["Hips"][0], [0, 1.1, 0])
    assert np.allclose(world["LeftUpperArm"][0], [-0.195, 1.636, 0], atol=1e-6)
    assert np.allclose(world["LeftHand"][0], [-0.859, 1.636, 0], atol=1e-6)
    assert np.allclose(world["RightHand"][0], [0.859, 1.636, 0], atol=1e-6)
    assert np.allclose(world["Head"][0], [0, 1.78, 0.02], atol=1e-6)
    assert world["LeftToes"][0][2] == pytest.approx(0.16, abs=1e-6)


def test_vmc_left_arm_raised():
    assert np.allclose(xyzw(vmc_local(LEFT_ARM_RAISED)["LeftUpperArm"][1]), [0, 0, -H, H])
    assert np.allclose(vmc_world(LEFT_ARM_RAISED)["LeftHand"][0], [-0.195, 2.3, 0], atol=1e-6)
    assert np.allclose(vmc_world(LEFT_ARM_RAISED)["RightHand"][0], [0.859, 1.636, 0], atol=1e-6)


def test_vmc_one_step_forward():
    assert np.allclose(vmc_local(ONE_STEP_FORWARD)["Hips"][0], [0, 1.1, 0.5])


def test_vmc_turned_left():
    world = vmc_world(TURNED_LEFT)
    assert np.allclose(xyzw(world["Hips"][1]), [0, -H, 0, H])
    assert np.allclose(world["Head"][1].apply([0, 0, 1]), [-1, 0, 0])
    assert np.allclose(world["LeftHand"][0], [0, 1.636, -0.859], atol=1e-6)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), skeleton=st.sampled_from([PAPER21, EXTENDED23]))
def test_folding_the_spine_keeps_every_other_bone_in_the_world(seed, skeleton):
    theta = any_poses(np.random.default_rng(seed), skeleton, 1)[0]
    pose, world = pose_of(theta, skeleton), vmc_world(theta, skeleton)
    flip = np.diag([-1, 1, 1])
    for theirs, ours in {
        "Spine": "spine",
        "Chest": "spine2",
        "UpperChest": "spine3",
        "Head": "head",
        "LeftHand": "left_hand",
        "RightToes": "right_toes",
    }.items():
        position, rotation = world[theirs]
        bone = skeleton.bone(ours)
        assert np.allclose(position, flip @ pose.bone_position_in_world_m[bone], atol=1e-5)
        expected = flip @ pose.bone_rotation_in_world[bone] @ flip
        assert np.allclose(rotation.as_matrix(), expected, atol=1e-5)


# A receiver of JSONLiveLink, after `HandleReceivedData` of the plugin.


def livelink_skeletons(datagrams):
    """Per subject: names, parents, locations, rotations; each character is one byte."""
    subjects = {}
    for datagram in datagrams:
        text = "".join(chr(byte) for byte in datagram)
        for subject, bones in json.loads(text).items():
            assert subject not in subjects
            assert all(bone["Scale"] == [1, 1, 1] for bone in bones)
            subjects[subject] = (
                [bone["Name"] for bone in bones],
                [bone["Parent"] for bone in bones],
                np.array([bone["Location"] for bone in bones]),
                Rotation.from_quat([bone["Rotation"] for bone in bones]),
            )
    return subjects


def livelink_component(theta):
    """Transforms in the component, as the animation graph composes them."""
    names, parents, location, rotation = livelink_skeletons(
        livelink_datagrams(frame_of(pose_of(theta)))
    )["anna"]
    world = {}
    for name, parent, xyz, turn in zip(names, parents, location, rotation, strict=True):
        if parent >= 0:
            above, turned = world[names[parent]]
            xyz, turn = above + turned.apply(xyz), turned * turn
        world[name] = xyz, turn
    return world


def test_livelink_rest_faces_y_with_the_left_at_x_in_centimetres():
    component = livelink_component(AT_REST)
    assert np.allclose(component["pelvis"][0], [0, 0, 110])
    assert np.allclose(component["upperarm_l"][0], [19.5, 0, 163.6], atol=0.01)
    assert np.allclose(component["hand_l"][0], [85.9, 0, 163.6], atol=0.01)
    assert np.allclose(component["hand_r"][0], [-85.9, 0, 163.6], atol=0.01)
    assert component["ball_l"][0][1] == pytest.approx(16, abs=0.01)
    assert all(np.allclose(xyzw(turn), [0, 0, 0, 1]) for _, turn in component.values())


def test_livelink_left_arm_raised():
    _, _, _, rotation = livelink_skeletons(livelink_datagrams(frame_of(pose_of(LEFT_ARM_RAISED))))[
        "anna"
    ]
    arm = EXTENDED23.bone("left_upper_arm")
    assert np.allclose(rotation[arm].as_quat(), [0, -H, 0, H], atol=1e-6)
    assert np.allclose(livelink_component(LEFT_ARM_RAISED)["hand_l"][0], [19.5, 0, 230], atol=0.01)


def test_livelink_one_step_forward():
    assert np.allclose(livelink_component(ONE_STEP_FORWARD)["pelvis"][0], [0, 50, 110])


def test_livelink_turned_left():
    component = livelink_component(TURNED_LEFT)
    assert np.allclose(xyzw(component["pelvis"][1]), [0, 0, -H, H], atol=1e-6)
    assert np.allclose(component["head"][1].apply([0, 1, 0]), [1, 0, 0], atol=1e-5)
    assert np.allclose(component["hand_l"][0], [0, -85.9, 163.6], atol=0.01)


def test_unity_and_unreal_agree_by_the_conversion_of_a_receiver_that_knows_both():
    """VRM4U takes VMC into Unreal: position (-x, z, y) times 100, quaternion (-x, z, y, w)."""
    theta = any_poses(np.random.default_rng(3), PAPER21, 1)[0]
    unity, unreal = vmc_world(theta), livelink_component(theta)
    for in_unity, in_unreal in (("Hips", "pelvis"), ("Head", "head"), ("LeftHand", "hand_l")):
        (x, y, z), turn = unity[in_unity]
        assert np.allclose(np.array([-x, z, y]) * 100, unreal[in_unreal][0], atol=0.02)
        qx, qy, qz, qw = turn.as_quat()
        agree = Rotation.from_quat([-qx, qz, qy, qw]).inv() * unreal[in_unreal][1]
        assert agree.magnitude() < 1e-4


def test_livelink_puts_subjects_together_as_far_as_they_fit_and_divides_none():
    people = [pose_of(AT_REST, name=name) for name in ("anna", "Zoë", "ben", "cy", "di")]
    datagrams = livelink_datagrams(frame_of(*people), max_bytes=6000)
    assert [list(json.loads(datagram)) for datagram in datagrams] == [
        ["anna", "Zoë"],
        ["ben", "cy"],
        ["di"],
    ]
    assert all(len(datagram) <= 6000 for datagram in datagrams)
    assert len(livelink_skeletons(datagrams)) == 5


def test_livelink_skeleton_is_the_same_with_and_without_solved_clavicles():
    skeletons = [
        livelink_skeletons(livelink_datagrams(frame_of(pose_of(theta_of(s), s))))["anna"]
        for s in (PAPER21, EXTENDED23)
    ]
    assert skeletons[0][:2] == skeletons[1][:2]
    assert np.allclose(skeletons[0][2], skeletons[1][2], atol=0.01)


# Receivers of Rokoko's JSON v3: what the Unity and the Blender plugin do with it.

STUDIO_T_POSE = {
    "hip": (0, 0, 0, 1),
    "spine": (0, 0, 1, 0),
    "chest": (0, 0, 1, 0),
    "neck": (0, 0, 1, 0),
    "head": (0, 0, 1, 0),
    "leftShoulder": (0, 0, 0.707, -0.707),
    "leftUpperArm": (-0.5, -0.5, 0.5, -0.5),
    "leftLowerArm": (-0.5, -0.5, 0.5, -0.5),
    "leftHand": (-0.5, -0.5, 0.5, -0.5),
    "rightShoulder": (0, 0, 0.707, 0.707),
    "rightUpperArm": (0.5, -0.5, 0.5, 0.5),
    "rightLowerArm": (0.5, -0.5, 0.5, 0.5),
    "rightHand": (0.5, -0.5, 0.5, 0.5),
    "leftUpLeg": (0, 0.707, 0, 0.707),
    "leftLeg": (0, 0.707, 0, 0.707),
    "leftFoot": (0, 0.707, -0.707, 0),
    "leftToe": (0, 0.707, -0.707, 0),
    "rightUpLeg": (0, -0.707, 0, 0.707),
    "rightLeg": (0, -0.707, 0, 0.707),
    "rightFoot": (0, -0.707, 0.707, 0),
    "rightToe": (0, -0.707, 0.707, 0),
}
"""As printed in the plugins, xyzw."""


def rokoko_actor(theta):
    (datagram,) = rokoko_datagrams(frame_of(pose_of(theta)), 60.0)
    return json.loads(datagram)["scene"]["actors"][0]


def rokoko_turn(actor, bone) -> np.ndarray:
    """World rotation by which an avatar's bone leaves its own T-pose: `received / reference`."""
    received = Rotation.from_quat([actor["body"][bone]["rotation"][axis] for axis in "xyzw"])
    return xyzw(received * Rotation.from_quat(STUDIO_T_POSE[bone]).inv())


def rokoko_position(actor, bone) -> list[float]:
    return [actor["body"][bone]["position"][axis] for axis in "xyz"]


def test_rokoko_has_the_fields_that_plugins_read():
    (datagram,) = rokoko_datagrams(frame_of(pose_of(AT_REST), time_s=2.25), 60.0)
    packet = json.loads(datagram)
    # Blender's plugin takes the part of the version before a comma or point.
    assert int(str(packet["version"]).replace(".", ",").split(",")[0]) == 3
    assert packet["fps"] == 60
    assert packet["scene"]["timestamp"] == 2.25
    assert packet["scene"]["props"] == []
    (actor,) = packet["scene"]["actors"]
    assert actor["name"] == "anna"
    assert actor["meta"] == {
        "hasGloves": False,
        "hasLeftGlove": False,
        "hasRightGlove": False,
        "hasBody": True,
        "hasFace": False,
    }
    assert actor["dimensions"] == {"totalHeight": 2.0, "hipHeight": 1.1}
    assert set(actor["body"]) == set(STUDIO_T_POSE)
    assert len(actor["color"]) == 3


def test_rokoko_t_pose_is_the_studios_reference():
    actor = rokoko_actor(AT_REST)
    for bone in STUDIO_T_POSE:
        assert np.allclose(rokoko_turn(actor, bone), [0, 0, 0, 1], atol=1e-3), bone
    assert np.allclose(rokoko_position(actor, "leftHand"), [-0.859, 1.636, 0], atol=1e-4)


def test_rokoko_left_arm_raised():
    actor = rokoko_actor(LEFT_ARM_RAISED)
    arm = [actor["body"]["leftUpperArm"]["rotation"][axis] for axis in "xyzw"]
    # (0, 0, -h, h) times the reference (-0.5, -0.5, 0.5, -0.5), up to the sign of all four.
    assert np.allclose(np.multiply(arm, np.sign(arm[2])), [-H, 0, H, 0], atol=1e-5)
    assert np.allclose(rokoko_turn(actor, "leftUpperArm"), [0, 0, -H, H], atol=1e-3)
    assert np.allclose(rokoko_position(actor, "leftHand"), [-0.195, 2.3, 0], atol=1e-4)


def test_rokoko_one_step_forward():
    assert np.allclose(rokoko_position(rokoko_actor(ONE_STEP_FORWARD), "hip"), [0, 1.1, 0.5])


def test_rokoko_turned_left_turns_every_bone():
    actor = rokoko_actor(TURNED_LEFT)
    for bone in STUDIO_T_POSE:
        assert np.allclose(rokoko_turn(actor, bone), [0, -H, 0, H], atol=1e-3), bone


# Our own OSC


def test_osc_has_an_address_per_person_and_bone():
    frame = frame_of(pose_of(LEFT_ARM_RAISED), pose_of(AT_REST, name="Zoë B."))
    messages = osc_messages(osc_datagrams(frame))
    assert messages[0] == ("/fusecap/time", [1.5])
    values = dict(messages)
    assert values["/fusecap/anna/tracked"] == [1]
    assert np.allclose(values["/fusecap/anna/left_hand"], [0.195, 2.3, 0, 0, 0, H, H, 1], atol=1e-5)
    assert "/fusecap/Zo__B_/head" in values
    assert len(values) == 1 + 2 * (1 + PAPER21.bone_count)


def test_osc_people_with_like_names_keep_apart():
    assert person_addresses(["a b", "a_b", "a/b"]) == [
        "/fusecap/a_b",
        "/fusecap/a_b_2",
        "/fusecap/a_b_3",
    ]


def test_osc_says_who_is_not_tracked():
    frame = frame_of(pose_of(AT_REST))
    lost = type(frame)(time_s=0.0, timestamp_ns=0, people={"anna": None})
    assert osc_messages(osc_datagrams(lost)) == [
        ("/fusecap/time", [0.0]),
        ("/fusecap/anna/tracked", [0]),
    ]


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(
            st.text("abcdefgh", min_size=1, max_size=12),
            st.lists(
                st.one_of(
                    st.integers(-(2**31), 2**31 - 1),
                    st.floats(width=32, allow_nan=False),
                    st.text(st.characters(exclude_characters="\0", codec="utf-8"), max_size=9),
                ),
                max_size=8,
            ),
        ),
        max_size=12,
    ),
    st.integers(60, 600),
)
def test_osc_packets_are_read_back_by_python_osc_in_their_order(messages, max_bytes):
    packed = bundles([message(f"/{name}", *values) for name, values in messages], max_bytes)
    assert osc_messages(packed) == [(f"/{name}", values) for name, values in messages]
    assert all(
        len(bundle) <= max_bytes or len(OscBundle(bundle)._contents) == 1 for bundle in packed
    )


# LSL, WebSocket


def test_lsl_channels_are_labelled_with_type_and_unit():
    channels = lsl_channels(PAPER21)
    sample = lsl_sample(pose_of(LEFT_ARM_RAISED), PAPER21)
    assert len(channels) == len(sample) == 8 * 21
    assert sample.dtype == np.float32
    values = {channel.label: value for channel, value in zip(channels, sample, strict=True)}
    assert values["left_hand_PositionY"] == pytest.approx(2.3, abs=1e-6)
    assert values["left_hand_OrientationZ"] == pytest.approx(H)
    assert values["left_hand_OrientationW"] == pytest.approx(H)
    assert values["hips_Confidence"] == 1
    by_label = {channel.label: channel for channel in channels}
    assert by_label["head_PositionX"].unit == "meters"
    assert by_label["head_OrientationW"].type == "OrientationA"
    assert np.isnan(lsl_sample(None, PAPER21)).all()


def test_websocket_text_and_binary_say_the_same():
    people = [pose_of(AT_REST), pose_of(LEFT_ARM_RAISED, name="Zoë")]
    frame = frame_of(*people)
    cast = json.loads(cast_message([(p.name, p.shape) for p in people], 60.0))
    assert cast["format"] == "fusecap stream 1"
    assert [p["name"] for p in cast["people"]] == ["anna", "Zoë"]
    bones = cast["people"][1]["bones"]
    text = json.loads(frame_text(frame))
    assert (text["time_s"], text["timestamp_ns"]) == (1.5, 1_500_000_000)
    data = frame_bytes(frame)
    magic, count, timestamp_ns, time_s = struct.unpack_from("<4sIqd", data)
    assert (magic, count, timestamp_ns, time_s) == (b"FCS1", 2, 1_500_000_000, 1.5)
    at = 24
    for index, name in enumerate(("anna", "Zoë")):
        who, size = struct.unpack_from("<II", data, at)
        assert (who, size) == (index, 21)
        values = np.frombuffer(data, "<f4", 8 * size, at + 8).reshape(size, 8)
        at += 8 + 32 * size
        said = text["people"][name]
        assert np.allclose(values[:, :3], said["position_m"], atol=1e-5)
        assert np.allclose(values[:, 3:7], said["rotation_wxyz"], atol=1e-5)
        assert np.allclose(values[:, 7], said["quality"])
    assert at == len(data)
    hand = text["people"]["Zoë"]["position_m"][bones.index("left_hand")]
    assert np.allclose(hand, [0.195, 2.3, 0])


# Poses


def test_pose_of_an_estimate_is_the_pose_of_its_take():
    pose = pose_of(LEFT_ARM_RAISED)
    estimate = Estimate(
        track_id=1,
        name="anna",
        timestamp_ns=0,
        theta=LEFT_ARM_RAISED,
        bone_position_in_world_m=pose.bone_position_in_world_m,
        bone_rotation_in_world=pose.bone_rotation_in_world,
        bone_sigma_deg=15.0 * np.sqrt(1.0 / pose.bone_quality - 1.0),
        position_sigma_m=np.full(len(pose.bone_quality), 0.02),
        shape=pose.shape,
        status=Status.CONVERGED,
        iterations=1,
        cost=0.0,
        solve_s=0.0,
        views=np.ones(1, dtype=bool),
        measured=True,
    )
    live = pose_of_estimate(estimate)
    assert frame_text(frame_of(live)) == frame_text(frame_of(pose))


def test_local_rotations_are_those_of_theta():
    pose = pose_of(theta_of(hips=(0, 90, 0), left_upper_arm=(0, 0, 90)))
    arm = PAPER21.bone("left_upper_arm")
    turn = Rotation.from_matrix(pose.bone_rotation_in_parent[arm]).as_rotvec(degrees=True)
    assert np.allclose(turn, [0, 0, 90])
    assert np.allclose(pose.root_position_in_world_m, [0, 1.1, 0])


def test_added_clavicles_move_no_joint_and_claim_no_quality():
    pose = pose_of(any_poses(np.random.default_rng(5), PAPER21, 1)[0])
    extended = with_clavicles(pose)
    for bone in PAPER21.bone_names:
        ours, theirs = PAPER21.bone(bone), EXTENDED23.bone(bone)
        assert np.array_equal(
            pose.bone_position_in_world_m[ours], extended.bone_position_in_world_m[theirs]
        )
    clavicle, arm = EXTENDED23.bone("left_clavicle"), EXTENDED23.bone("left_upper_arm")
    assert extended.bone_quality[clavicle] == 0
    reach = extended.bone_rotation_in_world[clavicle] @ extended.shape.offsets_m[arm]
    assert np.allclose(
        extended.bone_position_in_world_m[clavicle] + reach,
        extended.bone_position_in_world_m[arm],
    )
    assert with_clavicles(extended) is extended


def test_untracked_frame_of_a_take_has_no_pose():
    from dataclasses import replace

    from motions import take_of, walk

    take = take_of(walk(person(), 3)[None], [person()], names=("anna",))
    tracked = np.array([[True, False, True]])
    take = replace(take, tracked=tracked)
    assert pose_of_take(take, 0, 1) is None
    pose = pose_of_take(take, 0, 2)
    assert pose is not None and pose.timestamp_ns == take.timestamps_ns[2]
