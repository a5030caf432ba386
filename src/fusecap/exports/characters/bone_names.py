"""Which nodes of a character are which of our bones: told by VRM, named by hand, or guessed.

Spines are found by where they are: all joints between the hips and the neck.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fusecap.body.rigs import PRESETS
from fusecap.errors import InputError, nearest
from fusecap.exports.characters.bone_words import NEEDED, guess_bones, loose_bones, spine_of
from fusecap.exports.characters.character import Character


@dataclass(frozen=True, kw_only=True)
class BoneMap:
    """Nodes by our bones' names, and the spine from the hips up."""

    bones: dict[str, int]
    spine: tuple[int, ...]


def bone_map(character: Character, by_hand: Mapping[str, str]) -> BoneMap:
    """Raises `InputError` that says what was found where a bone that is needed was not."""
    joints = {node: character.names[node] for node in character.order if node in character.joints}
    found = _from_vrm(character) or guess_bones(joints, character.parents)
    for bone, name in by_hand.items():
        if bone not in _ours():
            raise InputError(f"no bone '{bone}'{nearest(bone, sorted(_ours()))}")
        if name not in character.names:
            raise InputError(
                f"{character.path}: has no node '{name}'{nearest(name, character.names)}"
            )
        found[bone] = character.names.index(name)
    missing = [bone for bone in NEEDED if bone not in found]
    if missing:
        pairs = ", ".join(f"{bone} is {character.names[n]}" for bone, n in found.items()) or "none"
        raise InputError(
            f"{character.path}: cannot tell which bone is {', '.join(missing)} (found: {pairs}); "
            f"say it: --map {missing[0]}=NAME"
        )
    loose = loose_bones(found, character.parents)
    if loose:
        named = ", ".join(f"{bone} ({character.names[found[bone]]})" for bone in loose)
        raise InputError(
            f"{character.path}: these do not hang on the hips ({character.names[found['hips']]}): "
            f"{named}; name the right ones with --map, or take the rig that its controls were made "
            "from (Rigify's metarig)"
        )
    return BoneMap(bones=found, spine=spine_of(found, character.parents))


def _ours() -> set[str]:
    return {joint.sits_at for joint in PRESETS["native"].joints}


def _from_vrm(character: Character) -> dict[str, int]:
    of_vrm = {joint.name: joint.sits_at for joint in PRESETS["vrm"].joints}
    return {
        of_vrm[name]: node
        for name, node in character.told.items()
        if name in of_vrm and not of_vrm[name].startswith("spine")
    }
