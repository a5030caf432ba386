"""Every format, opened by the ecosystem's own reader: two people, within 1 mm and 0.1 degrees."""

import json
import os
import shutil
import struct
import subprocess
import sys
import warnings
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import fusecap
from export_people import (
    NEAR_DEG,
    NEAR_M,
    READERS,
    degrees_apart,
    environment,
    run_reader,
    two_walkers,
    with_gap,
)
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.pose import landmarks_in_world
from fusecap.body.rigs import PRESETS
from fusecap.body.shape import shape_with_clavicles
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.cli import app
from fusecap.errors import InputError, TakeError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.exports import fbx_motion
from fusecap.exports.fbx_motion import NodeMotion
from fusecap.exports.fbx_tree import FbxElement, FbxFile, array_property, text_property
from fusecap.exports.formats import FORMATS, format_named
from fusecap.exports.gltf import Gltf
from fusecap.exports.gltf_people import add_body, add_joints
from fusecap.exports.markers import bone_markers
from fusecap.exports.opensim import OPENSIM_FROM_OURS
from fusecap.exports.rest_rig import rest_rig
from fusecap.exports.rig_motion import rig_motion
from fusecap.exports.take_files import export_take, plan_files
from fusecap.exports.take_format import ExportOptions
from fusecap.feet import foot_events, standing
from fusecap.geometry.camera import Rig
from fusecap.sources.imu_files.formats.sto import FORMAT as STO
from fusecap.stored_take import StoredTake, load_take
from fusecap.take import BLOCK, save_take
from motions import person, take_of, walk

ODD_NAMES = ('a,b/"c" 100%s', "Zoë 🙂")


@pytest.mark.parametrize("names", [("anna", "ben"), ODD_NAMES])
def test_pandas_reads_the_tidy_table(tmp_path, names):
    pandas = pytest.importorskip("pandas")
    take = with_gap(two_walkers(names=names), [3, 4])
    (path,) = export_take(take, tmp_path, format="csv", stem="t")
    table = pandas.read_csv(path)
    assert len(table) == (40 * 2 - 2) * 21
    assert set(table["frame"][table["person"] == names[0]]) == set(range(40)) - {3, 4}
    for row, name in enumerate(names):
        mine = table[table["person"] == name]
        tracked = take.tracked[row]
        assert mine["bone"].tolist() == list(take.bone_names) * tracked.sum()
        places = mine[["x_m", "y_m", "z_m"]].to_numpy().reshape(-1, 21, 3)
        assert np.abs(places - take.bone_position_in_world_m[row, tracked]).max() < NEAR_M
        turns = mine[["qw", "qx", "qy", "qz"]].to_numpy().reshape(-1, 21, 4)
        turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
        true = take.bone_rotation_in_world_wxyz[row, tracked]
        assert degrees_apart(turns, true) < NEAR_DEG
        times = mine["time_s"].to_numpy().reshape(-1, 21)[:, 0]
        assert np.abs(times - take.time_s[tracked]).max() < 1e-6


@pytest.mark.parametrize("rig", ["native", "unity", "ue5"])
def test_numpy_arrays_chain_to_the_take(tmp_path, rig):
    take = two_walkers()
    (path,) = export_take(take, tmp_path, format="npz", stem="t", rig=rig)
    with np.load(path, allow_pickle=False) as arrays:
        names, parents = arrays["joint_names"].tolist(), arrays["parents"].tolist()
        head = {"native": "head", "unity": "Head", "ue5": "head"}[rig]
        foot = {"native": "left_foot", "unity": "LeftFoot", "ue5": "foot_l"}[rig]
        for row in range(2):
            places, turns = chained(
                parents,
                arrays["position_m"][row].astype(float),
                arrays["rotation_xyzw"][row].astype(float),
            )
            rest = Rotation.from_quat(arrays["rest_rotation_xyzw"][row])
            for joint, bone in ((head, "head"), (foot, "left_foot")):
                index, ours = names.index(joint), take.skeleton.bone(bone)
                true = take.bone_position_in_world_m[row, :, ours]
                assert np.abs(places[index] - true).max() < NEAR_M
                at_rest = rest_rig(PRESETS[rig], shape_with_clavicles(take.shape(row)))
                of_bone = Rotation.from_matrix(at_rest.rest_of(bone))
                turned = (turns[index] * rest[index].inv() * of_bone).as_quat()
                true = np.roll(take.bone_rotation_in_world_wxyz[row, :, ours], -1, axis=-1)
                assert degrees_apart(turned, true) < NEAR_DEG


def chained(parents, position_m, xyzw) -> tuple[list[np.ndarray], list[Rotation]]:
    """Places and turns in the world of every joint, from those in the parents."""
    places, turns = [], []
    for joint, parent in enumerate(parents):
        turn = Rotation.from_quat(xyzw[:, joint])
        if parent < 0:
            places.append(position_m[:, joint])
            turns.append(turn)
        else:
            places.append(places[parent] + turns[parent].apply(position_m[:, joint]))
            turns.append(turns[parent] * turn)
    return places, turns


def test_arrays_are_never_written_over_a_take(tmp_path):
    take = two_walkers(2)
    save_take(take, tmp_path / "t.npz")
    with pytest.raises(TakeError, match=r"t.npz is a take: export to another name"):
        fusecap.export(take, tmp_path / "t.npz")
    assert fusecap.export(take, tmp_path / "u.npz") == [tmp_path / "u.npz"]
    assert fusecap.export(take, tmp_path / "u.npz") == [tmp_path / "u.npz"]
    assert fusecap.load_take(tmp_path / "t.npz").subject_names == take.subject_names


def opensim_files(take, folder) -> list[list[Path]]:
    """Per person the model, its markers, angles and orientations."""
    formats = ("osim", "trc", "mot", "sto")
    return list(
        map(
            list,
            zip(*(export_take(take, folder, format=f, stem="t") for f in formats), strict=True),
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
def test_opensim_finds_the_angles_by_inverse_kinematics(tmp_path, skeleton):
    python = environment("FUSECAP_OPENSIM_PYTHON", "opensim")
    take = two_walkers(30, skeleton=skeleton, names=("anna", "Zoë 🙂"))
    for row, files in enumerate(opensim_files(take, tmp_path)):
        out = tmp_path / f"{row}.npz"
        assert run_reader(python, "opensim_ik.py", *files, out)["frames"] == 30
        with np.load(out) as found:
            rotational = found["rotational"]
            apart = np.abs(found["ik"] - found["mot"])
            assert apart[:, rotational].max() < NEAR_DEG and apart[:, ~rotational].max() < NEAR_M
            assert np.abs(found["in_file"] - found["in_model"]).max() < NEAR_M
            assert degrees_apart(found["turn_file"], found["turn_model"]) < NEAR_DEG
            true = marker_places(take, row) @ OPENSIM_FROM_OURS.T
            assert np.abs(found["in_model"] - true).max() < NEAR_M


def marker_places(take, row) -> np.ndarray:
    points = bone_markers(take.shape(row))
    return landmarks_in_world(
        take.bone_position_in_world_m[row],
        take.bone_rotation_in_world(row),
        np.array([take.skeleton.bone(bone) for _, bone, _ in points]),
        np.array([at for _, _, at in points]),
    )


@pytest.mark.parametrize(("unit", "unit_m"), [("mm", 1e-3), ("m", 1.0)])
def test_trc_says_its_unit_and_leaves_gaps_empty(tmp_path, unit, unit_m):
    take = with_gap(two_walkers(6), [2])
    anna, ben = export_take(take, tmp_path, format="trc", stem="t", unit=unit)
    for row, path in enumerate((anna, ben)):
        lines = path.read_text().split("\n")
        head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
        assert head["Units"] == unit and head["NumFrames"] == "6" and head["DataRate"] == "60"
        names = lines[3].split("\t")[2::3]
        assert len(names) == int(head["NumMarkers"]) and "left_knee" in names
        cells = [line.split("\t") for line in lines[6:-1]]
        assert [c[0] for c in cells] == [str(n) for n in range(1, 7)]
        assert {len(c) for c in cells} == {2 + 3 * len(names)}
        empty = [not any(c[2:]) for c in cells]
        assert empty == [row == 0 and frame == 2 for frame in range(6)]
        values = unit_m * np.array([c[2:] for c in cells if c[2]], dtype=float)
        true = marker_places(take, row)[take.tracked[row]] @ OPENSIM_FROM_OURS.T
        assert np.abs(values.reshape(true.shape) - true).max() < NEAR_M


def test_our_own_opensense_reader_takes_the_orientations_back(tmp_path):
    take = with_gap(two_walkers(20), [7])
    path = export_take(take, tmp_path, format="sto", stem="t")[0]
    track = STO.read(path, "pelvis_imu", None)
    turn = Rotation.from_matrix(OPENSIM_FROM_OURS)
    ours = Rotation.from_quat(
        np.roll(take.bone_rotation_in_world_wxyz[0, take.tracked[0], 0], -1, axis=-1)
    )
    expected = np.roll((turn * ours * turn.inv()).as_quat(), 1, axis=-1)
    assert len(track.times_s) == 19
    assert degrees_apart(track.orientation_wxyz, expected) < NEAR_DEG


def test_a_bent_knee_and_a_raised_thigh_are_positive_on_both_sides(tmp_path):
    shape = person()
    theta = np.zeros((1, 2, 66))
    for side in ("left", "right"):
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_thigh")] = -np.radians(30)
        theta[0, :, 3 + 3 * PAPER21.bone(f"{side}_shank")] = np.radians(50)
    (path,) = export_take(take_of(theta, [shape], names=("a",)), tmp_path, format="mot", stem="t")
    lines = path.read_text().splitlines()
    first = lines.index("endheader") + 1
    values = dict(
        zip(lines[first].split("\t"), map(float, lines[first + 1].split("\t")), strict=True)
    )
    for side in "lr":
        assert values[f"hip_flexion_{side}"] == pytest.approx(30)
        assert values[f"knee_angle_{side}"] == pytest.approx(50)
        assert values[f"arm_add_{side}"] == pytest.approx(-90)


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
def test_both_c3d_readers_find_points_rotations_and_gaps(tmp_path, skeleton):
    ezc3d, c3d = pytest.importorskip("ezc3d"), pytest.importorskip("c3d")
    take = with_gap(two_walkers(30, skeleton=skeleton, names=ODD_NAMES), [4, 5])
    for row, path in enumerate(export_take(take, tmp_path, format="c3d", stem="t")):
        tracked = take.tracked[row]
        read = ezc3d.c3d(str(path))
        point = read["parameters"]["POINT"]
        assert point["UNITS"]["value"] == ["mm"] and point["RATE"]["value"] == [60]
        assert (point["X_SCREEN"]["value"], point["Y_SCREEN"]["value"]) == (["+X"], ["+Y"])
        missing = np.isnan(read["data"]["points"][0]).T
        assert np.array_equal(missing, np.tile(~tracked[:, None], missing.shape[1]))
        turn = read["data"]["rotations"].transpose(3, 2, 0, 1)[tracked]
        assert read["parameters"]["ROTATION"]["LABELS"]["value"] == list(take.bone_names)
        true = take.bone_rotation_in_world(row)[tracked]
        assert np.abs(turn[..., :3, :3] - true).max() < 1e-4
        places = 1e-3 * turn[..., :3, 3]
        assert np.abs(places - take.bone_position_in_world_m[row, tracked]).max() < NEAR_M
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore", UserWarning)  # It knows no rotations.
            reader = c3d.Reader(file)
            frames = np.array([points for _, points, _ in reader.read_frames()])
            labels = [label.strip() for label in reader.point_labels]
        expected = marker_places(take, row)
        names = [name for name, _, _ in bone_markers(take.shape(row))]
        for index, label in enumerate(labels):
            at = 1e-3 * frames[tracked, index, :3]
            assert np.abs(at - expected[tracked, names.index(label)]).max() < NEAR_M
        assert (frames[~tracked, :, 3] == -1).all()


def test_c3d_tells_steps(tmp_path):
    ezc3d = pytest.importorskip("ezc3d")
    shape = person()
    theta = np.zeros((1, 120, 66))
    theta[:, :, 1] = shape.standing_root_height_m
    lifted = slice(40, 80)
    for bone, angle in (("thigh", -1.2), ("shank", 1.2)):
        theta[0, lifted, 3 + 3 * PAPER21.bone(f"left_{bone}")] = angle
    take = take_of(theta, [shape], names=("a",))
    assert standing(take, 0, "right").all() and not standing(take, 0, "left")[45:75].any()
    (path,) = export_take(take, tmp_path, format="c3d", stem="t")
    event = ezc3d.c3d(str(path))["parameters"]["EVENT"]
    assert event["LABELS"]["value"] == ["Foot Off", "Foot Strike"]
    assert event["CONTEXTS"]["value"] == ["Left", "Left"]
    times = event["TIMES"]["value"]
    assert np.allclose(times[0], 0) and np.allclose(times[1], [40 / 60, 80 / 60], atol=0.04)
    assert all(one.frame < other.frame for one, other in pairwise(foot_events(take, 0)))


def test_what_a_file_cannot_hold_goes_into_several(tmp_path, monkeypatch):
    ezc3d = pytest.importorskip("ezc3d")
    take = two_walkers(25).of_subjects([0])
    monkeypatch.setattr("fusecap.exports.formats.c3d.FORMAT", replaced_max(10))
    paths = export_take(take, tmp_path, format="c3d", stem="t")
    assert [p.name for p in paths] == [f"t_anna.part{n}.c3d" for n in (1, 2, 3)]
    counts = [ezc3d.c3d(str(p))["data"]["points"].shape[2] for p in paths]
    assert counts == [10, 10, 5]


def test_a_full_c3d_file_has_its_rotations_where_readers_find_them(tmp_path):
    """ezc3d, and others, take the number of their first block for a signed one of 16 bits."""
    ezc3d = pytest.importorskip("ezc3d")
    shape = person(1.7, EXTENDED23)
    rest = np.zeros((1, 1, EXTENDED23.pose_size))
    rest[..., 1] = shape.standing_root_height_m
    frames = format_named("c3d").max_frames
    assert frames
    theta = np.repeat(rest, frames, axis=1)
    theta[0, :, 0] = np.arange(frames) * 1e-4
    (path,) = export_take(
        take_of(theta, [shape], names=("anna",)), tmp_path, format="c3d", stem="t"
    )
    read = ezc3d.c3d(str(path))
    assert 0 < read["parameters"]["ROTATION"]["DATA_START"]["value"][0] < 1 << 15
    assert read["data"]["points"].shape[2] == read["data"]["rotations"].shape[3] == frames
    across_mm = read["data"]["rotations"][0, 3, 0]
    np.testing.assert_allclose(across_mm, 1e3 * theta[0, :, 0], atol=1e3 * NEAR_M)


def replaced_max(frames):
    return replace(format_named("c3d"), max_frames=frames)


def gltf_arrays(path):
    """The tree of a GLB, and a function that gives the values of an accessor."""
    pygltflib = pytest.importorskip("pygltflib")
    tree = pygltflib.GLTF2().load(str(path))
    blob = tree.binary_blob()
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
    kinds = {5126: np.float32, 5123: np.uint16, 5125: np.uint32}

    def values(index):
        accessor = tree.accessors[index]
        view = tree.bufferViews[accessor.bufferView]
        count = accessor.count * width[accessor.type]
        flat = np.frombuffer(blob, kinds[accessor.componentType], count, view.byteOffset)
        return flat.reshape(accessor.count, -1).astype(float)

    return tree, values


def gltf_motion(path):
    """Per person its joints' names, places (J, T, 3) and turns, as the animation plays."""
    tree, values = gltf_arrays(path)
    (animation,) = tree.animations
    frames = tree.accessors[animation.samplers[0].input].count
    parent = {child: at for at, node in enumerate(tree.nodes) for child in node.children or []}
    nodes = list(enumerate(tree.nodes))
    place = {n: np.tile(node.translation or [0, 0, 0], (frames, 1)) for n, node in nodes}
    turn = {n: np.tile(node.rotation or [0, 0, 0, 1], (frames, 1)) for n, node in nodes}
    for channel in animation.channels:
        moved = values(animation.samplers[channel.sampler].output)
        (turn if channel.target.path == "rotation" else place)[channel.target.node] = moved
    order = sorted(parent)
    found = {}
    for owner in (n for n, node in nodes if node.children and n not in parent):
        mine = [n for n in order if _under(n, owner, parent)]
        joints = {n: index for index, n in enumerate(mine)}
        parents = [joints.get(parent[n], -1) for n in mine]
        places, turns = chained(
            parents,
            np.stack([place[n] for n in mine], axis=1),
            np.stack([turn[n] for n in mine], axis=1),
        )
        found[tree.nodes[owner].name] = ([tree.nodes[n].name for n in mine], places, turns)
    return found


def _under(node, owner, parent) -> bool:
    while node in parent:
        node = parent[node]
    return node == owner


@pytest.mark.parametrize("skeleton", [PAPER21, EXTENDED23], ids=lambda s: s.name)
@pytest.mark.parametrize("rig", PRESETS)
def test_a_gltf_reader_finds_every_joint(tmp_path, rig, skeleton):
    take = with_gap(two_walkers(skeleton=skeleton, names=ODD_NAMES), [3])
    (path,) = export_take(take, tmp_path, format="glb", stem="t", rig=rig)
    found = gltf_motion(path)
    assert list(found) == list(ODD_NAMES)
    for row, (names, places, turns) in enumerate(found.values()):
        rest = rest_rig(PRESETS[rig], shape_with_clavicles(take.shape(row)))
        assert sorted(names) == sorted(rest.names)
        tracked = take.tracked[row]
        for joint in PRESETS[rig].joints:
            bone = joint.sits_at
            if joint.towards or bone not in take.bone_names or bone not in joint.turns_with:
                continue
            at = names.index(joint.name)
            index = take.skeleton.bone(bone)
            true = take.bone_position_in_world_m[row, tracked, index]
            assert np.abs(places[at][tracked] - true).max() < NEAR_M
            if len(joint.turns_with) == 1:
                of_rest = rest.rest_of(bone).T @ rest.rotation[rest.names.index(joint.name)]
                true = take.bone_rotation_in_world(row)[tracked, index] @ of_rest
                apart = (turns[at][tracked].inv() * Rotation.from_matrix(true)).magnitude()
                assert np.degrees(apart).max() < NEAR_DEG


def test_bodies_stand_around_the_joints_and_on_the_floor(tmp_path):
    take = two_walkers(2)
    (path,) = export_take(take, tmp_path, format="glb", stem="t")
    tree, values = gltf_arrays(path)
    assert len(tree.skins) == len(tree.meshes) == 2 and len(tree.animations) == 1
    for row, mesh in enumerate(tree.meshes):
        (primitive,) = mesh.primitives
        points = values(primitive.attributes.POSITION)
        weights = values(primitive.attributes.WEIGHTS_0)
        assert np.allclose(weights.sum(axis=1), 1)
        height = take.heights_m[row]
        assert points[:, 1].max() == pytest.approx(height, abs=0.03)
        assert points[:, 1].min() == pytest.approx(0.0, abs=0.02)
        assert np.ptp(points[:, 0]) == pytest.approx(height, rel=0.1)
        corner = points[values(primitive.indices).astype(int).reshape(-1, 3)]
        volume = np.einsum("fi,fi->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2])) / 6
        assert 0.03 < volume < 0.12, "faces seen from outside enclose a person's litres"


@pytest.mark.slow
@pytest.mark.parametrize("format", ["glb", "vrma"])
def test_the_khronos_validator_has_no_error(tmp_path, format):
    modules = node_modules("gltf-validator")
    path = export_take(two_walkers(), tmp_path, format=format, stem="t")[0]
    run = subprocess.run(
        ["node", str(READERS / "gltf_validate.mjs"), str(path)],
        cwd=modules,
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    report = json.loads(run.stdout)
    assert report["numErrors"] == report["numWarnings"] == 0, report


def node_modules(package: str) -> Path:
    """A folder whose node_modules has a package."""
    folder = os.environ.get("FUSECAP_NODE_FOLDER")
    if not folder or not (Path(folder) / "node_modules" / package).is_dir():
        pytest.skip(f"FUSECAP_NODE_FOLDER names no folder with {package} in node_modules")
    return Path(folder)


@pytest.mark.slow
def test_three_vrm_plays_a_vrma_on_an_avatar(tmp_path):
    """An avatar of the person's own proportions: bones are where the take has them.

    The spine's fold costs millimetres above it, since avatars' chests do not move in their parents.
    """
    modules = node_modules("@pixiv/three-vrm-animation")
    take = two_walkers()
    paths = export_take(take, tmp_path, format="vrma", stem="t")
    (tmp_path / "times.json").write_text(json.dumps(take.time_s.tolist()))
    for row, path in enumerate(paths):
        avatar = tmp_path / f"{row}.vrm"
        write_avatar(take.of_subjects([row]), avatar)
        out = tmp_path / f"{row}.json"
        subprocess.run(
            ["node", str(READERS / "vrma_on_vrm.mjs"), avatar, path, tmp_path / "times.json", out],
            cwd=modules,
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        )
        frames = json.loads(out.read_text())
        for joint in PRESETS["vrm"].joints:
            if joint.sits_at not in take.bone_names:
                continue
            bone = take.skeleton.bone(joint.sits_at)
            found = np.array([frame[joint.name] for frame in frames])
            apart_m = np.abs(found[:, :3] - take.bone_position_in_world_m[row, :, bone]).max()
            legs = any(part in joint.name.lower() for part in ("hips", "leg", "foot", "toes"))
            assert apart_m < (NEAR_M if legs else 4e-3), joint.name
            if len(joint.turns_with) == 1:
                true = np.roll(take.bone_rotation_in_world_wxyz[row, :, bone], -1, axis=-1)
                assert degrees_apart(found[:, 3:], true) < NEAR_DEG


def write_avatar(take, path) -> None:
    """The least that is a VRM 1.0."""
    gltf = Gltf.new("test")
    motion = rig_motion(take, 0, PRESETS["vrm"])
    nodes = add_joints(gltf, motion)
    add_body(gltf, motion, nodes, (1.0, 1.0, 1.0))
    bones = {name: {"node": node} for name, node in zip(motion.rest.names, nodes, strict=True)}
    meta = {"name": "t", "authors": ["t"], "licenseUrl": "https://vrm.dev/licenses/1.0/"}
    gltf.tree["extensionsUsed"] = ["VRMC_vrm"]
    gltf.tree["extensions"] = {
        "VRMC_vrm": {"specVersion": "1.0", "meta": meta, "humanoid": {"humanBones": bones}}
    }
    gltf.write(path)


@pytest.mark.parametrize(("unit", "unit_m"), [("m", 1.0), ("cm", 0.01)])
def test_usd_skel_finds_every_joint(tmp_path, unit, unit_m):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdSkel

    take = two_walkers(names=("anna", "Zoë/1"))
    (path,) = export_take(take, tmp_path, format="usd", stem="t", unit=unit)
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageMetersPerUnit(stage) == unit_m
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and stage.GetTimeCodesPerSecond() == 60
    cache = UsdSkel.Cache()
    roots = [UsdSkel.Root(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Root)]
    assert len(roots) == 2
    for row, root in enumerate(roots):
        cache.Populate(root, Usd.PrimDefaultPredicate)
        (prim,) = (p for p in root.GetPrim().GetChildren() if p.IsA(UsdSkel.Skeleton))
        query = cache.GetSkelQuery(UsdSkel.Skeleton(prim))
        names = [joint.rpartition("/")[2] for joint in query.GetJointOrder()]
        for frame in range(0, 40, 7):
            matrices = np.array(query.ComputeJointSkelTransforms(frame))
            for bone, name in enumerate(take.bone_names):
                found = matrices[names.index(name)]
                true = take.bone_position_in_world_m[row, frame, bone]
                assert np.abs(unit_m * found[3, :3] - true).max() < NEAR_M
                true = take.bone_rotation_in_world(row)[frame, bone]
                assert np.abs(found[:3, :3].T - true).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("format", ["glb", "usd", "fbx"])
def test_blender_puts_every_joint_of_everybody_where_the_take_has_it(tmp_path, format, monkeypatch):
    python = environment("FUSECAP_BPY_PYTHON", "bpy")
    monkeypatch.setenv("FUSECAP_BLENDER", python)
    take = two_walkers(names=("anna", "Zoë"))
    paths = export_take(take, tmp_path, format=format, stem="t")
    out, seen = tmp_path / "out.npz", {}
    for path in paths:
        told = run_reader(python, "blender_scene.py", path, 40, out)
        assert told["armatures"] == 2 // len(paths) and told["meshes"] >= told["armatures"]
        with np.load(out) as found:
            seen |= {key: found[key] for key in found.files}
    armatures = sorted(
        (key.removeprefix("heads_") for key in seen if key.startswith("heads_")),
        key=lambda name: not name.startswith("anna"),
    )
    for row, armature in enumerate(armatures):
        names = seen[f"names_{armature}"].tolist()
        heads, tails = seen[f"heads_{armature}"], seen[f"tails_{armature}"]
        for bone, name in enumerate(take.bone_names):
            true = take.bone_position_in_world_m[row, :, bone]
            assert np.abs(heads[:, names.index(name)] - true).max() < NEAR_M
        length = np.linalg.norm(tails - heads, axis=-1).min(axis=0)
        assert length[names.index("hips")] > 0.05
        assert length[names.index("left_pelvis")] > 0.10


def test_keypoints_are_what_the_cameras_see(tmp_path):
    """Our own reader's view, and the loader of a session, which solves them again."""
    simulation, body25 = demo_scene(0, seconds=0.2), landmark_set_named("body25")
    take = with_gap(simulation.truth, [2])
    options = ExportOptions(cameras=simulation.rig, landmarks=body25)
    (folder,) = export_take(take, tmp_path, format="openpose", stem="t", options=options)
    frames = len(take.timestamps_ns)
    for camera in simulation.rig.cameras:
        files = sorted((folder / camera.name).glob("*_keypoints.json"))
        assert len(files) == frames
        for frame, file in enumerate(files):
            people = json.loads(file.read_text())["people"]
            assert len(people) == take.tracked[:, frame].sum()
        rows = np.flatnonzero(take.tracked[:, frames - 1])
        for row, someone in zip(rows, people, strict=True):
            found = np.array(someone["pose_keypoints_2d"]).reshape(-1, 3)
            shape = take.shape(row)
            places = landmarks_in_world(
                take.bone_position_in_world_m[row, -1:],
                take.bone_rotation_in_world(row)[-1:],
                body25.bones(take.skeleton),
                body25.offsets_m(shape),
            )[0]
            pixels = camera.project(places)
            seen = found[:, 2] > 0
            assert seen.any() and np.abs(found[seen, :2] - pixels[seen]).max() < 2e-3
            outside = ((pixels < 0) | (pixels > np.array(camera.size_px) - 1)).any(axis=1)
            assert np.array_equal(~seen, outside | np.isnan(pixels).any(axis=1))
    again = export_take(take, tmp_path, format="openpose", stem="t", options=options)
    assert again == [folder] and [p.name for p in tmp_path.iterdir()] == ["t.openpose"]
    with pytest.raises(InputError, match="--session"):
        export_take(take, tmp_path, format="openpose", stem="u")


def test_a_browser_plays_the_page_from_the_file(tmp_path):
    """As a person would: it opens, plays, shows both names and draws something of both colours."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on the PATH")
    sync_api = pytest.importorskip("playwright.sync_api")
    take = two_walkers(names=("anna</script>", "Zoë 🙂"))
    (path,) = export_take(take, tmp_path, format="html", stem="t")
    flags = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    troubles: list[str] = []
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 500, "height": 400})
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda r: troubles.extend([r.url] if r.url[:5] != "file:" else []))
        page.goto(path.as_uri())
        page.wait_for_function("document.getElementById('clock').textContent > '0.2'")
        page.click("#play")
        page.evaluate("show(20)")
        labels = page.locator(".label").all_inner_texts()
        points = page.evaluate("Array.from(take.people[1].steps)")
        page.screenshot(path=tmp_path / "page.png")
        browser.close()
    assert troubles == [] and labels == ["anna</script>", "Zoë 🙂"]
    found_m = 1e-3 * np.array(points).reshape(40, -1, 3)
    joints = PRESETS["native"].joints
    names = [joint.name for joint in joints]
    for bone, name in enumerate(take.bone_names):
        true = take.bone_position_in_world_m[1, :, bone]
        assert np.abs(found_m[:, names.index(name)] - true).max() < NEAR_M
    picture = cv2.imread(str(tmp_path / "page.png")).astype(int)
    blue, orange = picture[..., 0] - picture[..., 2], picture[..., 2] - picture[..., 0]
    assert (blue > 40).sum() > 300 and (orange > 40).sum() > 300


def test_a_library_that_is_missing_is_named_with_its_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(InputError, match=r"ezc3d.*pip install 'ezc3d>="):
        export_take(two_walkers(2), tmp_path, format="c3d", stem="t")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ("/nowhere/blender", "names /nowhere/blender, which is no program"),
        ("false", "is it Blender"),
    ],
)
def test_a_blender_that_is_none_is_named(tmp_path, monkeypatch, program, told):
    monkeypatch.setenv("FUSECAP_BLENDER", program)
    with pytest.raises(InputError, match=told):
        export_take(two_walkers(2), tmp_path, format="fbx", stem="t")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("format", "module", "told"),
    [("c3d", "ezc3d", "extra 'c3d'"), ("usd", "pxr", "extra 'usd'"), ("fbx", "bpy", "Blender")],
)
@pytest.mark.parametrize("command", ["solve", "export"])
def test_what_a_format_needs_is_asked_for_before_the_session_is_opened(
    command, format, module, told, monkeypatch
):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("FUSECAP_BLENDER", raising=False)
    monkeypatch.setattr("fusecap.exports.blender.find_spec", lambda name: None)
    option = "--export" if command == "solve" else "--format"
    result = CliRunner().invoke(app, [command, "nowhere", option, f"csv,{format}"])
    assert isinstance(result.exception, InputError) and told in str(result.exception)


def test_cameras_whose_names_are_one_on_disk_have_a_folder_each(tmp_path):
    two = zip(demo_scene(0, seconds=0.1).rig.cameras, ("a/1", "A?1"), strict=False)
    cameras = [replace(camera, name=name) for camera, name in two]
    options = ExportOptions(cameras=Rig(cameras=tuple(cameras)))
    (path,) = export_take(two_walkers(2), tmp_path, format="openpose", stem="t", options=options)
    assert sorted(folder.name for folder in path.iterdir()) == ["A_1_2", "a_1"]
    assert all(len(list(folder.iterdir())) == 2 for folder in path.iterdir())


WITHOUT_MORE = [name for name in FORMATS if name not in ("fbx", "openpose")]
"""Formats that need neither another program nor cameras."""


@pytest.mark.parametrize("format", WITHOUT_MORE)
def test_one_frame_and_odd_names_are_written(tmp_path, format):
    take = two_walkers(1, names=ODD_NAMES)
    paths = export_take(take, tmp_path, format=format, stem="t")
    assert len(paths) == (2 if format_named(format).per_person else 1)
    assert all(path.stat().st_size > 0 for path in paths)
    assert {path.name for path in paths} == {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("format", WITHOUT_MORE)
def test_gaps_are_written_and_nobody_is_refused(tmp_path, format):
    take = with_gap(with_gap(two_walkers(6), [0, 3]), slice(None), subject=1)
    paths = export_take(take, tmp_path, format=format, stem="t")
    assert len(paths) == 1 and not any(b"nan" in path.read_bytes()[:50_000] for path in paths)
    nobody = with_gap(take, slice(None))
    with pytest.raises(TakeError, match="nobody is tracked"):
        export_take(nobody, tmp_path / "other", format=format, stem="t")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("format", WITHOUT_MORE)
def test_a_folder_that_is_a_file_is_one_line(tmp_path, format):
    (tmp_path / "file").write_text("")
    with pytest.raises(TakeError, match="cannot write"):
        export_take(two_walkers(2), tmp_path / "file", format=format, stem="t")


@pytest.mark.parametrize("format", WITHOUT_MORE)
def test_a_hundred_people(tmp_path, format):
    shape = person()
    names = tuple(f"person{n}" for n in range(100))
    take = take_of(np.stack([walk(shape, 2)] * 100), [shape] * 100, names=names)
    paths = export_take(take, tmp_path, format=format, stem="t")
    assert len({*paths}) == (100 if format_named(format).per_person else 1)


def test_several_formats_at_once_and_choices_that_none_has(tmp_path):
    take = two_walkers(3)
    save_take(take, tmp_path / "t.npz")
    command = ["export", str(tmp_path / "t.npz"), "--format", "bvh,csv,trc", "--unit", "cm"]
    result = CliRunner().invoke(app, [*command, "--rig", "vrm", "--json"])
    assert result.exit_code == 0, result.output
    names = [Path(file).name for file in json.loads(result.output)["files"]]
    assert names[:3] == ["t_anna.vrm.cm.bvh", "t_ben.vrm.cm.bvh", "t.csv"]
    assert names[3:] == ["t_anna.trc", "t_ben.trc"]
    with pytest.raises(InputError, match="csv has no rig"):
        plan_files(take, tmp_path, formats=["csv"], stem="u", rig="vrm")
    with pytest.raises(InputError, match="csv is written in m, not in cm"):
        plan_files(take, tmp_path, formats=["csv"], stem="u", unit="cm")


def test_fbx_is_read_as_it_was_written():
    values = np.arange(5, dtype=np.int64)
    inner = FbxElement(b"KeyTime", [array_property(values)])
    model = FbxElement(
        b"Model", [b"L" + struct.pack("<q", 7), text_property("Zoë\0\1Model".encode())], [inner]
    )
    file = FbxFile(7400, [FbxElement(b"Objects", [], [model]), FbxElement(b"Takes", [])], b"f" * 16)
    data = b"".join(file.pieces())
    again = FbxFile.read(data)
    assert b"".join(again.pieces()) == data
    found = again.named(b"Objects").child(b"Model")
    assert found.whole(0) == 7 and found.text(1) == "Zoë\0\1Model".encode()
    assert found.child(b"KeyTime").properties == [array_property(values)]
    with pytest.raises(InputError, match=r"found version 7\.7"):
        FbxFile.read(data[:23] + struct.pack("<I", 7700) + data[27:])
    with pytest.raises(InputError, match="unknown type b'Q'"):
        FbxFile.read(data.replace(b"L\x07\0", b"Q\x07\0"))


@pytest.mark.parametrize("axes", ["XYZ", "XY", ""])
def test_a_bone_of_an_fbx_moves_only_where_it_has_all_curves(axes):
    def whole(number):
        return b"L" + struct.pack("<q", number)

    def connected(child, parent, to=b""):
        kind = text_property(b"OP" if to else b"OO")
        named = [text_property(to)] if to else []
        return FbxElement(b"C", [kind, whole(child), whole(parent), *named])

    bone = FbxElement(
        b"Model",
        [whole(1), text_property(b"hips\0\1Model"), text_property(b"LimbNode")],
        [FbxElement(b"Properties70", [])],
    )
    kept = ("KeyTime", np.int64), ("KeyValueFloat", np.float32), ("KeyAttrRefCount", np.int32)
    curves = [
        FbxElement(
            b"AnimationCurve",
            [whole(10 + row)],
            [FbxElement(k.encode(), [array_property(np.zeros(1, dtype=t))]) for k, t in kept],
        )
        for row in range(len(axes))
    ]
    node = FbxElement(b"AnimationCurveNode", [whole(2)])
    lines = [connected(1, 0), connected(2, 1, b"Lcl Rotation")]
    lines += [connected(10 + row, 2, f"d|{axis}".encode()) for row, axis in enumerate(axes)]
    file = FbxFile(
        7400,
        [FbxElement(b"Objects", [], [bone, node, *curves]), FbxElement(b"Connections", [], lines)],
        b"f" * 16,
    )
    moves = {"hips": NodeMotion(rest=np.eye(3), turn=Rotation.random(2, random_state=1))}
    moved = fbx_motion._Scene(file, np.array([0.0, 0.1])).move(moves)
    assert moved == ({"hips"} if axes == "XYZ" else set())


def test_who_is_not_tracked_is_not_seen_in_glb_and_usd(tmp_path):
    take = with_gap(two_walkers(10), [0, 4, 5])
    (path,) = export_take(take, tmp_path, format="glb", stem="t")
    tree, values = gltf_arrays(path)
    sizes = [c for c in tree.animations[0].channels if c.target.path == "scale"]
    assert [tree.nodes[channel.target.node].name for channel in sizes] == ["anna"]
    sampler = tree.animations[0].samplers[sizes[0].sampler]
    assert sampler.interpolation == "STEP"
    assert values(sampler.input).ravel() == pytest.approx(take.time_s[[0, 1, 4, 6]], abs=1e-6)
    assert values(sampler.output)[:, 0].tolist() == [0, 1, 0, 1]
    usd = pytest.importorskip("pxr.Usd")
    (path,) = export_take(take, tmp_path, format="usd", stem="t")
    stage = usd.Stage.Open(str(path))
    for row, name in enumerate(take.subject_names):
        shown = stage.GetPrimAtPath(f"/Take/{name}").GetAttribute("visibility")
        words = [shown.Get(frame) or "inherited" for frame in range(10)]
        assert [word == "inherited" for word in words] == take.tracked[row].tolist()


def test_where_a_format_holds_the_last_pose_is_told(tmp_path):
    save_take(with_gap(two_walkers(60), [0, 1, 10, 20, 21, 30, 40]), tmp_path / "t.npz")
    command = ["export", str(tmp_path / "t.npz"), "--format", "bvh,vrma,glb", "--json"]
    told = json.loads(CliRunner().invoke(app, command).stdout)
    assert told["notes"] == [
        "'anna' is not tracked in 7 frames (0.00-0.02, 0.17-0.17, 0.33-0.35 s and 2 more): "
        ".bvh, .vrma hold the last pose there"
    ]
    command = ["export", str(tmp_path / "t.npz"), "--format", "usd,glb"]
    assert "not tracked" not in CliRunner().invoke(app, command).output


@pytest.mark.parametrize("name", sorted(set(FORMATS) - {"fbx", "openpose"}))
def test_a_take_in_its_file_is_read_in_blocks_and_written_as_the_same(name, tmp_path, monkeypatch):
    try:
        format_named(name).check_needs()
    except InputError as error:
        pytest.skip(str(error))
    save_take(with_gap(two_walkers(2100), slice(2000, 2090)), tmp_path / "t.npz")
    made, read, plain_read = {}, [], StoredTake._read

    def noted(stored, spans):
        read.append(sum(end - first for first, end in spans))
        return plain_read(stored, spans)

    whole = load_take(tmp_path / "t.npz")
    monkeypatch.setattr(StoredTake, "_read", noted)
    with StoredTake(tmp_path / "t.npz") as stored:
        for way, take in {"file": stored, "memory": whole}.items():
            paths = export_take(take, tmp_path / way, format=name, stem="t")
            made[way] = [path.read_bytes() for path in paths]
    assert made["file"] == made["memory"]
    assert max(read, default=0) <= (BLOCK if name != "c3d" else 2100)


def test_a_take_that_is_spoilt_far_inside_is_refused_before_anything_is_written(tmp_path):
    save_take(two_walkers(BLOCK + 40), tmp_path / "t.npz")
    with np.load(tmp_path / "t.npz") as archive:
        arrays = dict(archive)
    arrays["theta"][1, BLOCK + 20, 5] = np.nan
    np.savez(tmp_path / "t.npz", **arrays)
    out = tmp_path / "o"
    command = [
        "export",
        str(tmp_path / "t.npz"),
        "--format",
        "csv,bvh",
        "--out",
        str(tmp_path / "o"),
    ]
    result = CliRunner().invoke(app, command)
    assert isinstance(result.exception, TakeError) and "theta of 'ben'" in str(result.exception)
    assert not out.exists()


def test_a_gap_across_two_blocks_holds_the_last_pose():
    take = with_gap(two_walkers(2 * BLOCK + 60), slice(BLOCK - 10, 2 * BLOCK + 20))
    motion = rig_motion(take, 0, PRESETS["native"])
    held = slice(BLOCK - 11, 2 * BLOCK + 20)
    for values in (motion.position_m, motion.rotation_xyzw):
        assert (values[held] == values[BLOCK - 11]).all()
    assert (np.einsum("tji,tji->tj", motion.rotation_xyzw[1:], motion.rotation_xyzw[:-1]) > 0).all()
