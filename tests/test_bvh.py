import sys
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from bvh_reader import Bvh
from fusecap.body.shape import end_offsets_m
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.cli import app
from fusecap.cli.common import write_take
from fusecap.errors import InputError, TakeError
from fusecap.export.formats import FORMATS
from fusecap.export.formats.bvh import euler_zxy_rad, write_bvh
from fusecap.export.take_files import TakeFormat, export_take
from fusecap.take import save_take
from motions import any_poses, person, take_of, walk


def largest_error_m(path, take, subject=0, unit_m=1.0) -> float:
    read = Bvh(path).joint_positions()
    assert set(read) == set(take.bone_names)
    errors = [
        read[name] * unit_m - take.bone_position_in_world_m[subject, :, bone]
        for bone, name in enumerate(take.bone_names)
    ]
    return float(np.abs(errors).max())


def from_zxy(angles_rad) -> np.ndarray:
    return Rotation.from_euler("ZXY", angles_rad).as_matrix()


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
    write_bvh(take_of(theta, [person()], names=("a",)), "a", tmp_path / "a.bvh")
    bvh = Bvh(tmp_path / "a.bvh")
    assert np.array_equal(bvh.motion[:, :3], [[0, 0.9, 0]] * 2)
    assert not bvh.motion[:, 3:].any()
    assert bvh.frame_time == "0.0166667"
    assert bvh.channels[0] == (
        ["Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation"]
    )
    assert all(c == ["Zrotation", "Xrotation", "Yrotation"] for c in bvh.channels[1:])


def test_every_leaf_ends_where_the_body_does(tmp_path):
    shape = person(1.8)
    write_bvh(take_of(walk(shape, 1)[None], [shape], names=("a",)), "a", tmp_path / "a.bvh")
    ends = Bvh(tmp_path / "a.bvh").ends
    expected = end_offsets_m(shape)
    assert set(ends) == set(expected)
    assert all(np.allclose(ends[name], expected[name], atol=1e-6) for name in ends)


@given(
    st.floats(-np.pi, np.pi),
    st.sampled_from([1.0, -1.0]),
    st.sampled_from([0.0, 1e-16, 1e-12, 1e-9, 1e-8, 1e-6, 1e-3, 0.1, 1.0]),
    st.floats(-np.pi, np.pi),
)
def test_euler_angles_give_the_rotation_also_near_gimbal_lock(a, sign, from_pole, c):
    rotation = from_zxy([[a, sign * (np.pi / 2 - from_pole), c]])
    assert np.abs(from_zxy(euler_zxy_rad(rotation)) - rotation).max() < 1e-14


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.dot(q, q) > 1e-3))
def test_euler_angles_give_any_rotation(quaternion):
    rotation = Rotation.from_quat([quaternion]).as_matrix()
    assert np.abs(from_zxy(euler_zxy_rad(rotation)) - rotation).max() < 1e-14


def test_angles_do_not_jump_while_a_subject_spins(tmp_path):
    theta = np.zeros((1, 120, 66))
    theta[0, :, 4] = (np.linspace(0, 4 * np.pi, 120) + np.pi) % (2 * np.pi) - np.pi
    take = take_of(theta, [person()], names=("a",))
    write_bvh(take, "a", tmp_path / "a.bvh")
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
    write_bvh(take, "a", tmp_path / "a.bvh")
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
        write_bvh(take, "a", tmp_path / "a.bvh")
    assert [p.name for p in export_take(take, tmp_path, format="bvh", stem="t")] == ["t_b.bvh"]
    assert [p.name for p in tmp_path.iterdir()] == ["t_b.bvh"]


def test_odd_names_become_file_names_that_stay_apart(tmp_path):
    names = ("../../etc/x", "a/b", "a:b", " ", "Zoë")
    take = take_of(np.stack([walk(person(), 1)] * 5), [person()] * 5, names=names)
    paths = export_take(take, tmp_path / "out", format="bvh", stem="my take")
    assert [p.parent for p in paths] == [tmp_path / "out"] * 5
    assert [p.name for p in paths] == [
        "my_take_______etc_x.bvh",
        "my_take_a_b.bvh",
        "my_take_a_b_3.bvh",
        "my_take_unnamed.bvh",
        "my_take_Zoë.bvh",
    ]


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

    def write(take, subject, path, *, units_per_m=1.0):
        path.write_text(f"{subject} {units_per_m:g}")

    module = ModuleType("fusecap.export.formats.note")
    module.FORMAT = TakeFormat(suffix=".note", write=write)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(FORMATS, "note", "a note")
    take = take_of(walk(person(), 1)[None], [person()], names=("a",))
    save_take(take, tmp_path / "t.npz")
    command = ["export", str(tmp_path / "t.npz"), "--format", "note", "--unit", "cm"]
    assert CliRunner().invoke(app, command).exit_code == 0
    assert (tmp_path / "t_a.note").read_text() == "a 100"
    assert not list(tmp_path.glob("*.bvh"))
    again = tmp_path / "again.npz"
    files = write_take(take, again, exports=["note", "bvh"], unit="m", picture=False)
    assert [path.name for path in files] == ["again.npz", "again_a.note", "again_a.bvh"]
