import datetime
import json
import pickle
import tarfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import savemat

import dataset_files as made
from fusecap.body.pose import forward_kinematics
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.cli import main
from fusecap.errors import InputError
from fusecap.evaluate.datasets import human36m, matlab, panoptic, shelf, total_capture
from fusecap.evaluate.datasets.dip import load_dip
from fusecap.evaluate.datasets.safe_pickle import load_pickle
from fusecap.evaluate.datasets.score import mean_by_name, score_table, score_truth
from fusecap.evaluate.datasets.shelf import score_people
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.simulated_session import write_session
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from motions import person, take_of


def command(monkeypatch, capsys, *arguments):
    """Exit code, and the JSON on stdout."""
    monkeypatch.setattr("sys.argv", ["fusecap", *map(str, arguments), "--json"])
    with pytest.raises(SystemExit) as ended:
        main()
    return ended.value.code, json.loads(capsys.readouterr().out)


# Total Capture


@pytest.mark.parametrize(("turn_deg", "aux"), [(180.0, False), (0.0, True)])
def test_total_capture_comes_in_our_conventions(tmp_path, turn_deg, aux):
    theta = made.total_capture(tmp_path, turn_deg=turn_deg, aux=aux)
    (sequence,) = total_capture.list_sequences(tmp_path)
    assert sequence.key == "S1 acting1"
    recording = total_capture.load_sequence(sequence, skeleton=EXTENDED23)
    position, rotation = forward_kinematics(person(1.7, EXTENDED23), theta)
    frames = made.FRAMES - 1
    assert recording.frames == frames
    assert "frames differ" in recording.notes[0]
    rows = [EXTENDED23.bone(name) for name in recording.truth.names]
    assert len(rows) == 21
    assert np.allclose(recording.truth.points_in_world_m[0], position[:frames, rows], atol=1e-6)
    assert np.allclose(recording.truth.rotation_in_world[0], rotation[:frames, rows], atol=1e-5)
    (model,) = recording.subjects
    reading = recording.readings(5)["S1"]
    assert np.allclose(
        reading.bone_rotation_in_world, rotation[5, list(model.sites.bone)], atol=1e-5
    )
    assert np.allclose(reading.accel_in_world_m_s2, 0.0, atol=1e-5)
    assert np.allclose(model.shape.offsets_m, person(1.7, EXTENDED23).offsets_m, atol=1e-3)
    camera, true = recording.rig["cam3"], made.rig(8)["cam3"]
    assert np.allclose(camera.packed, true.packed)
    assert recording.detections(4).people[7].shape == (1, 25, 3)


def test_total_capture_is_solved_and_scored(tmp_path, monkeypatch, capsys):
    made.total_capture(tmp_path / "data")
    code, table = command(
        monkeypatch, capsys, "evaluate", "totalcapture", tmp_path / "data",
        "--sequences", "S1 acting1", "--out", tmp_path / "out",
    )  # fmt: skip
    assert code == 0
    row = dict(zip(table["columns"], table["rows"][0], strict=True))
    assert row["found %"] == 100.0
    assert row["position mm"] < 60.0
    assert (tmp_path / "out" / "totalcapture.csv").is_file()


def changed(path, old, new, count=1):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("S1/acting1/gt_skel_gbl_pos.txt", "Spine3", "Spein", "expected the 21 of Total Capture"),
        ("S1/acting1/gt_skel_gbl_pos.txt", "0\t", "0 3.0\t", "64 numbers, expected 63"),
        ("S1/acting1/gt_skel_gbl_ori.txt", "Hips\tSpine\t", "Spine\tHips\t", "joints differ"),
        ("S1/imu/s1_acting1_Xsens.sensors", "13 12", "12 12", "expected '13 <frames>'"),
        ("S1/imu/s1_acting1_Xsens.sensors", "R_Foot ", "R_Fuss ", "expected a sensor's name"),
        ("S1/imu/s1_acting1_calib_imu_ref.txt", "L_Foot", "L_Fuss", "expected Name x y z w"),
        ("calibration.cal", "8 1", "9 1", "numbers; expected 191 for 9 cameras"),
        ("calibration.cal", "0 1079", "zero 1079", "found 'zero', expected a number"),
    ],
)
def test_garbled_total_capture_says_where(tmp_path, file, old, new, message):
    made.total_capture(tmp_path)
    changed(tmp_path / file, old, new)
    with pytest.raises(InputError, match=message):
        total_capture.load_sequence(total_capture.list_sequences(tmp_path)[0])


def test_quaternions_in_the_wrong_order_are_noticed(tmp_path):
    made.total_capture(tmp_path)
    path = tmp_path / "S1" / "acting1" / "gt_skel_gbl_ori.txt"
    names, xyzw = total_capture._read_skeleton(path, 4)
    assert len(names) == 21
    made.write_skeleton(path, np.roll(xyzw, 1, axis=2))
    with pytest.raises(InputError, match="in the frame of the hips the left is"):
        total_capture.load_sequence(total_capture.list_sequences(tmp_path)[0])


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        ("S1/imu/s1_acting1_Xsens.sensors", "no <sequence>_Xsens.sensors"),
        ("calibration.cal", "no calibration.cal"),
        ("S1/acting1/gt_skel_gbl_ori.txt", "gt_skel_gbl_ori.txt: no such file"),
        ("S1/acting1/gt_skel_gbl_pos.txt", "no gt_skel_gbl_pos.txt below"),
    ],
)
def test_missing_total_capture_file_is_named(tmp_path, missing, message):
    made.total_capture(tmp_path)
    (tmp_path / missing).unlink()
    with pytest.raises(InputError, match=message):
        total_capture.load_sequence(total_capture.list_sequences(tmp_path)[0])


def test_sensor_file_that_ends_early_gives_its_whole_frames(tmp_path):
    made.total_capture(tmp_path)
    path = tmp_path / "S1" / "imu" / "s1_acting1_Xsens.sensors"
    path.write_text("\n".join(path.read_text().splitlines()[: 1 + 14 * 5 + 3]))
    assert total_capture.read_sensors(path)[0].shape == (5, 13, 4)


# Human3.6M


@pytest.mark.parametrize("packed", [False, True])
def test_human36m_comes_in_our_world(tmp_path, packed):
    points = made.human36m(tmp_path, packed=packed)
    takes = human36m.list_takes(tmp_path)
    # S11's damaged take is left out.
    assert [f"{t.subject} {t.action}" for t in takes] == [
        "S9 Directions", "S9 Directions 1", "S9 Sitting", "S11 Directions 1", "S11 Sitting",
    ]  # fmt: skip
    assert {take.activity for take in takes} == {"Directions", "Sitting"}
    recording = human36m.load_take36(tmp_path, takes[0])
    assert np.allclose(recording.truth.points_in_world_m[0], points, atol=1e-5)
    (seen,) = recording.detections(3).people[2]
    camera = recording.rig.cameras[2]
    nose = human36m.H36M17.landmark_names.index("nose")
    assert np.allclose(camera.project(points[3, [nose]])[0], seen[0, :2], atol=0.05)


def test_human36m_table_averages_the_takes_of_an_activity(tmp_path, monkeypatch, capsys):
    made.human36m(tmp_path / "data", actions=("Directions 1", "Directions 2"))
    for flags in ((), ("--monocular",)):
        code, table = command(
            monkeypatch, capsys, "evaluate", "human36m", tmp_path / "data",
            "--actions", "S9 Directions 1,S9 Directions 2", "--out", tmp_path / "out", *flags,
        )  # fmt: skip
        assert code == 0
        assert [row[0] for row in table["rows"]] == ["Directions"]


def test_human36m_cameras_of_the_data_set(data_dir):
    rig = human36m.read_rig(data_dir / "format_samples" / "h36m_cameras_28.json", "S9")
    assert set(rig.names) == set(human36m.SIZES_PX)
    heights = [camera.position_in_world[1] for camera in rig.cameras]
    assert 1.2 < min(heights) < max(heights) < 1.9
    middle = np.array([[0.0, 1.0, 0.0]])
    assert all(np.isfinite(camera.project(middle)).all() for camera in rig.cameras)


def test_human36m_without_truth_says_what_is_expected(tmp_path):
    made.human36m(tmp_path, actions=("Sitting",))
    np.save(tmp_path / "positions" / "S9" / "Sitting.npy", np.zeros((5, 17, 3)))
    with pytest.raises(InputError, match=r"expected frames x 32 x 3"):
        human36m.load_take36(tmp_path, human36m.list_takes(tmp_path)[0])
    with pytest.raises(InputError, match=r"neither data_3d_h36m.npz nor positions"):
        human36m.list_takes(tmp_path / "keypoints")


# Panoptic


def test_panoptic_comes_in_our_world_and_is_scored(tmp_path, monkeypatch, capsys):
    points = made.panoptic(tmp_path / "band")
    recording = panoptic.load_panoptic(tmp_path / "band")
    assert np.allclose(recording.truth.points_in_world_m, points, atol=1e-6)
    assert np.allclose(recording.rig.cameras[1].packed, made.rig(4).cameras[1].packed)
    code, table = command(
        monkeypatch, capsys, "evaluate", "panoptic", tmp_path / "band", "--out", tmp_path / "out"
    )
    row = dict(zip(table["columns"], table["rows"][0], strict=True))
    assert (code, row["switches"]) == (0, 0)
    assert row["found %"] > 60.0
    assert row["position mm"] < 80.0


def test_panoptic_joint_without_confidence_is_unknown(tmp_path):
    made.panoptic(tmp_path)
    path = tmp_path / "hdPose3d_stage1_coco19" / "body3DScene_00000002.json"
    data = json.loads(path.read_text())
    data["bodies"][0]["joints19"][3] = -1.0
    path.write_text(json.dumps(data))
    truth = panoptic.read_poses(tmp_path)
    assert np.isnan(truth.points_in_world_m[0, 2, 0]).all()
    path.write_text(path.read_text()[:100])
    with pytest.raises(InputError, match=r"body3DScene_00000002.json: not valid JSON"):
        panoptic.read_poses(tmp_path)


@pytest.mark.parametrize(("name", "people"), [("160906_band1", 7), ("160906_band2", 3)])
def test_panoptic_samples_of_the_data_set(data_dir, name, people):
    folder = data_dir / "format_samples" / "panoptic" / name
    truth = panoptic.read_poses(folder)
    assert len(truth.points_in_world_m) <= people
    known = truth.points_in_world_m[np.isfinite(truth.points_in_world_m).all(axis=-1)]
    assert len(known)
    # People stand on the floor under a roof of a few metres.
    assert -0.2 < known[:, 1].min() < 0.5 < known[:, 1].max() < 2.2
    rig = panoptic.read_rig(folder)
    assert np.median([camera.position_in_world[1] for camera in rig.cameras]) > 0.5
    with pytest.raises(InputError, match="no folder of keypoints"):
        panoptic.load_panoptic(folder)


# Shelf and Campus


def write_actors(path, actors):
    """`actor3D` as the data set nests it: {actor} -> (T, 1) cells -> 14 x 3, or a lone zero."""
    cells = np.empty((1, len(actors)), dtype=object)
    for row, frames in enumerate(actors):
        column = np.empty((len(frames), 1), dtype=object)
        for frame, joints in enumerate(frames):
            column[frame, 0] = np.zeros((1, 1)) if joints is None else joints
        cells[0, row] = column
    savemat(path, {"actor3D": cells})


def test_actors_of_a_mat_file(tmp_path, rng):
    joints = rng.standard_normal((14, 3))
    write_actors(tmp_path / "actorsGT.mat", [[joints, None, joints], [None, None, joints]])
    points = shelf.load_shelf_truth(tmp_path).points_in_world_m
    assert points.shape == (2, 3, 15, 3)
    assert np.allclose(points[0, 0, :14], joints @ Y_UP_FROM_Z_UP.T)
    assert np.allclose(points[0, 0, 14], (points[0, 0, 2] + points[0, 0, 3]) / 2)
    assert np.isnan(points[0, 1]).all() and np.isnan(points[1, 0]).all()


def test_garbled_mat_file_is_refused(tmp_path):
    path = tmp_path / "actorsGT.mat"
    with pytest.raises(InputError, match=r"0 gt_.*expected one truth file"):
        shelf.load_shelf_truth(tmp_path)
    path.write_bytes(b"MATLAB" + bytes(40))
    with pytest.raises(InputError, match="not a MATLAB 5 file"):
        shelf.load_shelf_truth(tmp_path)
    savemat(path, {"other": np.zeros(3)})
    with pytest.raises(InputError, match="holds no actor3D"):
        shelf.load_shelf_truth(tmp_path)
    write_actors(path, [[np.zeros((12, 3))] * 3])
    with pytest.raises(InputError, match=r"joints \(12, 3\), expected 14 x 3"):
        shelf.load_shelf_truth(tmp_path)


def test_a_mat_file_that_ends_its_reader_is_a_message(tmp_path, rng, monkeypatch):
    path = tmp_path / "actorsGT.mat"
    write_actors(path, [[rng.standard_normal((14, 3))]])
    monkeypatch.setattr(matlab, "MOST_S", 0.01)
    with pytest.raises(InputError, match=r"actorsGT\.mat: not read within"):
        shelf.load_shelf_truth(tmp_path)
    monkeypatch.undo()
    dies = "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n"
    (tmp_path / "scipy").mkdir()
    (tmp_path / "scipy" / "__init__.py").write_text(dies)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match=r"actorsGT\.mat: not a MATLAB 5 file, or damaged"):
        shelf.load_shelf_truth(tmp_path)


@pytest.mark.parametrize(("name", "cameras", "actors"), [("shelf", 5, 4), ("campus", 3, 3)])
def test_shelf_and_campus_samples(data_dir, name, cameras, actors):
    folder = data_dir / "format_samples" / "shelf_campus_voxelpose_format"
    rig = shelf.read_voxelpose_rig(folder / f"calibration_{name}.json")
    truth = shelf.read_actors(folder / f"{name}_actorsGT_3frames.mat").points_in_world_m
    assert (len(rig), truth.shape) == (cameras, (actors, 3, 15, 3))
    known = truth[np.isfinite(truth).all(axis=(-1, -2))]
    assert -0.3 < known[..., 1].min() < 0.4 < 1.3 < known[..., 1].max() < 2.2
    # Everyone is in the image of most cameras.
    for person_points in known:
        inside = 0
        for camera in rig.cameras:
            pixels = camera.project(person_points)
            inside += bool(np.all((pixels > 0) & (pixels < camera.size_px)))
        assert inside >= cameras // 2


def test_voxelpose_calibration_agrees_with_shelf_s_own(data_dir):
    folder = data_dir / "format_samples" / "shelf_campus_voxelpose_format"
    ours = shelf.read_rig(data_dir / "shelf")
    theirs = shelf.read_voxelpose_rig(folder / "calibration_shelf.json")
    for a, b in zip(ours.cameras, theirs.cameras, strict=True):
        assert np.allclose(a.position_in_world, b.position_in_world, atol=0.01)
        assert np.allclose(a.matrix, b.matrix, atol=1.0)


@pytest.mark.real_data
def test_shelf_is_evaluated_from_its_folder(data_dir, tmp_path, monkeypatch, capsys):
    with tarfile.open(data_dir / "shelf" / "openpose_body25.tar.xz") as tar:
        for member in tar:
            if any(f"_{frame:012d}_" in member.name for frame in range(40)):
                tar.extract(member, tmp_path, filter="data")
    for name in ("calibs", "gt_frames_000_149.txt"):
        (tmp_path / name).symlink_to(data_dir / "shelf" / name)
    truth = shelf.load_shelf_truth(tmp_path)
    recording = shelf.load_shelf(tmp_path)
    first = replace(truth, points_in_world_m=truth.points_in_world_m[:, :40])
    score = score_people(recording.solve(), first)
    assert score.pcp > 93.0
    code, _ = command(monkeypatch, capsys, "evaluate", "shelf", tmp_path, "--out", tmp_path / "o")
    assert code == 0


# Pickles


class Evil:
    def __reduce__(self):
        return (exec, ("raise SystemExit('run')",))


@pytest.mark.parametrize("protocol", range(2, 6))
def test_pickled_arrays_come_back(tmp_path, rng, protocol):
    value = {
        "ori": rng.standard_normal((3, 17, 3, 3)),
        "fortran": np.asfortranarray(rng.standard_normal((3, 4))),
        "single": np.float32(1.5),
        "names": ["a", b"b", (1, 2.5, None, True)],
        "objects": np.array([{"x": np.arange(3)}, None], dtype=object),
    }
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(value, protocol=protocol))
    again = load_pickle(path)
    assert np.array_equal(again["ori"], value["ori"])
    assert np.array_equal(again["fortran"], value["fortran"])
    assert again["single"] == 1.5
    assert again["names"] == value["names"]
    assert again["objects"][0]["x"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("value", [Evil(), datetime.date(2020, 1, 1), {"a": [Evil()]}, print])
def test_pickle_that_names_anything_else_is_refused(tmp_path, value):
    path = tmp_path / "data.pkl"
    path.write_bytes(pickle.dumps(value))
    with pytest.raises(InputError, match="it is refused, for it could run any code"):
        load_pickle(path)


def test_array_cannot_ask_for_more_memory_than_the_file_has(tmp_path):
    path = tmp_path / "data.pkl"
    huge = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(J\xff\xff\xff\x7ft"
    path.write_bytes(b"\x80\x02" + huge + b"U\x01btR.")
    assert load_pickle(path).size == 0


SHORT_DTYPE = (
    b"\x80\x02cnumpy\ndtype\nX\x02\x00\x00\x00f8\x89\x88\x87R(K\x03X\x01\x00\x00\x00N"
    b"NJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb."
)
"""A dtype's state with too few entries, over which NumPy ends the process."""
FAR_MEMO = b"\x80\x02}r\x10\x10\x28\x4b."
"""Remembers a value as the 1,260,916,752nd, for which the unpickler in C allots 20 GB."""


def test_a_memory_of_billions_of_values_costs_nothing(tmp_path):
    path = tmp_path / "data.pkl"
    path.write_bytes(FAR_MEMO)
    assert load_pickle(path) == {}


@pytest.mark.parametrize(
    "content",
    [
        *(b"", b"not a pickle", pickle.dumps(np.zeros(100))[:60], SHORT_DTYPE),
        pickle.dumps(np.zeros(4), 2).replace(b"K\x04\x85", b"K\x05\x85"),
        pickle.dumps(np.zeros(4, [("a", "f8")])),
    ],
)
def test_garbled_pickle_is_no_crash(tmp_path, content):
    path = tmp_path / "data.pkl"
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a pickle of arrays, or cut short"):
        load_pickle(path)


# DIP


def write_dip(path, data):
    path.write_bytes(pickle.dumps(data, protocol=2))
    return path


@pytest.mark.parametrize("flat", [False, True])
def test_dip_comes_in_our_conventions(tmp_path, flat):
    data, rotation = made.dip()
    if flat:
        data = {
            "ori": data["imu_ori"].reshape(30, -1),
            "acc": data["imu_acc"].reshape(30, -1)[:-2],
            "poses": data["gt"].reshape(30, 24, 3),
        }
    recording = load_dip(write_dip(tmp_path / "05.pkl", data))
    assert recording.frames == (28 if flat else 30)
    assert bool(recording.notes) == flat
    rows = [PAPER21.bone(name) for name in recording.truth.names]
    true = rotation[: recording.frames, rows]
    assert np.allclose(recording.truth.rotation_in_world[0], true, atol=1e-6)
    (model,) = recording.subjects
    measured = recording.readings(7)["05"].bone_rotation_in_world
    assert np.allclose(measured, rotation[7, list(model.sites.bone)])
    score = score_truth(recording.solve(), recording.truth, recording.rate_hz)
    assert score.found_share == 1.0
    assert score.orientation_error_deg.mean < 12.0
    assert score.position_error_mm.count == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gt": None}, "gt cannot be read as frames x sensors x 3"),
        ({"imu_ori": np.zeros((5, 16, 3, 3))}, "orientations of 16 .*expected 17"),
        ({"gt": np.zeros((5, 66))}, "poses of 22 joints, expected SMPL's 24"),
    ],
)
def test_garbled_dip_says_what_is_wrong(tmp_path, change, message):
    data = {**made.dip(5)[0], **change}
    with pytest.raises(InputError, match=message):
        load_dip(write_dip(tmp_path / "a.pkl", data))


def test_dip_without_a_key_lists_what_is_there(tmp_path):
    data = made.dip(5)[0]
    del data["imu_acc"]
    with pytest.raises(InputError, match="no imu_acc or acc; it holds gt, imu_ori"):
        load_dip(write_dip(tmp_path / "a.pkl", data))


# Scores


def test_truth_against_itself_has_no_error():
    theta = made.motion(person())
    take = take_of(theta[None], [person()], names=("a",))
    position, rotation = forward_kinematics(person(), theta)
    truth = total_capture.BoneTruth(
        names=PAPER21.bone_names, points_in_world_m=position[None], rotation_in_world=rotation[None]
    )
    score = score_truth(take, truth, 60.0)
    assert score.position_error_mm.mean < 1e-6
    assert score.orientation_error_deg.mean < 1e-5
    moved = replace(truth, points_in_world_m=position[None] + [0.03, 0.0, 0.04])
    score = score_truth(take, moved, 60.0)
    assert score.position_error_mm.mean == pytest.approx(50.0)
    assert score.root_relative_error_mm.mean == pytest.approx(0.0, abs=1e-6)


def test_table_has_means_and_means_by_name():
    theta = made.motion(person())
    take = take_of(theta[None], [person()], names=("a",))
    position, rotation = forward_kinematics(person(), theta)
    scores = []
    for name, away in (("walk", 0.01), ("walk", 0.03), ("sit", 0.05)):
        truth = total_capture.BoneTruth(
            names=PAPER21.bone_names,
            points_in_world_m=position[None] + [away, 0.0, 0.0],
            rotation_in_world=rotation[None],
        )
        scores.append((name, score_truth(take, truth, 60.0)))
    table = score_table("test", scores)
    assert [row[0] for row in table.rows] == ["walk", "walk", "sit", "mean"]
    assert table.rows[-1][1] == pytest.approx(30.0)
    averaged = mean_by_name(table)
    assert [row[:2] for row in averaged.rows] == [
        ("walk", pytest.approx(20.0)), ("sit", pytest.approx(50.0)), ("mean", pytest.approx(35.0)),
    ]  # fmt: skip


# Sessions


def test_session_with_truth_is_evaluated(tmp_path, monkeypatch, capsys):
    write_session(demo_scene(seconds=0.5), tmp_path)
    code, table = command(
        monkeypatch, capsys, "evaluate", "session", tmp_path, "--out", tmp_path / "out"
    )
    assert code == 0
    assert "simulated" in table["title"]
    figures = {row[0]: row[1] for row in table["rows"]}
    assert figures["position error mm"] < 40.0
    (tmp_path / "truth.npz").unlink()
    code, error = command(monkeypatch, capsys, "evaluate", "session", tmp_path)
    assert code == 1
    assert "no such file; expected a take" in error["error"]
