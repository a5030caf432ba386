"""A person's motion on a rig, as skeletal formats write it: joints relative to their parents.

It is reckoned some frames at a time and held in single precision, half an hour in 75 MB.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fusecap.body.rigs import RigPreset, rig_preset
from fusecap.body.shape import bones_of_extended, shape_with_clavicles
from fusecap.body.skeleton import EXTENDED23
from fusecap.errors import TakeError
from fusecap.exports.rest_rig import RestRig, rest_rig
from fusecap.exports.take_format import AnyTake
from fusecap.geometry.quaternions import from_wxyz
from fusecap.take import BLOCK, Take

_MOVES_M = 1e-5
"""A joint that wanders this far in its parent's frame has its place written for every frame."""


@dataclass(frozen=True, kw_only=True)
class RigMotion:
    """Joints over T frames; a root's values are in the world."""

    rest: RestRig
    name: str
    time_s: Float[np.ndarray, " t"]
    rate_hz: float
    position_m: Float[np.ndarray, "t j 3"]
    """In the parent's frame."""
    rotation_xyzw: Float[np.ndarray, "t j 4"]
    """Relative to the parent, the rest pose included; from frame to frame the short way."""
    tracked: Bool[np.ndarray, " t"]
    """Others hold the last pose."""

    def turns_of_tracked(self) -> Int[np.ndarray, " n"]:
        """The first frame, and those where the person comes or goes; no frame who always stays."""
        if self.tracked.all():
            return np.empty(0, dtype=np.int64)
        return np.concatenate([[0], np.flatnonzero(np.diff(self.tracked)) + 1])

    @cached_property
    def moving(self) -> tuple[int, ...]:
        """Joints whose place in the parent's frame changes; the others keep that at rest."""
        lowest, highest = self.position_m.min(axis=0), self.position_m.max(axis=0)
        rest = self.rest.position_in_parent_m
        reach = np.maximum(highest - rest, rest - lowest).max(axis=1)
        return tuple(np.flatnonzero(reach > _MOVES_M).tolist())

    def blocks(self) -> Iterator[RigMotion]:
        """All of it, some frames at a time."""
        for first in range(0, len(self.time_s), BLOCK):
            part = slice(first, first + BLOCK)
            names = ("time_s", "position_m", "rotation_xyzw", "tracked")
            yield replace(self, **{name: getattr(self, name)[part] for name in names})

    def in_world(self) -> tuple[list[Float[np.ndarray, "t 3"]], list[Rotation]]:
        """Places [m] and turns of the joints in the world."""
        places: list[np.ndarray] = []
        turns: list[Rotation] = []
        for joint, parent in enumerate(self.rest.parents):
            place = self.position_m[:, joint]
            turn = Rotation.from_quat(self.rotation_xyzw[:, joint])
            if parent >= 0:
                place = places[parent] + turns[parent].apply(place)
                turn = turns[parent] * turn
            places.append(place)
            turns.append(turn)
        return places, turns

    def rotation_from_rest(self, joint: int) -> Float[np.ndarray, "t 3 3"]:
        """Relative to the parent, between frames that are parallel to the world at rest."""
        rest, parent = Rotation.from_matrix(self.rest.rotation), self.rest.parents[joint]
        turn = Rotation.from_quat(self.rotation_xyzw[:, joint]) * rest[joint].inv()
        return (turn if parent < 0 else rest[parent] * turn).as_matrix()


def held_frames(take: AnyTake, subject: int) -> Int[np.ndarray, " t"]:
    """For every frame the tracked frame whose pose it shows: the last one, at first the first.

    Raises `TakeError` for a subject that is never tracked.
    """
    tracked = take.tracked[subject]
    if not tracked.any():
        raise TakeError(f"'{take.subject_names[subject]}' is tracked in no frame: nothing to write")
    latest = np.maximum.accumulate(np.where(tracked, np.arange(len(tracked)), -1))
    return np.where(latest < 0, np.argmax(tracked), latest)


def rig_motions(take: AnyTake, rig: str) -> Iterator[RigMotion]:
    """Everybody who is tracked at all; raises `TakeError` where nobody is."""
    preset = rig_preset(rig)
    people = [row for row in range(len(take.subject_names)) if take.tracked[row].any()]
    if not people:
        raise TakeError("nobody is tracked in any frame of the take: there is nothing to write")
    return (rig_motion(take, row, preset) for row in people)


def rig_motion(take: AnyTake, subject: int, preset: RigPreset) -> RigMotion:
    """One subject of a take on a rig; frames without them hold the last pose."""
    rest = rest_rig(preset, shape_with_clavicles(take.shape(subject)))
    frames, mine = held_frames(take, subject), take.of_subjects([subject])
    position_m = np.empty((len(frames), len(rest.names), 3), dtype=np.float32)
    xyzw = np.empty((len(frames), len(rest.names), 4), dtype=np.float32)
    for first in range(0, len(frames), BLOCK):
        part = slice(first, first + BLOCK)
        told, shown = np.unique(frames[part], return_inverse=True)
        position_m[part], xyzw[part] = _on_joints(mine.at_frames(told), shown, rest)
    for joint in range(len(rest.names)):
        xyzw[:, joint] = short_way(xyzw[:, joint])
    return RigMotion(
        rest=rest,
        name=take.subject_names[subject],
        time_s=take.time_s,
        rate_hz=take.rate_hz,
        position_m=position_m,
        rotation_xyzw=xyzw,
        tracked=take.tracked[subject],
    )


def _on_joints(
    take: Take, frames: Int[np.ndarray, " t"], rest: RestRig
) -> tuple[Float[np.ndarray, "t j 3"], Float[np.ndarray, "t j 4"]]:
    """Places and turns in the parents' frames, of the one subject in these frames."""
    source = bones_of_extended(take.skeleton)
    position = take.bone_position_in_world_m[0][frames][:, source]
    wxyz = take.bone_rotation_in_world_wxyz[0][frames][:, source]
    turns = [
        from_wxyz(wxyz[:, bone]) * Rotation.from_matrix(rest.bone_rest[bone]).inv()
        for bone in range(EXTENDED23.bone_count)
    ]
    """What each bone has turned since the rest pose."""
    if "left_clavicle" not in take.bone_names:
        for side in ("left", "right"):
            bone = EXTENDED23.bone(f"{side}_clavicle")
            position[:, bone] += from_wxyz(wxyz[:, bone]).apply(rest.shape.offsets_m[bone])
    bone_rest_m = rest.bone_rest_positions_m
    place_m = np.empty((len(frames), len(rest.names), 3))
    world: list[Rotation] = []
    for index, joint in enumerate(rest.preset.joints):
        if not joint.turns_with:
            place_m[:, index] = rest.position_m[index]
            still = Rotation.from_matrix(rest.rotation[index])
            world.append(Rotation.identity(len(frames)) * still)
            continue
        bones = [EXTENDED23.bone(name) for name in joint.turns_with]
        turn = turns[bones[0]]
        place_m[:, index] = position[:, bones[0]] + turn.apply(
            rest.position_m[index] - bone_rest_m[bones[0]]
        )
        if len(bones) == 2:
            away = (turn.inv() * turns[bones[1]]).as_rotvec()
            turn = turn * Rotation.from_rotvec(away / 2)
        world.append(turn * Rotation.from_matrix(rest.rotation[index]))
    position_m, xyzw = place_m.copy(), np.empty((*place_m.shape[:2], 4))
    for index, parent in enumerate(rest.parents):
        local = world[index]
        if parent >= 0:
            up = world[parent].inv()
            position_m[:, index] = up.apply(place_m[:, index] - place_m[:, parent])
            local = up * local
        xyzw[:, index] = local.as_quat()
    return position_m, xyzw


def short_way(quaternion: Float[np.ndarray, "t 4"]) -> Float[np.ndarray, "t 4"]:
    """The same rotations with signs such that neighbours are near."""
    flips = np.einsum("ti,ti->t", quaternion[1:], quaternion[:-1]) < 0
    signs = np.where(np.logical_xor.accumulate(np.concatenate([[False], flips])), -1.0, 1.0)
    return quaternion * signs[:, None]
