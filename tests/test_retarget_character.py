"""Motion onto characters: of every preset, other proportions, scaled and turned armatures."""

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import fusecap
from export_people import NEAR_M, environment, run_reader, two_walkers, with_gap
from fusecap.body.rigs import PRESETS
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import EXTENDED23, PAPER21
from fusecap.cli import app
from fusecap.errors import InputError, TakeError
from fusecap.exports.characters.bone_names import bone_map
from fusecap.exports.characters.character import read_character
from fusecap.exports.gltf import Gltf
from fusecap.exports.gltf_people import add_body, add_joints
from fusecap.exports.rig_motion import rig_motion
from fusecap.feet import standing
from fusecap.take import save_take
from motions import person, take_of, walk


def character_file(path, *, rig="native", shape=None, rename=lambda name: name):
    """A rigged body of a preset."""
    shape = shape or person(1.75)
    take = take_of(walk(shape, 1)[None], [shape], names=("armature",))
    motion = rig_motion(take, 0, PRESETS[rig])
    gltf = Gltf.new("test")
    nodes = add_joints(gltf, motion)
    add_body(gltf, motion, nodes, (1.0, 1.0, 1.0))
    for node in nodes:
        gltf.tree["nodes"][node]["name"] = rename(gltf.tree["nodes"][node]["name"])
    gltf.write(path)
    return path


def world_of(path, frames) -> dict[str, np.ndarray]:
    """Places of all nodes as pygltflib and SciPy play the first animation (T, 3)."""
    pygltflib = pytest.importorskip("pygltflib")
    tree = pygltflib.GLTF2().load(str(path))
    blob = tree.binary_blob()

    def values(index):
        accessor = tree.accessors[index]
        view = tree.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        flat = np.frombuffer(blob, np.float32, accessor.count * width, view.byteOffset)
        return flat.reshape(accessor.count, width).astype(float)

    parent = {child: at for at, node in enumerate(tree.nodes) for child in node.children or []}
    moved = {}
    for channel in tree.animations[0].channels:
        sampler = tree.animations[0].samplers[channel.sampler]
        moved[channel.target.node, channel.target.path] = values(sampler.output)
    done = {}

    def at(node):
        if node not in done:
            told = tree.nodes[node]
            still = np.tile(told.translation or [0, 0, 0], (frames, 1))
            place = moved.get((node, "translation"), still)
            still = np.tile(told.rotation or [0, 0, 0, 1], (frames, 1))
            turn = Rotation.from_quat(moved.get((node, "rotation"), still))
            scale = (told.scale or [1.0])[0]
            if node in parent:
                above_place, above_turn, above_scale = at(parent[node])
                place = above_place + above_turn.apply(above_scale * place)
                turn, scale = above_turn * turn, above_scale * scale
            done[node] = place, turn, scale
        return done[node]

    return {node.name: at(index)[0] for index, node in enumerate(tree.nodes)}


def names_of(rig) -> dict[str, str]:
    """A preset's names by our bones."""
    return {
        j.sits_at: j.name
        for j in PRESETS[rig].joints
        if j.turns_with == (j.sits_at,) and not j.towards
    }


@pytest.mark.parametrize("rig", PRESETS)
def test_a_character_of_the_person_s_own_size_does_what_the_person_does(tmp_path, rig):
    """Legs and hips are exact; a spine of another number of bones bends a little elsewhere."""
    take = two_walkers(30, skeleton=EXTENDED23).of_subjects([0])
    avatar = character_file(tmp_path / "avatar.glb", rig=rig, shape=take.shape(0))
    done = fusecap.retarget(take, avatar, tmp_path / "out.glb")
    assert done.scale == pytest.approx(1.0)
    found = world_of(tmp_path / "out.glb", 30)
    for bone, name in names_of(rig).items():
        true = take.bone_position_in_world_m[0, :, take.skeleton.bone(bone)]
        exact = rig in ("native", "rokoko", "xsens") or bone == "hips"
        exact = exact or any(part in bone for part in ("thigh", "shank", "foot", "toes"))
        if exact or not bone.startswith("spine"):
            assert np.abs(found[name] - true).max() < (NEAR_M if exact else 0.03), bone


OTHER_LEGS = {"left_shank": 0.40, "right_shank": 0.40, "left_foot": 0.55, "right_foot": 0.55}


@pytest.mark.parametrize("rig", ["native", "mixamo", "ue5", "vrm"])
def test_feet_stand_where_they_stood_on_other_legs(tmp_path, rig):
    shape, frames = person(1.6), 200
    take = take_of(walk(shape, frames)[None], [shape], names=("a",))
    locked = fusecap.edit_take(take, fusecap.EditOptions(foot_lock=1.0))
    big = BodyShape.from_height(PAPER21, 2.1).with_lengths(OTHER_LEGS)
    avatar = character_file(tmp_path / "avatar.glb", rig=rig, shape=big)
    done = fusecap.retarget(locked, avatar, tmp_path / "out.glb")
    names = names_of(rig)
    found = world_of(tmp_path / "out.glb", frames)
    rest = read_character(avatar)
    ankle_m = rest.world_position_m[rest.names.index(names["left_foot"]), 1]
    for side in ("left", "right"):
        bone = locked.skeleton.bone(f"{side}_foot")
        ours = locked.bone_position_in_world_m[0, :, bone]
        theirs = found[names[f"{side}_foot"]]
        expected = done.scale * (ours - [0, 0.039 * 1.6, 0]) + [0, ankle_m, 0]
        stands = standing(locked, 0, side)
        assert stands.any() and np.abs(theirs - expected)[stands].max() < NEAR_M
        slides = [np.linalg.norm(np.diff(place, axis=0), axis=1) for place in (ours, theirs)]
        more = slides[1] - done.scale * slides[0]
        assert more[stands[1:] & stands[:-1]].max() < NEAR_M


def test_prefixed_names_scaled_and_turned_armatures_are_understood(tmp_path):
    """As FBX converters leave them: centimetres, z up, everything named CC_Base_..."""
    take = two_walkers(20).of_subjects([0])
    for rig in ("ue5", "unity"):
        plain = character_file(tmp_path / f"{rig}.glb", rig=rig)
        moved = in_armature(plain, tmp_path / f"{rig}_moved.glb")
        fusecap.retarget(take, plain, tmp_path / "plain_out.glb")
        fusecap.retarget(take, moved, tmp_path / "moved_out.glb")
        one = world_of(tmp_path / "plain_out.glb", 20)
        other = world_of(tmp_path / "moved_out.glb", 20)
        for name in names_of(rig).values():
            assert np.abs(one[name] - other[f"CC_Base_{name}"]).max() < NEAR_M, name


def in_armature(source, target) -> Path:
    """The same character below an armature that turns and scales it, and undoes both inside."""
    read = read_character(source)
    tree = copy.deepcopy(read.tree)
    turn, scale = Rotation.from_rotvec([-np.pi / 2, 0, 0]), 0.01
    owner = next(n for n in tree["nodes"] if n["name"] == "armature")
    owner |= {"rotation": turn.as_quat().tolist(), "scale": [scale] * 3}
    (root,) = owner["children"]
    for index in read.joints:
        joint = tree["nodes"][index]
        joint["name"] = f"CC_Base_{joint['name']}"
        place = np.array(joint["translation"]) / scale
        if index == root:
            place = turn.inv().apply(place)
            inside = turn.inv() * Rotation.from_quat(joint["rotation"])
            joint["rotation"] = inside.as_quat().tolist()
        joint["translation"] = place.tolist()
    Gltf(tree, read.binary).write(target)
    inside, gltf = read_character(target), Gltf(tree, read.binary)
    (skin,) = tree["skins"]
    binds = np.tile(np.eye(4), (len(skin["joints"]), 1, 1))
    for bind, node in zip(binds, skin["joints"], strict=True):
        bind[:3, :3] = inside.world_scale[node] * inside.world_rotation[node]
        bind[:3, 3] = inside.world_position_m[node]
    columns = np.linalg.inv(binds).transpose(0, 2, 1).reshape(-1, 16)
    skin["inverseBindMatrices"] = gltf.array(columns.astype(np.float32))
    gltf.write(target)
    return target


@pytest.mark.parametrize(
    "names",
    [
        ("thigh.L", "shin.L", "upper_arm.L", "forearm.L"),
        ("Bip01 L Thigh", "Bip01 L Calf", "Bip01 L UpperArm", "Bip01 L Forearm"),
        ("LeftHip", "LeftKnee", "LeftArm", "LeftElbow"),
        ("DEF-thigh.L", "DEF-shin.L", "DEF-upper_arm.L", "DEF-forearm.L"),
        ("LeftHip", "LeftKnee", "LeftShoulder", "LeftElbow"),
        ("L_UpperLeg", "L_LowerLeg", "L_UpperArm", "L_LowerArm"),
    ],
)
def test_names_of_many_programs_are_guessed(tmp_path, names):
    ours = dict(
        zip(("left_thigh", "left_shank", "left_upper_arm", "left_forearm"), names, strict=True)
    )
    if "LeftShoulder" in names:
        ours["left_clavicle"] = "LeftCollar"
    avatar = character_file(tmp_path / "a.glb", rename=lambda name: ours.get(name, name))
    read = read_character(avatar)
    found = bone_map(read, {}).bones
    assert {bone: read.names[found[bone]] for bone in ours} == ours


METARIG = {
    **{"hips": "spine", "spine": "spine.001", "spine1": "spine.002", "spine2": "spine.003"},
    **{"spine3": "spine.004", "neck": "spine.005", "head": "spine.006", "left_thigh": "thigh.L"},
}


def test_trunks_without_names_are_told_by_where_they_are(tmp_path):
    """Rigify's metarig calls hips, neck and head spine."""
    avatar = character_file(tmp_path / "a.glb", rename=lambda name: METARIG.get(name, name))
    read = read_character(avatar)
    found = bone_map(read, {})
    told = {bone: read.names[found.bones[bone]] for bone in ("hips", "neck", "head")}
    assert told == {"hips": "spine", "neck": "spine.005", "head": "spine.006"}
    assert [read.names[n] for n in found.spine] == [f"spine.00{n}" for n in (1, 2, 3, 4)]


def test_limbs_that_do_not_hang_on_the_hips_are_named(tmp_path):
    """As the deforming bones of a rig with controls, whose widgets are of odd sizes besides."""
    read = read_character(character_file(tmp_path / "c.glb", rig="vrm"))
    tree = copy.deepcopy(read.tree)
    tree["nodes"].append({"name": "WGT-eye", "scale": [-0.03, 0.03, 0.05]})
    Gltf(tree, read.binary).write(tmp_path / "widget.glb")
    take = two_walkers(3).of_subjects([0])
    fusecap.retarget(take, tmp_path / "widget.glb", tmp_path / "out.glb")
    leg = read.names.index("leftUpperLeg")
    tree["nodes"][read.names.index("hips")]["children"].remove(leg)
    tree["nodes"][read.names.index("armature")]["children"].append(leg)
    Gltf(tree, read.binary).write(tmp_path / "loose.glb")
    with pytest.raises(InputError, match=r"hips \(hips\): left_thigh \(leftUpperLeg\), left_shank"):
        fusecap.retarget(take, tmp_path / "loose.glb", tmp_path / "out.glb")


def test_a_vrm_s_own_map_counts(tmp_path):
    take = two_walkers(10).of_subjects([1])
    avatar = character_file(tmp_path / "a.glb", rig="vrm", rename=lambda name: f"q {name[::-1]}")
    with pytest.raises(InputError, match=r"cannot tell which bone is hips.*--map hips=NAME"):
        fusecap.retarget(take, avatar, tmp_path / "out.glb")
    assert not (tmp_path / "out.glb").exists()
    read = read_character(avatar)
    tree = copy.deepcopy(read.tree)
    nodes = {j.name: read.names.index(f"q {j.name[::-1]}") for j in PRESETS["vrm"].joints}
    bones = {name: {"node": node} for name, node in nodes.items()}
    tree["extensions"] = {"VRMC_vrm": {"humanoid": {"humanBones": bones}}}
    Gltf(tree, read.binary).write(tmp_path / "b.vrm")
    done = fusecap.retarget(take, tmp_path / "b.vrm", tmp_path / "out.vrm")
    assert done.bones["left_shank"] == "q geLrewoLtfel"


def test_a_character_may_lack_a_spine(tmp_path):
    read = read_character(character_file(tmp_path / "c.glb", rig="vrm"))
    tree = copy.deepcopy(read.tree)
    hips, spine, top = (tree["nodes"][read.names.index(n)] for n in ("hips", "spine", "upperChest"))
    hips["children"].remove(read.names.index("spine"))
    hips["children"] += top.pop("children")
    del spine
    Gltf(tree, read.binary).write(tmp_path / "d.glb")
    take = two_walkers(10).of_subjects([1])
    done = fusecap.retarget(take, tmp_path / "d.glb", tmp_path / "s.glb")
    assert not any(name.startswith("spine") for name in done.bones)


def test_broken_characters_are_one_line(tmp_path):
    take = two_walkers(3).of_subjects([0])
    avatar = character_file(tmp_path / "a.glb")
    whole = avatar.read_bytes()
    broken, out = tmp_path / "b.glb", tmp_path / "out.glb"
    for data in (b"", b"glTF", whole[:40], whole[:-100], b"glTF" + bytes(40), b"solid x"):
        broken.write_bytes(data)
        with pytest.raises(InputError):
            fusecap.retarget(take, broken, out)
    tree = copy.deepcopy(read_character(avatar).tree)
    tree["nodes"][read_character(avatar).joints[0]]["scale"] = [1, 2, 1]
    Gltf(tree, read_character(avatar).binary).write(broken)
    for where, message in (
        (tmp_path / "no.glb", "no such file"),
        (tmp_path, "is a folder"),
        (broken, "apply scales"),
    ):
        with pytest.raises(InputError, match=message):
            fusecap.retarget(take, where, out)
    with pytest.raises(InputError, match="is the character itself"):
        fusecap.retarget(take, avatar, avatar)
    with pytest.raises(InputError, match=r"written as \.glb, \.vrm or \.fbx"):
        fusecap.retarget(take, avatar, tmp_path / "x.obj")
    with pytest.raises(TakeError, match="nobody is tracked in any frame"):
        fusecap.retarget(with_gap(take, slice(None)), avatar, out)
    with pytest.raises(InputError, match="anna, ben: say whose motion it is"):
        fusecap.retarget(two_walkers(3), avatar, out)
    with pytest.raises(TakeError, match="no subject 'bob'"):
        fusecap.retarget(take, avatar, out, subject="bob")
    with pytest.raises(InputError, match="no node 'x'"):
        fusecap.retarget(take, avatar, out, bones={"head": "x"})
    with pytest.raises(InputError, match="no bone 'haed'; did you mean 'head'"):
        fusecap.retarget(take, avatar, out, bones={"haed": "head"})
    assert not out.exists() and avatar.read_bytes() == whole


def test_the_command_shows_the_bones_it_matched(tmp_path):
    take = with_gap(two_walkers(8), [2])
    save_take(take, tmp_path / "t.npz")
    avatar = character_file(tmp_path / "avatar.glb", rig="mixamo")
    command = ["retarget", str(tmp_path / "t.npz"), str(avatar), "--subject", "anna"]
    result = CliRunner().invoke(app, [*command, "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    assert told["bones"]["left_shank"] == "mixamorig:LeftLeg"
    assert told["notes"] == [
        "'anna' is not tracked in 1 frames (0.03-0.03 s): .glb hold the last pose there"
    ]
    assert [Path(file).name for file in told["files"]] == ["t_anna_avatar.glb"]
    assert "mixamorig:LeftLeg" in CliRunner().invoke(app, command).output


@pytest.mark.slow
def test_characters_go_in_and_out_of_fbx_through_blender(tmp_path, monkeypatch):
    """In FBX every bone is where the GLB has it, whatever armature the character lies in."""
    python = environment("FUSECAP_BPY_PYTHON", "bpy")
    monkeypatch.setenv("FUSECAP_BLENDER", python)
    take = with_gap(two_walkers(150), slice(40, 45))
    from_fbx = tmp_path / "avatar.fbx"
    fusecap.export(take.of_subjects([1]), from_fbx, rig="mixamo")
    plain = character_file(tmp_path / "plain.glb", rig="ue5", shape=person(1.2))
    animated = with_animation(character_file(tmp_path / "v.glb", rig="vrm"), tmp_path / "w.glb")
    for avatar in (from_fbx, in_armature(plain, tmp_path / "scaled.glb"), animated):
        glb, fbx, found = (tmp_path / f"{avatar.stem}_out{end}" for end in (".glb", ".fbx", ".npz"))
        done = fusecap.retarget(take, avatar, glb, subject="anna")
        assert fusecap.retarget(take, avatar, fbx, subject="anna").bones == done.bones
        assert run_reader(python, "blender_scene.py", fbx, 150, found)["armatures"] == 1
        expected = world_of(glb, 150)
        with np.load(found) as heads:
            (armature,) = (k.removeprefix("names_") for k in heads.files if k[:6] == "names_")
            names = heads[f"names_{armature}"].tolist()
            assert {*done.bones.values()} <= {*names}
            for bone, name in enumerate(names):
                away = np.abs(heads[f"heads_{armature}"][:, bone] - expected[name])
                assert away.max() < NEAR_M, (avatar.name, name)
        if avatar is from_fbx:
            assert done.bones["left_shank"] == "mixamorig:LeftLeg"
            assert done.scale == pytest.approx(1.9 / 1.5, abs=1e-3)


def with_animation(source, target) -> Path:
    """The same character with a dance of its own, which is not what Blender shall write."""
    read = read_character(source)
    gltf = Gltf(copy.deepcopy(read.tree), read.binary)
    times = gltf.array(np.array([0.0, 9.0], np.float32), bounds=True)
    turns = gltf.array(np.array([[0, 0, 0, 1], [1, 0, 0, 0]], np.float32))
    gltf.add(
        "animations",
        {
            "samplers": [{"input": times, "output": turns}],
            "channels": [{"sampler": 0, "target": {"node": 3, "path": "rotation"}}],
        },
    )
    gltf.write(target)
    return target
