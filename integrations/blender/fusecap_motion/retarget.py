"""A person's motion on the rig of a character: same directions, own proportions, feet that stand.

As `fusecap retarget` does it (docs/characters.md), for armatures of the scene, with NumPy and
mathutils alone: Blender has neither SciPy nor fusecap, and z is up here. A test holds the two
within a millimetre of each other. Rest poses are brought together first: the person is turned to
face as the character does, and each limb is laid along the character's. Then bones turn in the
world as the person's do, the way through the room is scaled as legs are, and legs reach for where
the person's ankles belong.
"""

import bpy
import numpy as np

from .bone_words import NEEDED, guess_bones, loose_bones, spine_of, spine_shares
from .skeleton import bake_channels, matrices, quaternions

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
_STRETCHED = 0.9995
_SIDES = ("left", "right")


class Follower:
    """An armature that does what a person does.

    `names` and `rest` (J, 4, 4) are the person's joints in the world. Raises ValueError for a rig
    whose bones cannot be told; `by_hand` names its bones by ours.
    """

    def __init__(self, armature, names, rest, by_hand):
        self.object, self.by_hand = armature, by_hand
        self._ours = {name: joint for joint, name in enumerate(names)}
        self._rest_ours = np.asarray(rest)
        bones = sorted(armature.data.bones, key=lambda bone: len(bone.parent_recursive))
        self.names = [bone.name for bone in bones]
        self._parents = [self.names.index(b.parent.name) if b.parent else -1 for b in bones]
        world = np.array(armature.matrix_world)
        self._scale = np.cbrt(np.linalg.det(world[:3, :3]))
        self._world_turn = world[:3, :3] / self._scale
        rest = world @ np.array([np.array(bone.matrix_local) for bone in bones])
        self._rest_m = rest[:, :3, 3]
        self._rest_turn = rest[:, :3, :3] / self._scale
        self.bones = self._told(by_hand)
        self._hips = self.bones["hips"]
        self._legs_m = self._leg_lengths(self._rest_m, self.bones)
        ours = self._leg_lengths(self._rest_ours[:, :3, 3], self._ours)
        self.scale = sum(self._legs_m.values()) / sum(ours.values())
        self._faces = self._turn_to_face()
        self._followed = self._what_follows()
        for bone in {*self._followed}:
            armature.pose.bones[self.names[bone]].rotation_mode = "QUATERNION"

    @property
    def held(self):
        """Names of bones that constraints hold: they may not go where they are told."""
        posed = self.object.pose.bones
        return [self.names[b] for b in self._followed if posed[self.names[b]].constraints]

    def show(self, pose):
        """One frame (1, J, 4, 4), at once."""
        places, turns = self.channels(pose)
        for bone, wxyz in turns.items():
            self.object.pose.bones[self.names[bone]].rotation_quaternion = wxyz[0]
        self.object.pose.bones[self.names[self._hips]].location = places[0]

    def bake(self, frames, pose, label):
        """An action with a key for each of `frames` (T,)."""
        places, turns = self.channels(pose)
        told = {self.names[bone]: {"rotation_quaternion": wxyz} for bone, wxyz in turns.items()}
        told[self.names[self._hips]]["location"] = places
        bake_channels(self.object, label, frames, told)

    def channels(self, pose):
        """The hips' locations (T, 3), and quaternions (T, 4) by bones; of poses (T, J, 4, 4)."""
        turned = pose[..., :3, :3] @ np.swapaxes(self._rest_ours[:, :3, :3], 1, 2)
        turns = {}
        for bone, (one, other, share, laid) in self._followed.items():
            turn = turned[:, self._ours[one]]
            if share:
                away = np.swapaxes(turn, 1, 2) @ turned[:, self._ours[other]]
                turn = turn @ _share_of(away, share)
            turns[bone] = turn @ laid.T @ self._faces.T @ self._rest_turn[bone]
        hips_m = self._place_hips(pose, turns)
        for side in _SIDES:
            self._reach(pose, turned, turns, hips_m, side)
        return self._as_channels(turns, hips_m)

    def _told(self, by_hand):
        found = guess_bones(dict(enumerate(self.names)), self._parents)
        for bone, name in by_hand.items():
            if bone not in self._ours or name not in self.names:
                raise ValueError(f"{bone}={name}: there is no such bone")
            found[bone] = self.names.index(name)
        missing = [bone for bone in NEEDED if bone not in found]
        if missing:
            raise ValueError(
                f"{self.object.name}: cannot tell which bone is {', '.join(missing)}; "
                f"say it: {missing[0]}=NAME"
            )
        loose = loose_bones(found, self._parents)
        if loose:
            named = ", ".join(f"{bone} ({self.names[found[bone]]})" for bone in loose)
            raise ValueError(
                f"{self.object.name}: these do not hang on the hips ({self.names[found['hips']]}): "
                f"{named}; name the right ones, or take the rig that its controls were made from "
                "(Rigify's metarig)"
            )
        if self.object.data.bones[self.names[found["hips"]]].use_connect:
            raise ValueError(
                f"{self.object.name}: '{self.names[found['hips']]}' is connected to its parent and "
                "cannot move; disconnect it in edit mode"
            )
        return found

    def _leg_lengths(self, place, bones):
        lengths = {}
        for side in _SIDES:
            hip, knee, ankle = (place[bones[f"{side}_{b}"]] for b in ("thigh", "shank", "foot"))
            lengths[side] = np.linalg.norm(knee - hip) + np.linalg.norm(ankle - knee)
        if min(lengths.values()) < 1e-4:
            raise ValueError(f"{self.object.name}: its legs have no length at rest")
        return lengths

    def _turn_to_face(self):
        """About up, from the person's rest pose to the character's."""
        yaws = []
        for place, bones in ((self._rest_ours[:, :3, 3], self._ours), (self._rest_m, self.bones)):
            left = place[bones["left_thigh"]] - place[bones["right_thigh"]]
            yaws.append(np.arctan2(left[1], left[0]))
        return _from_rotvec(np.array([[0.0, 0.0, yaws[1] - yaws[0]]]))[0]

    def _what_follows(self):
        """Per bone two joints of ours, how far from one to the other, what lays our limb along."""
        laid = {}
        for bone, child in _CHILD.items():
            if child in self.bones and bone in self.bones:
                ends = self._rest_m[[self.bones[bone], self.bones[child]]]
                ours = self._rest_ours[[self._ours[bone], self._ours[child]], :3, 3]
                theirs = self._faces.T @ (ends[1] - ends[0])
                laid[bone] = _least_turns((ours[1] - ours[0])[None], theirs[None])[0]
        for side in _SIDES:
            laid[f"{side}_hand"] = laid.get(f"{side}_forearm", np.eye(3))
            foot, toes = self.bones[f"{side}_foot"], self.bones.get(f"{side}_toes")
            if toes is not None:  # only how far out: heels are of many heights
                out = self._faces.T @ (self._rest_m[toes] - self._rest_m[foot])
                yaw = np.arctan2(out[0], -out[1])
                laid[f"{side}_foot"] = laid[f"{side}_toes"] = _from_rotvec(
                    np.array([[0.0, 0.0, yaw]])
                )[0]
        known = {bone: node for bone, node in self.bones.items() if bone in self._ours}
        follow = {
            node: (bone, bone, 0.0, laid.get(bone, np.eye(3))) for bone, node in known.items()
        }
        spine = spine_of(self.bones, self._parents)
        for node, shares in zip(spine, spine_shares(len(spine)), strict=True):
            follow[node] = (*shares, np.eye(3))
        return follow

    def _belongs(self, pose, bone):
        """Where a joint of ours is in the character's size, over the same floor."""
        ankles = ("left_foot", "right_foot")
        ours = np.mean([self._rest_ours[self._ours[b], 2, 3] for b in ankles])
        theirs = np.mean([self._rest_m[self.bones[b], 2] for b in ankles])
        place = pose[:, self._ours[bone], :3, 3]
        return self.scale * (place - [0.0, 0.0, ours]) + [0.0, 0.0, theirs]

    def _place_hips(self, pose, turns):
        """The middle between hip joints where ours belongs; lower where legs are too short."""
        thighs = [f"{side}_thigh" for side in _SIDES]
        middle = np.mean([self._belongs(pose, bone) for bone in thighs], axis=0)
        rest = np.mean([self._rest_m[self.bones[bone]] for bone in thighs], axis=0)
        away = self._rest_turn[self._hips].T @ (rest - self._rest_m[self._hips])
        hips_m = middle - turns[self._hips] @ away
        above = np.zeros(len(pose))
        for side in _SIDES:
            hip = self._place(self.bones[f"{side}_thigh"], turns, hips_m)
            to_hip = hip - self._belongs(pose, f"{side}_foot")
            aside = (to_hip[:, :2] ** 2).sum(axis=1)
            reach = np.sqrt(np.maximum((_STRETCHED * self._legs_m[side]) ** 2 - aside, 0.0))
            sinks = np.where(to_hip[:, 2] > 0, to_hip[:, 2] - reach, 0.0)
            above = np.maximum(above, sinks)
        return hips_m - above[:, None] * [0.0, 0.0, 1.0]

    def _reach(self, pose, turned, turns, hips_m, side):
        thigh, shank, foot = (self.bones[f"{side}_{b}"] for b in ("thigh", "shank", "foot"))
        hip, knee, ankle = (self._place(node, turns, hips_m) for node in (thigh, shank, foot))
        forward = -turned[:, self._ours[f"{side}_thigh"], :, 1]
        target = self._belongs(pose, f"{side}_foot")
        upper, lower = _two_bone_turns(hip, knee, ankle, target, forward)
        turns[thigh], turns[shank] = upper @ turns[thigh], lower @ turns[shank]

    def _turn_of(self, bone, turns, frames):
        """In the world (T, 3, 3); who follows nothing keeps the turn in the parent."""
        if bone in turns:
            return turns[bone]
        parent = self._parents[bone]
        if parent < 0:
            return np.tile(self._rest_turn[bone], (frames, 1, 1))
        inside = self._rest_turn[parent].T @ self._rest_turn[bone]
        return self._turn_of(parent, turns, frames) @ inside

    def _place(self, bone, turns, hips_m):
        if bone == self._hips:
            return hips_m
        parent = self._parents[bone]
        away = self._rest_turn[parent].T @ (self._rest_m[bone] - self._rest_m[parent])
        above = self._turn_of(parent, turns, len(hips_m))
        return self._place(parent, turns, hips_m) + above @ away

    def _as_channels(self, turns, hips_m):
        frames, found = len(hips_m), {}
        for bone, turn in turns.items():
            parent = self._parents[bone]
            above, rest = self._above(parent, turns, frames)
            inside = rest.T @ self._rest_turn[bone]
            found[bone] = quaternions(inside.T @ np.swapaxes(above, 1, 2) @ turn)
        parent = self._parents[self._hips]
        above, rest = self._above(parent, turns, frames)
        start = self._rest_m[parent] if parent >= 0 else np.zeros(3)
        away = self._rest_m[self._hips] - start
        moved = np.einsum("tji,tj->ti", above, hips_m - start) - rest.T @ away
        return moved @ (rest.T @ self._rest_turn[self._hips]) / self._scale, found

    def _above(self, parent, turns, frames):
        """Turns of a parent, or of the armature, in frames and at rest."""
        if parent < 0:
            return np.tile(self._world_turn, (frames, 1, 1)), self._world_turn
        return self._turn_of(parent, turns, frames), self._rest_turn[parent]


def baked_motion(armature):
    """Frames (T,), joints' names, rest (J, 4, 4) and poses (T, J, 4, 4) of a person's armature.

    Of what this extension baked: every curve has the same keys. Raises ValueError for others.
    """
    data = armature.animation_data
    if data is None or data.action is None:
        raise ValueError(f"{armature.name} has no action: import a take or bake a stream first")
    action = data.action
    if hasattr(action, "slots"):
        (strip,) = action.layers[0].strips
        curves = strip.channelbag(data.action_slot).fcurves
    else:
        curves = action.fcurves
    bones = sorted(armature.data.bones, key=lambda bone: len(bone.parent_recursive))
    names = [bone.name for bone in bones]
    if not {"hips", *NEEDED} <= {*names}:
        raise ValueError(f"{armature.name} is no person of fusecap")
    frames = _keys(curves[0])[:, 0]
    world = np.array(armature.matrix_world)
    rest = np.array([np.array(bone.matrix_local) for bone in bones])
    pose = np.empty((len(frames), len(bones), 4, 4))
    for joint, bone in enumerate(bones):
        basis = np.tile(np.eye(4), (len(frames), 1, 1))
        path = f'pose.bones["{bpy.utils.escape_identifier(bone.name)}"]'
        wxyz = np.empty((len(frames), 4))
        for axis in range(4):
            keys = _keys(curves.find(f"{path}.rotation_quaternion", index=axis))
            if len(keys) != len(frames):
                raise ValueError(f"{armature.name}: its curves have different keys")
            wxyz[:, axis] = keys[:, 1]
        basis[:, :3, :3] = matrices(wxyz)
        for axis in range(3):
            curve = curves.find(f"{path}.location", index=axis)
            if curve is not None:
                basis[:, axis, 3] = _keys(curve)[:, 1]
        if bone.parent:
            above = names.index(bone.parent.name)
            pose[:, joint] = pose[:, above] @ np.linalg.inv(rest[above]) @ rest[joint] @ basis
        else:
            pose[:, joint] = rest[joint] @ basis
    return frames, names, world @ rest, world @ pose


def _keys(curve):
    if curve is None:
        raise ValueError("a bone has no curves")
    found = np.empty(2 * len(curve.keyframe_points), dtype=np.float32)
    curve.keyframe_points.foreach_get("co", found)
    return found.reshape(-1, 2).astype(float)


def _two_bone_turns(root, middle, end, target, forward):
    """Turns in the world that bring a limb's end to a target; it bends as it did, or forward."""
    upper, lower = np.linalg.norm(middle - root, axis=1), np.linalg.norm(end - middle, axis=1)
    shortest, longest = np.abs(upper - lower) * 1.001, (upper + lower) * _STRETCHED
    reach = np.clip(np.linalg.norm(target - root, axis=1), shortest, longest)
    along = _unit(target - root)
    beside = _across(middle - root, along)
    straight = np.linalg.norm(beside, axis=1) < 1e-4
    bend = _unit(np.where(straight[:, None], _across(forward, along), beside))
    cosine = np.clip((upper**2 + reach**2 - lower**2) / (2 * upper * reach), -1.0, 1.0)
    sine = np.sqrt(1 - cosine**2)
    knee = root + upper[:, None] * (cosine[:, None] * along + sine[:, None] * bend)
    foot = root + reach[:, None] * along
    return _least_turns(middle - root, knee - root), _least_turns(end - middle, foot - knee)


def _least_turns(one, other):
    axis = np.cross(one, other)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("ni,ni->n", one, other))
    return _from_rotvec(axis * (angle / np.maximum(sine, 1e-15))[:, None])


def _from_rotvec(vectors):
    angle = np.linalg.norm(vectors, axis=1)
    axis = vectors / np.maximum(angle, 1e-15)[:, None]
    half = np.concatenate([np.cos(angle / 2)[:, None], np.sin(angle / 2)[:, None] * axis], axis=1)
    return matrices(half)


def _share_of(turns, share):
    """Each rotation (T, 3, 3) as far as `share` of it."""
    wxyz = quaternions(turns)
    wxyz = wxyz * np.where(wxyz[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(wxyz[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, wxyz[:, 0])
    return _from_rotvec(wxyz[:, 1:] / np.maximum(sine, 1e-15)[:, None] * (share * angle)[:, None])


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def _across(vectors, along):
    return vectors - along * np.einsum("ni,ni->n", vectors, along)[:, None]
