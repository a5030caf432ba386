import errno
import json
import os
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from fusecap.body.pose import forward_kinematics
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.errors import TakeError
from fusecap.files import written_whole
from fusecap.stored_take import StoredTake, load_take
from fusecap.take import MOTION, Take, provenance, save_take
from fusecap.take_builder import TakeBuilder
from fusecap.types import Estimate, Status
from motions import any_poses, person, take_of, walk

ARRAYS = (
    "timestamps_ns",
    "heights_m",
    "offsets_m",
    "theta",
    "bone_position_in_world_m",
    "bone_rotation_in_world_wxyz",
    "tracked",
    "bone_sigma_deg",
    "position_sigma_m",
)


def estimate(shape, theta, name="anna", track_id=1, status=Status.CONVERGED, timestamp_ns=0):
    position, rotation = forward_kinematics(shape, theta[None])
    return Estimate(
        track_id=track_id,
        name=name,
        timestamp_ns=timestamp_ns,
        theta=theta,
        bone_position_in_world_m=position[0],
        bone_rotation_in_world=rotation[0],
        bone_sigma_deg=np.full(shape.skeleton.bone_count, 5.0),
        position_sigma_m=np.full(shape.skeleton.bone_count, 0.02),
        shape=shape,
        status=status,
        iterations=3,
        cost=0.1,
        solve_s=1e-3,
        views=np.ones(4, dtype=bool),
        measured=True,
    )


def built(frames, *, names=(), skeleton=PAPER21) -> Take:
    builder = TakeBuilder(skeleton=skeleton, rate_hz=50.0, subject_names=names)
    for index, estimates in enumerate(frames):
        builder.add(index * 20_000_000, estimates)
    return builder.build()


@pytest.fixture
def take(rng) -> Take:
    theta = np.stack([any_poses(rng, PAPER21, 7), walk(person(1.9), 7)])
    made = take_of(theta, [person(1.6), person(1.9)], names=("anna", "Zoë"))
    return replace(made, provenance=provenance(options={"floor": True}, session_sha256="ab" * 32))


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
def test_saved_take_loads_to_the_same_poses_within_a_micrometre(tmp_path, rng, skeleton):
    theta = any_poses(rng, skeleton, 5)[None]
    take = take_of(theta, [person(skeleton=skeleton)], names=("anna",))
    save_take(take, tmp_path / "new" / "folder" / "take.npz")
    loaded = load_take(tmp_path / "new" / "folder" / "take.npz")
    for name in ARRAYS:
        rounded = 1e-3 if "sigma" in name else 1e-6
        found, stored = getattr(take, name), getattr(loaded, name)
        assert found.dtype == stored.dtype, name
        np.testing.assert_allclose(stored, found, rtol=rounded, atol=1e-6, err_msg=name)
    save_take(loaded, tmp_path / "again.npz")
    again = load_take(tmp_path / "again.npz")
    assert all(np.array_equal(getattr(again, n), getattr(loaded, n)) for n in ARRAYS)
    assert loaded.skeleton == skeleton
    assert loaded.subject_names == take.subject_names
    assert loaded.rate_hz == take.rate_hz


def test_take_file_reads_with_numpy_alone(tmp_path, take):
    save_take(take, tmp_path / "take.npz")
    with np.load(tmp_path / "take.npz", allow_pickle=False) as file:
        assert file["subject_names"].tolist() == ["anna", "Zoë"]
        assert file["bone_position_in_world_m"].shape == (2, 7, 21, 3)
        assert (file["bone_rotation_in_world_wxyz"][..., 0] >= 0).all()
        notes = json.loads(str(file["provenance"]))
    assert notes["options"] == {"floor": True}
    assert set(notes["units"]) >= {"theta", "timestamps_ns", "bone_position_in_world_m"}
    assert notes["simulated"] is False


def test_quaternions_are_the_rotations_of_the_pose(take):
    for subject in range(2):
        _, rotation = forward_kinematics(take.shape(subject), take.theta[subject])
        assert np.allclose(take.bone_rotation_in_world(subject), rotation, atol=1e-12)


def test_take_without_people_or_frames_is_a_take(tmp_path):
    save_take(built([]), tmp_path / "empty.npz")
    assert load_take(tmp_path / "empty.npz").theta.shape == (0, 0, 66)
    assert built([[], []]).tracked.shape == (0, 2)


def test_builder_follows_people_who_come_and_go():
    anna, bo = person(1.6), person(1.9)
    a, b = walk(anna, 5), walk(bo, 5)
    take = built(
        [
            [],
            [estimate(anna, a[1])],
            [estimate(bo, b[2], "bo", 2), estimate(anna, a[2])],
            [estimate(bo, b[3], "bo", 2)],
            [estimate(anna, a[4], track_id=9)],
        ],
    )
    assert take.subject_names == ("anna", "bo")
    assert take.tracked.tolist() == [
        [False, True, True, False, True],
        [False, False, True, True, False],
    ]
    assert np.array_equal(np.isnan(take.theta).any(axis=2), ~take.tracked)
    assert np.array_equal(take.theta[0, [1, 2, 4]], a[[1, 2, 4]])
    position, _ = forward_kinematics(bo, b)
    assert np.allclose(take.bone_position_in_world_m[1, 2:4], position[2:4])


def test_session_order_comes_first_and_unseen_subjects_stay():
    take = built([[estimate(person(), walk(person(), 1)[0], "guest")]], names=("bo", "anna"))
    assert take.subject_names == ("bo", "anna", "guest")
    assert take.tracked[:, 0].tolist() == [False, False, True]
    assert np.isfinite(take.offsets_m).all()


def test_diverged_solve_is_untracked():
    theta = walk(person(), 1)[0]
    take = built([[estimate(person(), theta, status=Status.DIVERGED)]])
    assert not take.tracked.any()
    assert np.isnan(take.theta).all()


def test_builder_keeps_what_it_was_given():
    theta = walk(person(), 1)[0]
    kept = theta.copy()
    builder = TakeBuilder(skeleton=PAPER21, rate_hz=50.0)
    builder.add(0, [estimate(person(), theta)])
    theta[:] = 0.0
    assert np.array_equal(builder.build().theta[0, 0], kept)


def test_last_shape_poses_all_frames():
    theta = walk(person(), 2)
    take = built([[estimate(person(1.6), theta[0])], [estimate(person(1.8), theta[1])]])
    position, _ = forward_kinematics(person(1.8), theta)
    assert np.allclose(take.bone_position_in_world_m[0], position)


def test_two_estimates_of_one_subject_at_once_are_refused():
    twice = [estimate(person(), walk(person(), 1)[0])] * 2
    with pytest.raises(TakeError, match="two estimates of 'anna'"):
        built([twice])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: {"theta": t.theta[:, :3]}, r"theta is \(2, 3, 66\), expected \(2, 7, 66\)"),
        (lambda t: {"subject_names": ("anna", "anna")}, "share a name"),
        (lambda t: {"timestamps_ns": t.timestamps_ns[::-1]}, "do not increase"),
        (lambda t: {"rate_hz": 0.0}, "rate_hz"),
        (lambda t: {"theta": t.theta * np.nan}, "'anna' is not a number up to 10000 at 0 ns"),
        (lambda t: {"offsets_m": t.offsets_m * np.nan}, "no number up to"),
        (lambda t: {"offsets_m": t.offsets_m * 1e300}, "no number up to"),
        (lambda t: {"heights_m": -t.heights_m}, "metres above zero"),
        (lambda t: {"theta": t.theta * 1e160}, "not a number up to"),
        (
            lambda t: {"bone_position_in_world_m": t.bone_position_in_world_m + 1e300},
            "not a number up to",
        ),
        (
            lambda t: {"bone_rotation_in_world_wxyz": -t.bone_rotation_in_world_wxyz},
            "w >= 0",
        ),
    ],
)
def test_contradictory_take_is_refused(take, change, message):
    with pytest.raises(TakeError, match=message):
        replace(take, **change(take))


def test_nan_is_fine_where_untracked(take):
    tracked = take.tracked.copy()
    theta = take.theta.copy()
    tracked[0, 3], theta[0, 3] = False, np.nan
    assert np.isnan(replace(take, tracked=tracked, theta=theta).theta[0, 3]).all()


def test_missing_take_is_said_so(tmp_path):
    with pytest.raises(TakeError, match="no such file; expected a take"):
        load_take(tmp_path / "none.npz")
    with pytest.raises(TakeError, match="is a folder"):
        load_take(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.5, 0.99])
def test_truncated_take_is_refused(tmp_path, take, share):
    path = tmp_path / "take.npz"
    save_take(take, path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(TakeError, match=r"damaged or cut short|not a take"):
        load_take(path)


def test_flipped_byte_is_noticed(tmp_path, take):
    path = tmp_path / "take.npz"
    save_take(take, path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(TakeError, match="damaged"):
        load_take(path)


def test_other_files_are_no_takes(tmp_path):
    (tmp_path / "text.npz").write_text("hello, this is no take")
    np.save(tmp_path / "array.npy", np.zeros(3))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickled.npz", a=np.array([{}], dtype=object))
    for name in ("text.npz", "array.npy", "other.npz", "pickled.npz"):
        with pytest.raises(TakeError, match="not a take"):
            load_take(tmp_path / name)


def resaved(path, **changes):
    with np.load(path) as file:
        arrays = dict(file)
    arrays.update(changes)
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": np.array("fusecap take 99")}, "fusecap take 99"),
        ({"theta": np.zeros((2, 3))}, "theta is"),
        ({"theta": None}, "'theta'"),
        ({"provenance": np.array("{")}, "take.npz"),
        ({"rate_hz": np.array("fast")}, "take.npz"),
    ],
)
def test_take_with_wrong_content_is_refused(tmp_path, take, changes, message):
    path = tmp_path / "take.npz"
    save_take(take, path)
    resaved(path, **changes)
    with pytest.raises(TakeError, match=message):
        load_take(path)


def test_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "take.npz"
    path.write_bytes(b"old")

    def fill_the_disk():
        with written_whole(path) as file:
            file.write(b"half of the new")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(TakeError, match="No space left"):
        fill_the_disk()
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_place_that_cannot_be_written_is_said_so(tmp_path, take):
    (tmp_path / "file").write_text("")
    with pytest.raises(TakeError, match="cannot write"):
        save_take(take, tmp_path / "file" / "take.npz")


def test_unknown_subject_names_the_nearest(take):
    with pytest.raises(TakeError, match="did you mean 'anna'"):
        take.subject("ana")


# In its file


@pytest.mark.parametrize("packed", ["as saved", "deflated", "columns first"])
def test_frames_in_the_file_are_those_of_the_whole(tmp_path, take, packed):
    path = tmp_path / "take.npz"
    take.tracked[1, 2] = False
    save_take(take, path)
    if packed != "as saved":
        arrays = dict(np.load(path))
        if packed == "columns first":
            arrays |= {name: np.asfortranarray(arrays[name]) for name in MOTION}
        (np.savez_compressed if packed == "deflated" else np.savez)(path, **arrays)
    whole = load_take(path)
    with StoredTake(path) as stored:
        stored.check()
        for part, expected in (
            (stored.of_frames(1, 3), whole.of_frames(1, 3)),
            (stored.of_frames(2, 99), whole.of_frames(2, 99)),
            (stored.at_frames([0, 2]), whole.at_frames([0, 2])),
            (stored.at_frames([0, 1, 3]), whole.at_frames([0, 1, 3])),
            (stored.at_frames([]), whole.at_frames([])),
            (
                stored.of_subjects([1, 0]).of_subjects([0]).of_frames(1, 3),
                whole.of_subjects([1]).of_frames(1, 3),
            ),
        ):
            assert part.subject_names == expected.subject_names
            for name in ("timestamps_ns", "tracked", *MOTION):
                np.testing.assert_array_equal(getattr(part, name), getattr(expected, name))
        assert stored.subject_names == whole.subject_names and stored.skeleton == whole.skeleton
        np.testing.assert_array_equal(stored.time_s, whole.time_s)


def test_what_is_wrong_far_inside_is_found_without_reading_all_at_once(tmp_path):
    take = take_of(np.zeros((1, 20_000, PAPER21.pose_size)), [person()], names=("anna",))
    path = tmp_path / "take.npz"
    save_take(take, path)
    with np.load(path) as archive:
        arrays = dict(archive)
    arrays["theta"][0, 19_000, 5] = 1e9
    np.savez(path, **arrays)
    del arrays
    tracemalloc.start()
    try:
        with StoredTake(path) as stored:
            stored.of_frames(0, 10)
            with pytest.raises(TakeError, match=r"take\.npz: theta of"):
                stored.check()
        assert tracemalloc.get_traced_memory()[1] < 0.5 * path.stat().st_size
    finally:
        tracemalloc.stop()


def test_a_take_that_is_cut_while_it_is_open_is_an_error(tmp_path, take):
    path = tmp_path / "take.npz"
    save_take(take, path)
    with StoredTake(path) as stored:
        os.truncate(path, 500)
        with pytest.raises(TakeError, match="became shorter"):
            stored.at_frames([0])
