"""Signs by figures posed in one joint, continuity, error bars, and files."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import fusecap
from angle_signs import MORE_DEG, figures
from export_people import two_walkers, with_gap
from fusecap import feet
from fusecap.angles.constants import CONSTANT_DEG
from fusecap.angles.gait import gait_cycles
from fusecap.angles.joint_angles import ANY_ANGLE_SD_DEG, joint_angles
from fusecap.angles.joints import JOINTS
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.checks.keypoints import UNMEASURED
from fusecap.cli import app
from fusecap.edits.edit import EditOptions, edit_take
from fusecap.errors import InputError, TakeError
from fusecap.feet import floor_velocity, foot_events
from fusecap.take import save_take
from motions import any_poses, person, take_of


def posed(turns, *, skeleton=PAPER21, sigma_deg=0.0, facing_deg=0.0):
    """One frame in which bones are turned about axes of the rest pose by degrees, in order."""
    theta = np.zeros((1, 1, skeleton.pose_size))
    for bone, about in ({"hips": ("y", facing_deg)} | turns).items():
        parts = about if isinstance(about, list) else [about]
        turn = Rotation.identity()
        for axis, degrees in parts:
            turn = turn * Rotation.from_euler(axis, degrees, degrees=True)
        at = 3 + 3 * skeleton.bone(bone)
        theta[0, 0, at : at + 3] = turn.as_rotvec()
    take = take_of(theta, [person(1.75, skeleton)], names=("a",))
    return replace(take, bone_sigma_deg=np.full_like(take.bone_sigma_deg, sigma_deg))


def angle(turns, name, **options):
    deg, _ = joint_angles(posed(turns, **options)).curve("a", name)
    return float(deg[0])


# Rest pose: x to the subject's left, y up, z forward; turns by the right hand.
SIGNS = [
    ("thigh", ("x", -40), "hip_flexion", 40),  # knee forward
    ("thigh", ("z", {"left": 20, "right": -20}), "hip_adduction", -20),  # knee outward
    ("thigh", ("y", {"left": -15, "right": 15}), "hip_rotation", 15),  # toes inward
    ("shank", ("x", 60), "knee_flexion", 60),  # heel to the seat
    ("shank", ("z", {"left": 5, "right": -5}), "knee_adduction", -5),  # foot outward
    ("shank", ("y", {"left": -8, "right": 8}), "knee_rotation", 8),
    ("foot", ("x", -12), "ankle_dorsiflexion", 12),  # toes up
    ("foot", ("z", {"left": -9, "right": 9}), "ankle_inversion", 9),  # inner edge up
    ("foot", ("y", {"left": -7, "right": 7}), "ankle_rotation", 7),  # toes inward
    ("hand", ("z", {"left": -25, "right": 25}), "wrist_flexion", 25),  # palm towards the forearm
    ("hand", ("y", {"left": 10, "right": -10}), "wrist_ulnar_deviation", 10),  # little finger
]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("bone", "turn", "name", "expected"), SIGNS)
@pytest.mark.parametrize("facing_deg", [0.0, 130.0])
def test_a_joint_turned_alone_has_that_angle_and_its_sign(
    side, bone, turn, name, expected, facing_deg
):
    axis, degrees = turn
    degrees = degrees[side] if isinstance(degrees, dict) else degrees
    turns = {f"{side}_{bone}": (axis, degrees)}
    found = joint_angles(posed(turns, facing_deg=facing_deg))
    assert found.curve("a", f"{side}_{name}")[0][0] == pytest.approx(expected, abs=1e-6)
    joint = name.split("_")[0]
    others = [n for n in found.names if n.startswith(f"{side}_{joint}") and n != f"{side}_{name}"]
    assert [found.curve("a", other)[0][0] for other in others] == pytest.approx([0, 0], abs=1e-6)


@pytest.mark.parametrize("joint", JOINTS, ids=lambda joint: joint.name)
@pytest.mark.parametrize("place", [0, 1, 2])
def test_figures_of_the_picture_differ_by_what_it_says(joint, place):
    before, after = (joint_angles(take) for take in figures(joint, place))
    side = "right_" if joint.sided else ""
    columns = [before.names.index(f"{side}{joint.name}_{angle}") for angle in joint.angles]
    apart = (after.deg - before.deg)[0, 0, columns]
    np.testing.assert_allclose(apart, np.eye(3)[place] * MORE_DEG[place], atol=1e-6)


@pytest.mark.parametrize(
    ("turns", "name", "expected"),
    [
        ({"spine": ("x", 30)}, "trunk_flexion", 30),  # chest to the knees
        ({"spine": ("z", 10), "spine2": ("z", 10)}, "trunk_bending", 20),  # to the right
        ({"spine1": ("y", 25)}, "trunk_rotation", 25),  # to the left
        ({"head": ("x", 20), "neck": ("x", 5)}, "neck_flexion", 25),  # chin to the chest
        ({"head": ("z", 15)}, "neck_bending", 15),
        ({"head": ("y", -35)}, "neck_rotation", -35),
    ],
)
def test_trunk_and_neck(turns, name, expected):
    assert angle(turns, name) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23])
@pytest.mark.parametrize(("side", "out"), [("left", 1), ("right", -1)])
def test_shoulders_by_the_globe_and_by_flexion(side, out, skeleton):
    """The elbow's pit of the rest pose faces forward and 30 deg up: rotated outward."""
    arm = f"{side}_upper_arm"

    def globe(*turn):
        turns = {arm: list(turn)}
        return [
            angle(turns, f"{side}_shoulder_{name}", skeleton=skeleton)
            for name in ("plane", "elevation", "rotation")
        ]

    assert globe() == pytest.approx([0, 90, -30], abs=1e-6)
    assert globe(("z", -out * 50)) == pytest.approx([0, 40, -30], abs=1e-6)
    assert globe(("y", -out * 60)) == pytest.approx([60, 90, -30], abs=1e-6)  # brought forward
    assert globe(("x", 30)) == pytest.approx([0, 90, 0], abs=1e-6)  # turned inward

    hangs = ("z", -out * 90)
    raised = {arm: [("x", -40), hangs]}
    assert angle(raised, f"{side}_arm_flexion", skeleton=skeleton) == pytest.approx(40, abs=1e-6)
    aside = {arm: ("z", -out * 70)}
    assert angle(aside, f"{side}_arm_adduction", skeleton=skeleton) == pytest.approx(-20, abs=1e-6)
    inward = {arm: [hangs, ("x", 50)]}
    assert angle(inward, f"{side}_arm_rotation", skeleton=skeleton) == pytest.approx(20, abs=1e-6)


@pytest.mark.parametrize(("side", "out"), [("left", 1), ("right", -1)])
def test_elbows_bend_about_their_hinge_and_hands_turn_from_thumb_outward(side, out):
    hinge = out * np.array([0.0, -np.cos(np.radians(30)), np.sin(np.radians(30))])
    theta = posed({}).theta.copy()
    at = 3 + 3 * PAPER21.bone(f"{side}_forearm")
    bent = Rotation.from_rotvec(np.radians(70) * hinge)
    palm_forward = Rotation.from_euler("x", -120, degrees=True)
    theta[0, 0, at : at + 3] = (bent * palm_forward).as_rotvec()
    found = joint_angles(take_of(theta, [person()], names=("a",)))
    triple = [
        found.curve("a", f"{side}_elbow_{name}")[0][0]
        for name in ("flexion", "adduction", "pronation")
    ]
    assert triple == pytest.approx([70, 0, 0], abs=1e-6)
    assert angle({}, f"{side}_elbow_pronation") == pytest.approx(120, abs=1e-6)


def test_mirrored_people_have_the_same_angles():
    rng = np.random.default_rng(2)
    theta = any_poses(rng, PAPER21, 5)[None]
    vectors = theta[:, :, 3:].reshape(1, 5, -1, 3)
    swapped = [PAPER21.bone(_other(n) if "_" in n else n) for n in PAPER21.bone_names]
    mirrored = theta.copy()
    mirrored[:, :, 3:] = (vectors[:, :, swapped] * [1, -1, -1]).reshape(1, 5, -1)
    one, other = (joint_angles(take_of(t, [person()], names=("a",))) for t in (theta, mirrored))
    for name in one.names:
        if "left" in name:
            mine, theirs = one.curve("a", name)[0], other.curve("a", _other(name))[0]
            assert np.abs((mine - theirs + 180) % 360 - 180).max() < 1e-6


def _other(name):
    side, _, rest = name.partition("_")
    return f"{ {'left': 'right', 'right': 'left'}[side] }_{rest}"


def test_angles_give_the_rotation_back():
    take = take_of(any_poses(np.random.default_rng(3), PAPER21, 50)[None], [person()], names=("a",))
    found = joint_angles(take)
    knee = np.stack(
        [found.curve("a", f"right_knee_{n}")[0] for n in ("flexion", "adduction", "rotation")], 1
    )
    isb = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    thigh, shank = (
        take.bone_rotation_in_world(0)[:, PAPER21.bone(f"right_{b}")] for b in ("thigh", "shank")
    )
    again = Rotation.from_euler("ZXY", knee * [-1, 1, 1], degrees=True).as_matrix()
    np.testing.assert_allclose(again, isb.T @ thigh.transpose(0, 2, 1) @ shank @ isb, atol=1e-9)


def test_curves_do_not_jump_by_full_turns_and_gaps_are_nan():
    theta = np.zeros((1, 80, PAPER21.pose_size))
    theta[0, :, 3 + 3 * PAPER21.bone("head") + 1] = np.radians(np.linspace(100, 260, 80))
    take = take_of(theta, [person()], names=("a",))
    turned, sd = joint_angles(take, constants={}).curve("a", "neck_rotation")
    assert np.abs(np.diff(turned)).max() < 3 and sd.max() == 0
    gappy = joint_angles(with_gap(take, slice(30, 40)))
    nan = np.isnan(gappy.deg[0]).all(axis=1)
    assert np.flatnonzero(nan).tolist() == list(range(30, 40))
    assert np.isfinite(gappy.deg[0, ~nan]).all() and np.isnan(gappy.sd_deg[0, nan]).all()


def test_one_standard_deviation_is_what_errors_of_the_bones_make_of_it():
    """Against noise: away from the singular pose, and near it."""
    rng = np.random.default_rng(4)
    sigma_deg, count = 0.5, 4000
    theta = np.zeros((1, count, PAPER21.pose_size))
    for bone, vector in (("left_shank", [0.9, 0, 0]), ("right_shank", [0.3, 0, 1.2])):
        at = 3 + 3 * PAPER21.bone(bone)
        theta[0, :, at : at + 3] = vector
    exact = take_of(theta, [person()], names=("a",))
    matrices = exact.bone_rotation_in_world(0)
    noise = rng.normal(scale=np.radians(sigma_deg) / np.sqrt(3), size=(count, 21, 3))
    noisy = Rotation.from_rotvec(noise.reshape(-1, 3)).as_matrix().reshape(count, 21, 3, 3)
    quaternion = Rotation.from_matrix((noisy @ matrices).reshape(-1, 3, 3)).as_quat(
        canonical=True, scalar_first=True
    )
    take = replace(
        exact,
        bone_rotation_in_world_wxyz=quaternion.reshape(1, count, 21, 4),
        bone_sigma_deg=np.full((1, count, 21), sigma_deg),
    )
    found = joint_angles(take)
    for side in ("left", "right"):
        for name in ("flexion", "adduction", "rotation"):
            deg, sd = found.curve("a", f"{side}_knee_{name}")
            assert deg.std() == pytest.approx(np.median(sd), rel=0.06)


def test_the_error_bar_grows_to_that_of_any_angle_in_the_singular_pose():
    sd = [
        joint_angles(posed({"left_upper_arm": ("z", -turn)}, sigma_deg=3.0)).curve(
            "a", "left_shoulder_plane"
        )[1][0]
        for turn in (0.0, 60.0, 85.0, 90.0)
    ]
    assert sd[0] == pytest.approx(3.0 * np.sqrt(2 / 3))
    assert sd[0] < sd[1] < sd[2] < sd[3] == pytest.approx(ANY_ANGLE_SD_DEG)
    hanging = joint_angles(posed({"left_upper_arm": ("z", -90.0)}, sigma_deg=3.0))
    assert np.isfinite(hanging.deg).all()
    assert hanging.curve("a", "left_arm_flexion")[1][0] < 3


def test_a_constant_of_a_joint_is_in_its_bar_also_where_that_grows():
    turned = posed({"left_upper_arm": ("z", -60.0)}, sigma_deg=3.0)
    bare, plain = (
        joint_angles(turned, constants=c)
        for c in ({"arm": (4.0, 0.0, 0.0), "neck": (0.0, 2.0, 0.0)}, {})
    )
    for name, square in (("left_arm_flexion", 16.0), ("neck_bending", 4.0), ("neck_flexion", 0.0)):
        grown = 1.0 / np.cos(np.radians(30.0)) ** 2 if "arm" in name else 1.0
        more = bare.curve("a", name)[1] ** 2 - plain.curve("a", name)[1] ** 2
        assert more == pytest.approx(square * grown, abs=1e-6)
    assert {joint.name for joint in JOINTS} == {*CONSTANT_DEG}


def test_noise_about_hanging_arms_does_not_wind_the_plane_of_elevation_up():
    rng = np.random.default_rng(6)
    theta = np.zeros((1, 3000, PAPER21.pose_size))
    at = 3 + 3 * PAPER21.bone("left_upper_arm")
    theta[0, :, at : at + 3] = [0, 0, -np.pi / 2] + rng.normal(scale=0.02, size=(3000, 3))
    found = joint_angles(take_of(theta, [person()], names=("a",)))
    assert np.abs(found.curve("a", "left_shoulder_plane")[0]).max() <= 360


def test_gait_cycles_go_from_strike_to_strike():
    """Stepping on the spot, 1.2 s a step of the left foot; the third is not seen whole."""
    shape, time_s = person(), np.arange(400) / 60
    lift = np.clip(np.sin(2 * np.pi * time_s / 1.2), 0, None)
    theta = np.zeros((1, 400, PAPER21.pose_size))
    theta[0, :, 1] = shape.standing_root_height_m
    for bone, most in (("left_thigh", -1.1), ("left_shank", 1.6)):
        theta[0, :, 3 + 3 * PAPER21.bone(bone)] = most * lift
    take = with_gap(take_of(theta, [shape], names=("a",)), slice(200, 210))
    found = fusecap.joint_angles(take)
    gait = gait_cycles(take, found, 0, "left")
    assert gait.start_s == pytest.approx([0.6, 1.8, 4.2, 5.4], abs=0.05)
    assert np.isfinite(gait.deg).all()
    knee = gait.names.index("left_knee_flexion")
    assert gait.mean_deg[:, knee].max() == pytest.approx(np.degrees(1.6), abs=1)
    assert gait.band_deg[:, knee].max() < 5
    assert len(gait_cycles(take, found, 0, "right").deg) == 0
    lowered = take.bone_position_in_world_m - [0.0, 0.6, 0.0] * np.eye(21)[0][:, None]
    lying = gait_cycles(replace(take, bone_position_in_world_m=lowered), found, 0, "left")
    assert len(lying.deg) == 0 and "upright" in lying.why_none
    nobody = replace(take, tracked=np.zeros_like(take.tracked))
    none = gait_cycles(nobody, joint_angles(nobody), 0, "left")
    assert len(none.deg) == 0 and np.isnan(none.mean_deg).all() and np.isnan(none.band_deg).all()


def test_a_foot_that_stirs_where_it_stands_has_not_come_down_again():
    """Noise of some centimetres is quicker than what stands; a step as quick goes farther."""
    shape, time_s = person(), np.arange(180) / 60
    theta = np.zeros((1, 180, PAPER21.pose_size))
    theta[0, :, 1] = shape.standing_root_height_m
    for metres, strikes in ((0.06, 0), (0.3, 1)):
        theta[0, :, 0] = metres * np.clip((time_s - 1.5) / 0.15, 0, 1)
        take = take_of(theta, [shape], names=("a",))
        down = [event for event in foot_events(take, 0) if event.side == "left" and event.strikes]
        assert len(down) == strikes


def fusecap_angles(*arguments):
    return CliRunner().invoke(app, ["angles", *map(str, arguments)])


def test_the_command_writes_table_mot_and_pictures(tmp_path):
    take = with_gap(two_walkers(), slice(5, 10))
    save_take(take, tmp_path / "duo.npz")
    result = fusecap_angles(tmp_path / "duo.npz", "--mot", "--plot", "--gait", "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert {"left_knee_flexion", "neck_rotation"} <= {*summary["people"]["anna"]}
    assert {*summary["gait_cycles"]} == {"anna", "ben"}
    names = {path.name for path in tmp_path.iterdir()}
    assert names >= {
        *("duo_angles.csv", "duo_angles_anna.mot", "duo_angles_ben.png", "duo_angles_gait.csv")
    }
    assert {str(tmp_path / name) for name in names - {"duo.npz", "duo.files.json"}} == {
        *summary["files"]
    }
    with (tmp_path / "duo_angles.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 80
    assert [row["left_knee_flexion_deg"] == "" for row in rows if row["person"] == "anna"] == [
        5 <= frame < 10 for frame in range(40)
    ]
    expected, _ = joint_angles(take).curve("ben", "left_knee_flexion")
    found = [float(r["left_knee_flexion_deg"]) for r in rows if r["person"] == "ben"]
    np.testing.assert_allclose(found, expected, atol=1e-4)
    lines = (tmp_path / "duo_angles_anna.mot").read_text().splitlines()
    end = lines.index("endheader")
    assert "nRows=35" in lines[:end] and "inDegrees=yes" in lines[:end]
    columns = lines[end + 1].split("\t")
    assert columns[0] == "time" and f"nColumns={len(columns)}" in lines[:end]
    assert {len(line.split("\t")) for line in lines[end + 1 :]} == {len(columns)}


def test_limbs_that_nothing_measured_are_told_with_their_angles(tmp_path):
    text = f"cameras: none sees left_knee of anybody; {UNMEASURED}: leave their angles out"
    report = {"notes": ["a sensor slept", text]}
    take = replace(two_walkers(), provenance={"report": report})
    save_take(take, tmp_path / "duo.npz")
    save_take(edit_take(take, EditOptions(start_s=0.1)), tmp_path / "short.npz")
    for name in ("duo.npz", "short.npz"):
        result = fusecap_angles(tmp_path / name, "--json")
        assert json.loads(result.stdout)["notes"] == [text]
        assert "none sees left_knee" in result.stderr and "slept" not in result.stderr


def test_one_frame_is_enough_and_nobody_is_an_error(tmp_path):
    one = posed({"left_shank": ("x", 30)})
    save_take(one, tmp_path / "one.npz")
    assert fusecap_angles(tmp_path / "one.npz", "--gait").exit_code == 0
    nobody = with_gap(one, slice(0, 1))
    save_take(nobody, tmp_path / "nobody.npz")
    assert "nobody is tracked" in str(fusecap_angles(tmp_path / "nobody.npz").exception)
    wrong = fusecap_angles(tmp_path / "one.npz", "--out", tmp_path / "x.txt")
    assert isinstance(wrong.exception, InputError) and ".csv" in str(wrong.exception)
    with pytest.raises(TakeError, match="left_knee_flexion"):
        joint_angles(one).curve("a", "left_knee_flexon")
    assert joint_angles(one.of_frames(0, 0)).deg.shape[1] == 0


def on_a_treadmill(belt_m_s: float, frames: int = 400):
    """Legs swing about the hips, which stay; feet go back with the belt and forward lifted."""
    shape, time_s = person(), np.arange(frames) / 60
    theta = np.zeros((1, frames, PAPER21.pose_size))
    theta[0, :, 1] = shape.standing_root_height_m
    leg_m, half_s = shape.standing_root_height_m, 0.55
    for side, phase in (("left", 0.0), ("right", 0.5)):
        cycle = (time_s / (2 * half_s) + phase) % 1.0
        back = cycle < 0.55
        reach = belt_m_s * half_s * np.where(back, 1.1 * (0.5 - cycle / 0.55), 0.0)
        swing = (cycle - 0.55) / 0.45
        reach = np.where(back, reach, belt_m_s * half_s * 1.1 * (swing - 0.5))
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_thigh")] = -np.arcsin(reach / leg_m)
        bent = np.where(back, 0.0, np.sin(np.pi * np.clip(swing, 0, 1)))
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_shank")] = 1.2 * bent
    return take_of(theta, [shape], names=("a",))


def test_on_a_treadmill_both_feet_have_cycles():
    take = on_a_treadmill(1.1)
    assert floor_velocity(take, 0) == pytest.approx([0, 0, -1.1], abs=0.2)
    found = joint_angles(take)
    for side in ("left", "right"):
        cycles = gait_cycles(take, found, 0, side)
        assert len(cycles.deg) >= 4
        assert np.diff(cycles.start_s) == pytest.approx(1.1, abs=0.06)


def test_a_floor_does_not_move_under_who_stands_walks_or_is_not_there():
    for take in (two_walkers(), posed({}), with_gap(on_a_treadmill(1.1), slice(0, 400))):
        assert not floor_velocity(take, 0).any()


def test_feet_of_a_take_of_one_frame_a_second_are_told(monkeypatch):
    monkeypatch.setattr(feet, "floor_velocity", lambda *_: np.array([0.0, 0.0, -1.1]))
    rare = replace(on_a_treadmill(1.1), timestamps_ns=np.arange(400) * 10**9, rate_hz=1.0)
    assert len(feet.on_floor(rare, 0, "left")) == 400


@pytest.mark.filterwarnings("error")
def test_a_floor_does_not_move_under_who_is_there_for_single_frames():
    gaps = [frame for frame in range(400) if frame % 3]
    assert not floor_velocity(with_gap(on_a_treadmill(1.1), gaps), 0).any()


def test_a_side_without_a_cycle_is_told_and_why(tmp_path):
    save_take(two_walkers(), tmp_path / "duo.npz")
    result = fusecap_angles(tmp_path / "duo.npz", "--gait")
    assert result.exit_code == 0
    words = " ".join(result.output.split())
    for side in ("left", "right"):
        assert f"no gait cycle of the {side} foot" in words
