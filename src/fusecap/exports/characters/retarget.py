"""A person's motion on a character: same directions, own proportions, feet where they stand.

Both rest poses are brought together first: the character is turned to face z, and each of our limbs
is laid along its limb, so a character that rests with arms down is no different. Then every bone of
the character turns in the world as ours does. The way through the room is scaled by the length of
legs, ankles go to the scaled places of ours with their own height over the floor, and legs reach
for them: where our foot stands, the character's stands too.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.body.rigs import PRESETS
from fusecap.errors import InputError, TakeError
from fusecap.exports.blender import run_in_blender
from fusecap.exports.characters.bone_names import BoneMap, bone_map
from fusecap.exports.characters.bone_words import spine_shares
from fusecap.exports.characters.character import Character, read_character
from fusecap.exports.fbx_motion import NodeMotion, write_fbx
from fusecap.exports.gltf import Gltf
from fusecap.exports.rig_motion import RigMotion, rig_motion, short_way
from fusecap.exports.take_format import AnyTake
from fusecap.geometry.two_bone import STRETCHED, least_turns, two_bone_turns

_CHILD = {
    f"{side}_{bone}": f"{side}_{child}"
    for side in ("left", "right")
    for bone, child in (
        ("upper_arm", "forearm"),
        ("forearm", "hand"),
        ("thigh", "shank"),
        ("shank", "foot"),
    )
}
"""Limbs whose direction at rest is compared, and where they end."""
_FROM_FBX = """
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.fbx(filepath=told["fbx"])
bpy.ops.export_scene.gltf(filepath=told["glb"], export_format="GLB", export_animations=False)
"""


@dataclass(frozen=True, kw_only=True)
class Retargeted:
    """What was written, and how bones were matched."""

    path: Path
    subject: str
    bones: dict[str, str]
    """The character's names by ours."""
    scale: float
    """Of the way through the room: the character's legs over the person's."""


def retarget(
    take: AnyTake,
    character: Path | str,
    out: Path | str,
    *,
    subject: str | None = None,
    bones: Mapping[str, str] | None = None,
) -> Retargeted:
    """Writes the character with the motion of one subject; `out` ends with .glb, .vrm or .fbx.

    `bones` names the character's bones by ours where guesses fail. Raises `InputError` for a
    character whose bones cannot be told; FBX needs Blender.
    """
    character, out = Path(character), Path(out)
    row = _row(take, subject)
    if out.suffix.lower() not in (".glb", ".vrm", ".fbx"):
        raise InputError(f"{out}: a character is written as .glb, .vrm or .fbx")
    if out.resolve() == character.resolve():
        raise InputError(f"{out} is the character itself: name another file")
    with tempfile.TemporaryDirectory() as folder:
        source = character
        if character.suffix.lower() == ".fbx":
            source = Path(folder) / "character.glb"
            if not character.is_file():
                raise InputError(f"cannot read {character}: no such file")
            told = {"fbx": str(character.resolve()), "glb": str(source)}
            run_in_blender(_FROM_FBX, told, source)
        read = read_character(source)
        mapped = bone_map(read, bones or {})
        motion = rig_motion(take, row, PRESETS["native"])
        placed = _Moved(read, mapped, motion)
        if out.suffix.lower() == ".fbx":
            tree = copy.deepcopy(read.tree)
            tree.pop("animations", None)
            still = Gltf(tree, read.binary)
            write_fbx(still, placed.moves(), out, time_s=motion.time_s, rate_hz=motion.rate_hz)
        else:
            _write(read, placed, motion, out)
    return Retargeted(
        path=out,
        subject=take.subject_names[row],
        bones={bone: read.names[node] for bone, node in mapped.bones.items()}
        | {f"spine {n + 1}": read.names[node] for n, node in enumerate(mapped.spine)},
        scale=placed.scale,
    )


def _row(take: AnyTake, subject: str | None) -> int:
    if subject is not None:
        return take.subject(subject)
    people = [row for row in range(len(take.subject_names)) if take.tracked[row].any()]
    if not people:
        raise TakeError("nobody is tracked in any frame of the take: there is no motion to take")
    if len(people) > 1:
        names = ", ".join(take.subject_names[row] for row in people)
        raise InputError(f"the take has {names}: say whose motion it is, --subject NAME")
    return people[0]


class _Moved:
    """The character in every frame: turns of its bones in the world, places of its hips."""

    def __init__(self, character: Character, mapped: BoneMap, motion: RigMotion) -> None:
        self._character = character
        self._bones = mapped.bones
        self.hips = mapped.bones["hips"]
        self.frames = len(motion.time_s)
        rest = motion.rest
        self._rest_m = dict(zip(rest.names, rest.position_m, strict=True))
        places, turns = motion.in_world()
        self._ours_m = dict(zip(rest.names, places, strict=True))
        self._ours = dict(zip(rest.names, turns, strict=True))
        theirs_m = {bone: character.world_position_m[node] for bone, node in mapped.bones.items()}
        self._leg_m = _legs_m(theirs_m, character)
        ours = _legs_m(self._rest_m, character)
        self.scale = sum(self._leg_m.values()) / sum(ours.values())
        self._ankle_m = (theirs_m["left_foot"][1] + theirs_m["right_foot"][1]) / 2
        self._our_ankle_m = (self._rest_m["left_foot"][1] + self._rest_m["right_foot"][1]) / 2
        left = theirs_m["left_thigh"] - theirs_m["right_thigh"]
        yaw = np.arctan2(-left[2], left[0])
        self._faces = Rotation.from_rotvec([0.0, yaw, 0.0]).as_matrix()
        """The turn about up that takes our rest pose to the character's."""
        self.turns: dict[int, Float[np.ndarray, "t 3 3"]] = {}
        """By node."""
        self._turn_bones(mapped)
        self._hips_m = self._place_hips_m()
        self._hips_m[:, 1] -= self._too_high_m()
        for side in ("left", "right"):
            self._reach(side)

    def moves(self) -> dict[int, NodeMotion]:
        """Of the nodes that move, in the world."""
        return {
            node: NodeMotion(
                rest=self._character.world_rotation[node],
                turn=Rotation.from_matrix(turn),
                place_m=self._hips_m if node == self.hips else None,
            )
            for node, turn in self.turns.items()
        }

    def rotation_in_parent(self, node: int) -> Float[np.ndarray, "t 3 3"]:
        """Of a node that moves."""
        return np.swapaxes(self._turn_of(self._character.parents[node]), 1, 2) @ self.turns[node]

    def hips_in_parent_m(self) -> Float[np.ndarray, "t 3"]:
        """Places of the hips in their parent, which does not move."""
        character = self._character
        above = character.parents[self.hips]
        if above < 0:
            return self._hips_m
        away = self._hips_m - character.world_position_m[above]
        return away @ character.world_rotation[above] / character.world_scale[above]

    def _turn_bones(self, mapped: BoneMap) -> None:
        character = self._character
        laid: dict[str, np.ndarray] = {}
        """What lays our limb along the character's, at rest."""
        for bone, child in _CHILD.items():
            if child in self._bones:
                ends = [character.world_position_m[self._bones[name]] for name in (bone, child)]
                theirs = self._faces.T @ (ends[1] - ends[0])
                ours = self._rest_m[child] - self._rest_m[bone]
                laid[bone] = least_turns(ours[None], theirs[None])[0]
        for side in ("left", "right"):
            laid[f"{side}_hand"] = laid.get(f"{side}_forearm", np.eye(3))
            foot, toes = self._bones[f"{side}_foot"], self._bones.get(f"{side}_toes")
            if toes is not None:  # only how far out: heels are of many heights
                along = character.world_position_m[toes] - character.world_position_m[foot]
                out = self._faces.T @ along
                yaw = Rotation.from_rotvec([0.0, np.arctan2(out[0], out[2]), 0.0]).as_matrix()
                laid[f"{side}_foot"] = laid[f"{side}_toes"] = yaw
        followed = {node: (bone, bone, 0.0) for bone, node in self._bones.items()}
        followed |= dict(zip(mapped.spine, spine_shares(len(mapped.spine)), strict=True))
        for node, (one, other, share) in followed.items():
            turn = self._ours[one]
            if share:
                away = (turn.inv() * self._ours[other]).as_rotvec()
                turn = turn * Rotation.from_rotvec(share * away)
            of_rest = laid.get(one, np.eye(3)).T @ self._faces.T @ character.world_rotation[node]
            self.turns[node] = turn.as_matrix() @ of_rest

    def _turn_of(self, node: int) -> Float[np.ndarray, "t 3 3"]:
        """In the world; a node that is no bone keeps its turn in its parent."""
        if node in self.turns:
            return self.turns[node]
        if node < 0:
            return np.tile(np.eye(3), (self.frames, 1, 1))
        return self._turn_of(self._character.parents[node]) @ self._character.rotation[node]

    def _place_m(self, node: int) -> Float[np.ndarray, "t 3"]:
        if node == self.hips:
            return self._hips_m
        character, above = self._character, self._character.parents[node]
        away = character.world_scale[above] * character.position_m[node]
        return self._place_m(above) + self._turn_of(above) @ away

    def _belongs_m(self, bone: str) -> Float[np.ndarray, "t 3"]:
        """Where a joint of ours is in the character's size, over the same floor."""
        above_ankle = self._ours_m[bone] - [0.0, self._our_ankle_m, 0.0]
        return self.scale * above_ankle + [0.0, self._ankle_m, 0.0]

    def _place_hips_m(self) -> Float[np.ndarray, "t 3"]:
        """Such that the middle between the hip joints is where ours belongs."""
        character, hips = self._character, self.hips
        middle = (self._belongs_m("left_thigh") + self._belongs_m("right_thigh")) / 2
        rest = [character.world_position_m[self._bones[f"{s}_thigh"]] for s in ("left", "right")]
        away = np.mean(rest, axis=0) - character.world_position_m[hips]
        return middle - self.turns[hips] @ (character.world_rotation[hips].T @ away)

    def _too_high_m(self) -> Float[np.ndarray, " t"]:
        """How far the hips must sink for both legs to reach: wider hips ask for longer legs."""
        above = np.zeros(self.frames)
        for side in ("left", "right"):
            hip = self._place_m(self._bones[f"{side}_thigh"])
            away = hip - self._belongs_m(f"{side}_foot")
            aside = (away[:, [0, 2]] ** 2).sum(axis=1)
            leg_m = STRETCHED * self._leg_m[side]
            reach = np.sqrt(np.maximum(leg_m**2 - aside, 0.0))
            above = np.maximum(above, np.where(away[:, 1] > 0, away[:, 1] - reach, 0.0))
        return above

    def _reach(self, side: str) -> None:
        """The ankle goes to where ours belongs; the foot keeps its turn."""
        thigh, shank, foot = (self._bones[f"{side}_{b}"] for b in ("thigh", "shank", "foot"))
        hip, knee, ankle = (self._place_m(node) for node in (thigh, shank, foot))
        forward = self._ours[f"{side}_thigh"].as_matrix()[:, :, 2]
        target = self._belongs_m(f"{side}_foot")
        upper, lower = two_bone_turns(hip, knee, ankle, target, forward=forward)
        self.turns[thigh] = upper @ self.turns[thigh]
        self.turns[shank] = lower @ self.turns[shank]


def _legs_m(place: Mapping[str, np.ndarray], character: Character) -> dict[str, float]:
    """Thigh and shank together, by side."""
    lengths = {
        side: float(
            np.linalg.norm(place[f"{side}_shank"] - place[f"{side}_thigh"])
            + np.linalg.norm(place[f"{side}_foot"] - place[f"{side}_shank"])
        )
        for side in ("left", "right")
    }
    if min(lengths.values()) < 1e-4:
        raise InputError(f"{character.path}: its legs have no length at rest")
    return lengths


def _write(character: Character, moved: _Moved, motion: RigMotion, path: Path) -> None:
    gltf = Gltf(copy.deepcopy(character.tree), character.binary)
    times = gltf.array(motion.time_s.astype(np.float32), bounds=True)
    hips = moved.hips
    samplers, channels = [], []

    def add(node: int, what: str, values: np.ndarray) -> None:
        samplers.append({"input": times, "output": gltf.array(values.astype(np.float32))})
        target = {"node": node, "path": what}
        channels.append({"sampler": len(samplers) - 1, "target": target})

    for node in moved.turns:
        _as_parts(gltf.tree["nodes"][node], character, node)
        xyzw = Rotation.from_matrix(moved.rotation_in_parent(node)).as_quat()
        add(node, "rotation", short_way(xyzw))
    add(hips, "translation", moved.hips_in_parent_m())
    ours = {"name": motion.name, "samplers": samplers, "channels": channels}
    gltf.tree["animations"] = [ours, *gltf.tree.get("animations", ())]
    gltf.write(path)


def _as_parts(node: dict[str, Any], character: Character, index: int) -> None:
    """A node that is animated may not have a matrix."""
    if node.pop("matrix", None) is not None:
        node["translation"] = character.position_m[index].tolist()
        node["rotation"] = Rotation.from_matrix(character.rotation[index]).as_quat().tolist()
        node["scale"] = [float(character.scale[index])] * 3
