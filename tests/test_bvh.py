import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from bvh_reader import Bvh
from fusecap.body.rigs import PRESETS
from fusecap.body.shape import end_offsets_m
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.cli import app
from fusecap.cli.common import Exports, write_take
from fusecap.errors import InputError, TakeError
from fusecap.exports.euler import euler_rad
from fusecap.exports.formats import FORMATS, format_named
from fusecap.exports.formats.bvh import _ORDERS, write_bvh
from fusecap.exports.take_files import export, export_take
from fusecap.exports.take_format import ExportOptions, TakeFormat
from fusecap.stored_take import load_take
from fusecap.take import save_take
from motions import any_poses, person, solved, take_of, walk

CONNECTING = {f"{side}_{bone}" for side in ("left", "right") for bone in ("pelvis", "clavicle")}


def written(take, path, **options) -> Path:
    """The first subject's file."""
    write_bvh(take.of_subjects([0]), path, ExportOptions(**options))
    return path


def largest_error_m(path, take, subject=0, unit_m=1.0) -> float:
    read = Bvh(path).joint_positions()
    assert set(read) - CONNECTING == set(take.bone_names) - CONNECTING
    errors = [
        read[name] * unit_m - take.bone_position_in_world_m[subject, :, bone]
        for bone, name in enumerate(take.bone_names)
    ]
    return float(np.abs(errors).max())


def turns(angles_rad, order) -> np.ndarray:
    return Rotation.from_euler(order, angles_rad).as_matrix()


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
@pytest.mark.parametrize(("unit", "unit_m"), [("m", 1.0), ("cm", 0.01)])
def test_every_joint_of_every_frame_reads_back(tmp_path, rng, skeleton, unit, unit_m):
    theta = np.stack([any_poses(rng, skeleton, 40), walk(person(skeleton=skeleton), 40)])
    take = take_of(theta, [person(1.5, skeleton), person(1.9, skeleton)], names=("a", "b"))
    for subject, path in enumerate(
        export_take(take, tmp_path, format="bvh", stem="take", unit=unit)
    ):
        assert largest_error_m(path, take, subject, unit_m) < 1e-5


def test_rest_pose_is_all_zero_rotations(tmp_path):
    theta = np.zeros((1, 2, 66))
    theta[:, :, 1] = 0.9
    written(take_of(theta, [person()], names=("a",)), tmp_path / "a.bvh")
    bvh = Bvh(tmp_path / "a.bvh")
    assert np.array_equal(bvh.motion[:, :3], [[0, 0.9, 0]] * 2)
    assert not bvh.motion[:, 3:].any()
    assert bvh.frame_time == "0.0166667"
    assert bvh.channels[0] == (
        ["Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation"]
    )
    assert all(c == ["Zrotation", "Xrotation", "Yrotation"] for c in bvh.channels[1:])


def test_hips_and_shoulders_are_connected(tmp_path):
    """As Blender draws it: a bone ends at the mean of its children."""
    for skeleton in (PAPER21, EXTENDED23):
        shape = person(skeleton=skeleton)
        take = take_of(walk(shape, 1)[None], [shape], names=("a",))
        bvh = Bvh(written(take, tmp_path / "a.bvh"))
        offset = dict(zip(bvh.names, bvh.offsets, strict=True))
        above = {n: bvh.names[p] for n, p in zip(bvh.names, bvh.parents, strict=True) if p >= 0}
        for side in ("left", "right"):
            assert above[f"{side}_thigh"] == f"{side}_pelvis"
            assert above[f"{side}_upper_arm"] == f"{side}_clavicle"
        tails = [offset[name] for name, parent in above.items() if parent == "hips"]
        assert np.allclose(np.mean(tails, axis=0), [0, 0.09975, 0], atol=1e-6)


def test_every_leaf_ends_where_the_body_does(tmp_path):
    shape = person(1.8)
    written(take_of(walk(shape, 1)[None], [shape], names=("a",)), tmp_path / "a.bvh")
    ends = Bvh(tmp_path / "a.bvh").ends
    expected = end_offsets_m(shape)
    assert set(ends) == set(expected)
    assert all(np.allclose(ends[name], expected[name], atol=1e-6) for name in ends)


orders = st.sampled_from(_ORDERS)


@given(
    orders,
    st.floats(-np.pi, np.pi),
    st.sampled_from([1.0, -1.0]),
    st.sampled_from([0.0, 1e-16, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3, 0.1, 1.0]),
    st.floats(-np.pi, np.pi),
)
def test_euler_angles_give_the_rotation_also_near_gimbal_lock(order, a, sign, from_pole, c):
    rotation = turns([[a, sign * (np.pi / 2 - from_pole), c]], order)
    assert np.abs(turns(euler_rad(rotation, order), order) - rotation).max() < 1e-14


@given(
    orders,
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.dot(q, q) > 1e-3),
)
def test_euler_angles_give_any_rotation(order, quaternion):
    rotation = Rotation.from_quat([quaternion]).as_matrix()
    assert np.abs(turns(euler_rad(rotation, order), order) - rotation).max() < 1e-14


def test_bends_of_90_degrees_do_not_jump(tmp_path):
    """Knees, hips, elbows and shoulders of a noisy squat: no channel outruns its joint."""
    frames = 200
    rng = np.random.default_rng(3)
    theta = walk(person(), frames)
    bend = np.radians(90) * np.sin(np.linspace(0, np.pi, frames))
    for name, axis, sign in (
        *((f"{side}_shank", 0, 1) for side in ("left", "right")),
        *((f"{side}_thigh", 0, -1) for side in ("left", "right")),
        *(("left_forearm", 1, -1), ("right_forearm", 1, 1)),
        *(("left_upper_arm", 1, -1), ("right_upper_arm", 2, 1)),
    ):
        theta[:, 3 + 3 * PAPER21.bone(name) + axis] = sign * bend
    theta[:, 3:] += np.radians(0.3) * rng.standard_normal((frames, 63))
    bvh = Bvh(written(take_of(theta[None], [person()], names=("a",)), tmp_path / "a.bvh"))
    at = 0
    for channels in bvh.channels:
        angles = bvh.motion[:, at + len(channels) - 3 : at + len(channels)]
        at += len(channels)
        order = "".join(channel[0] for channel in channels[-3:])
        turn = Rotation.from_euler(order, angles, degrees=True)
        true_deg = np.degrees((turn[:-1].inv() * turn[1:]).magnitude())
        assert (np.abs(np.diff(angles, axis=0)).max(axis=1) < 2.0 * true_deg + 0.2).all()


@pytest.mark.parametrize("order", _ORDERS)
def test_of_two_triples_the_nearer_one_follows(order):
    """Through the pole and out again: an angle that passed 90 degrees goes on."""
    angles = np.zeros((50, 3))
    angles[:, 1] = np.linspace(0, 2.5, 50)
    assert np.allclose(euler_rad(turns(angles, order), order), angles, atol=1e-9)


def test_angles_do_not_jump_while_a_subject_spins(tmp_path):
    theta = np.zeros((1, 120, 66))
    theta[0, :, 4] = (np.linspace(0, 4 * np.pi, 120) + np.pi) % (2 * np.pi) - np.pi
    take = take_of(theta, [person()], names=("a",))
    written(take, tmp_path / "a.bvh")
    assert np.abs(np.diff(Bvh(tmp_path / "a.bvh").motion, axis=0)).max() < 10.0
    assert largest_error_m(tmp_path / "a.bvh", take) < 1e-5


def with_gap(take, gap):
    tracked = take.tracked.copy()
    tracked[0, gap] = False
    hole = {}
    for name in ("theta", "bone_position_in_world_m", "bone_rotation_in_world_wxyz"):
        values = getattr(take, name).copy()
        values[0, gap] = np.nan
        hole[name] = values
    return replace(take, tracked=tracked, **hole)


def test_untracked_frames_hold_the_last_pose(tmp_path):
    take = with_gap(take_of(walk(person(), 8)[None], [person()], names=("a",)), [0, 1, 4, 5])
    written(take, tmp_path / "a.bvh")
    motion = Bvh(tmp_path / "a.bvh").motion
    assert np.isfinite(motion).all() and len(motion) == 8
    assert np.array_equal(motion[[0, 1]], motion[[2, 2]])
    assert np.array_equal(motion[[4, 5]], motion[[3, 3]])
    assert not np.array_equal(motion[6], motion[5])


def test_subject_never_tracked_is_refused_alone_and_skipped_among_others(tmp_path):
    shapes = [person(), person()]
    take = take_of(np.stack([walk(person(), 3)] * 2), shapes, names=("a", "b"))
    take = with_gap(take, [0, 1, 2])
    with pytest.raises(TakeError, match="'a' is tracked in no frame"):
        written(take, tmp_path / "a.bvh")
    assert [p.name for p in export_take(take, tmp_path, format="bvh", stem="t")] == ["t_b.bvh"]
    assert [p.name for p in tmp_path.iterdir()] == ["t_b.bvh"]


def test_odd_names_become_file_names_that_stay_apart(tmp_path):
    names = ("../../etc/x", "a/b", "a:b", " ", "Zoë")
    take = take_of(np.stack([walk(person(), 1)] * 5), [person()] * 5, names=names)
    paths = export_take(take, tmp_path / "out", format="bvh", stem="my take")
    assert [p.parent for p in paths] == [tmp_path / "out"] * 5
    assert [p.name for p in paths] == [
        "my take_______etc_x.bvh",
        "my take_a_b.bvh",
        "my take_a_b_2.bvh",
        "my take_unnamed.bvh",
        "my take_Zoë.bvh",
    ]


@pytest.mark.parametrize(
    ("names", "files"),
    [
        (("p__3", "p?", "p!"), ["t_p__3.bvh", "t_p_.bvh", "t_p__2.bvh"]),
        (("p__2", "p?", "p!"), ["t_p__2.bvh", "t_p_.bvh", "t_p__3.bvh"]),
        (("Anna", "anna", "ANNA_2"), ["t_Anna.bvh", "t_anna_2.bvh", "t_ANNA_2_2.bvh"]),
    ],
)
def test_no_two_people_share_a_file(tmp_path, names, files):
    take = take_of(np.stack([walk(person(), 1)] * 3), [person()] * 3, names=names)
    paths = export_take(take, tmp_path, format="bvh", stem="t")
    assert [path.name for path in paths] == files
    assert len({path.name.casefold() for path in tmp_path.iterdir()}) == 3


def test_unknown_unit_is_refused(tmp_path):
    take = take_of(walk(person(), 1)[None], [person()], names=("a",))
    with pytest.raises(InputError, match=r"known: m, cm|did you mean"):
        export_take(take, tmp_path, format="bvh", stem="a", unit="inch")


def test_unknown_format_names_the_nearest_known_one(tmp_path):
    take = take_of(walk(person(), 1)[None], [person()], names=("a",))
    with pytest.raises(InputError, match="did you mean 'bvh'"):
        export_take(take, tmp_path, format="bhv", stem="a")


def test_the_format_asked_for_is_the_one_written(tmp_path, monkeypatch):
    """`--format` and `--export` go by the table, and a new entry of it is all they need."""

    def write(take, path, options):
        path.write_text(f"{take.subject_names} {options.unit}")

    module = ModuleType("fusecap.exports.formats.note")
    module.FORMAT = TakeFormat(suffix=".note", write=write, per_person=True, units=("m", "cm"))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(FORMATS, "note", "a note")
    take = take_of(walk(person(), 1)[None], [person()], names=("a",))
    save_take(take, tmp_path / "t.npz")
    command = ["export", str(tmp_path / "t.npz"), "--format", "note", "--unit", "cm"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert (tmp_path / "t_a.cm.note").read_text() == "('a',) cm"
    assert not list(tmp_path.glob("*.bvh"))
    again = tmp_path / "again.npz"
    files = solved_again(take, again, "note", "bvh")
    assert [path.name for path in files] == ["again.npz", "again_a.note", "again_a.bvh"]


def two_people(skeleton=PAPER21, names=("anna", "ben")):
    shapes = [person(1.6, skeleton), person(1.9, skeleton)]
    return take_of(np.stack([walk(shape, 6) for shape in shapes]), shapes, names=names)


def test_metres_and_centimetres_and_rigs_never_share_a_name(tmp_path):
    take = two_people(names=("anna", "anna_cm"))
    paths = [
        path
        for unit in ("m", "cm")
        for rig in PRESETS
        for path in export_take(take, tmp_path, format="bvh", stem="t", unit=unit, rig=rig)
    ]
    assert len({*paths}) == len(paths) == 2 * 2 * len(PRESETS)
    assert {"t_anna.bvh", "t_anna.cm.bvh", "t_anna_cm.bvh", "t_anna.mixamo.cm.bvh"} <= {
        path.name for path in paths
    }


def solved_again(take, target, *formats):
    """The files of a solve that wrote this take."""
    return write_take(solved(take), target, Exports(formats=list(formats)), picture=False)


def listed(take):
    return json.loads(take.with_name(f"{take.stem}.files.json").read_text())["files"]


def names_in(folder):
    return {path.name for path in folder.iterdir()}


def test_exports_of_an_earlier_solve_are_renamed_and_kept(tmp_path):
    target = tmp_path / "t.npz"
    solved_again(two_people(), target, "bvh")
    ben = (tmp_path / "t_ben.bvh").read_bytes()
    (tmp_path / "t_eva.bvh").write_text("somebody else's")
    solved_again(two_people(names=("anna", "carl")), target, "bvh")
    assert (tmp_path / "t_ben.earlier1.bvh").read_bytes() == ben
    assert listed(target) == ["t_anna.bvh", "t_carl.bvh"]
    solved_again(two_people(), target)
    assert names_in(tmp_path) == {
        *("t.npz", "t_anna.earlier1.bvh", "t_ben.earlier1.bvh", "t_carl.earlier1.bvh"),
        "t_eva.bvh",
    }


def test_inputs_that_share_the_name_of_a_take_stay_where_they_are(tmp_path):
    """Sensor files of a session called walk, beside its take and what was exported from it."""
    inputs = ("walk.csv", "walk.hips.csv", "walk.glb", "walk_anna.bvh", "walk.rig.npz")
    for name in inputs:
        (tmp_path / name).write_text("recorded")
    for _ in range(2):
        solved_again(two_people(), tmp_path / "walk.npz")
    solved_again(two_people(), tmp_path / "walk.npz", "html")
    solved_again(two_people(), tmp_path / "walk.npz")
    assert names_in(tmp_path) == {*inputs, "walk.npz", "walk.earlier1.html"}
    assert all((tmp_path / name).read_text() == "recorded" for name in inputs)


@pytest.mark.parametrize(
    "names",
    [
        5,
        {"t": 1},
        ["../u.npz", "u_a.bvh", "/etc/x", 3, "t.npz/../u", "t.toml", "t.npz", "in/../t.png"],
    ],
)
def test_a_list_of_files_does_not_say_what_else_to_rename(tmp_path, names):
    (tmp_path / "u_a.bvh").write_text("")
    (tmp_path / "in").mkdir()
    (tmp_path / "u.npz").write_text("")
    (tmp_path / "in" / "t.toml").write_text("")
    save_take(two_people(), tmp_path / "in" / "t.npz")
    (tmp_path / "in" / "t.files.json").write_text(json.dumps({"files": names}))
    solved_again(two_people(), tmp_path / "in" / "t.npz")
    assert names_in(tmp_path) == {"u_a.bvh", "u.npz", "in"}
    assert names_in(tmp_path / "in") == {"t.npz", "t.toml"}


def test_what_any_command_made_of_a_take_is_set_aside_by_a_newer_one(tmp_path):
    target = tmp_path / "t.npz"
    save_take(two_people(), target)
    away = tmp_path / "away"
    for command in (
        ["export", target, "--format", "html"],
        ["export", target, "--format", "csv", "--out", away],
        ["angles", target, "--mot"],
        ["angles", target, "--out", tmp_path / "mine.csv"],
    ):
        assert CliRunner().invoke(app, [*map(str, command)]).exit_code == 0
    made = ["t.html", "t_angles.csv", "t_angles_anna.mot", "t_angles_ben.mot"]
    assert listed(target) == made
    write_take(solved(two_people()), target, Exports(formats=["bvh"]), picture=True)
    assert listed(target) == ["t.png", "t_anna.bvh", "t_ben.bvh"]
    solved_again(two_people(), target, "bvh")
    aside = {f"{name.partition('.')[0]}.earlier1.{name.partition('.')[2]}" for name in made}
    stays = {"t.npz", "t.files.json", "t_anna.bvh", "t_ben.bvh", "away", "mine.csv"}
    assert names_in(tmp_path) == aside | stays | {"t.earlier1.png"}
    assert names_in(away) == {"t.csv"}


def test_an_edit_over_another_take_sets_aside_what_that_one_left(tmp_path):
    save_take(two_people(), tmp_path / "t.npz")
    solved_again(two_people(), tmp_path / "e.npz", "html")
    command = ["edit", tmp_path / "t.npz", "--floor-shift", "1cm", "--out", tmp_path / "e.npz"]
    assert CliRunner().invoke(app, [*map(str, command)]).exit_code == 0
    assert names_in(tmp_path) == {"t.npz", "e.npz", "e.earlier1.html"}


def test_a_take_that_cannot_be_written_leaves_everything_as_it_was(tmp_path, monkeypatch):
    target = tmp_path / "t.npz"
    solved_again(two_people(), target, "bvh", "html")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}

    def fails(nothing, blocks, path):
        raise TakeError("the disk is full")

    monkeypatch.setattr("fusecap.take_builder.save_blocks", fails)
    with pytest.raises(TakeError, match="disk is full"):
        solved_again(two_people(names=("anna", "carl")), target, "csv")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_no_export_of_an_earlier_take_stays_when_a_new_one_fails(tmp_path, monkeypatch):
    """Neither one that the new solve did not want, nor one that it could not write."""
    target = tmp_path / "t.npz"
    solved_again(two_people(), target, "bvh", "csv", "html")
    (tmp_path / "t.html").unlink()

    def fails(take, path, options):
        raise TakeError("the disk is full")

    broken = replace(format_named("csv"), write=fails)
    monkeypatch.setattr("fusecap.exports.formats.csv.FORMAT", broken)
    with pytest.raises(TakeError, match="disk is full"):
        solved_again(two_people(names=("anna", "carl")), target, "bvh", "csv")
    left = {"t.npz", "t.files.json", "t_anna.bvh", "t_carl.bvh", "t_ben.earlier1.bvh"}
    left |= {"t.earlier1.csv"}
    assert names_in(tmp_path) == left
    assert load_take(target).subject_names == ("anna", "carl")


def test_export_goes_by_the_ending(tmp_path):
    both = two_people()
    paths = export(both, tmp_path / "x.bvh", unit="cm")
    assert [path.name for path in paths] == ["x_anna.cm.bvh", "x_ben.cm.bvh"]
    paths = export(both, tmp_path / "x.bvh", rig="mixamo")
    assert [path.name for path in paths] == ["x_anna.mixamo.bvh", "x_ben.mixamo.bvh"]
    assert export(both, tmp_path / "x.glb", rig="mixamo") == [tmp_path / "x.glb"]
    assert export(both.of_subjects([1]), tmp_path / "x.BVH") == [tmp_path / "x.BVH"]
    with pytest.raises(InputError, match=r"no format ends with '.bvg'; did you mean '.bvh'"):
        export(both, tmp_path / "x.bvg")
    with pytest.raises(InputError, match="no rig 'mixamoo'; did you mean 'mixamo'"):
        export(both, tmp_path / "x.bvh", rig="mixamoo")
    with pytest.raises(InputError, match="written in m or cm, not in mm"):
        export(both, tmp_path / "x.bvh", unit="mm")
    with pytest.raises(TakeError, match="nothing to export"):
        export(with_gap(both.of_subjects([0]), range(6)), tmp_path / "y.bvh")
    assert not list(tmp_path.glob("y*"))


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
@pytest.mark.parametrize("rig", PRESETS)
def test_every_rig_has_its_joints_where_the_take_has_them(tmp_path, rng, skeleton, rig):
    """Three-spined rigs fold a joint, which costs millimetres in a format without places."""
    shape = person(1.8, skeleton)
    theta = walk(shape, 40)
    theta[:, 3:] += 0.1 * rng.standard_normal((40, theta.shape[1] - 3))
    take = take_of(theta[None], [shape], names=("a",))
    (path,) = export_take(take, tmp_path, format="bvh", stem="t", rig=rig)
    read = Bvh(path).joint_positions()
    joints = PRESETS[rig].joints
    assert list(read) != [] and {*read} == {joint.name for joint in joints}
    folded = any(len(joint.turns_with) == 2 for joint in joints)
    checked = 0
    for joint in joints:
        ours = joint.turns_with == (joint.sits_at,) and joint.towards is None
        if ours and joint.sits_at in take.bone_names:
            checked += 1
            true = take.bone_position_in_world_m[0, :, take.skeleton.bone(joint.sits_at)]
            assert np.abs(read[joint.name] - true).max() < (4e-3 if folded else 1e-5)
    assert checked >= (18 if folded else 19)
