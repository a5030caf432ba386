"""Which nodes of a character are which of our bones: told by VRM, named by hand, or guessed.

A name is cut into words (`mixamorig:LeftForeArm` is mixamorig, left, fore, arm), a word for the
side is taken out, what all names begin with is left away, and the rest is looked up. Spines are
found by where they are: all joints between the hips and the neck.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from fusecap.errors import InputError, nearest
from fusecap.exports.characters.character import Character
from fusecap.exports.rigs import PRESETS

_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_MORE = {
    "pelvis": "hips",
    "hip": "hips",
    "upperarm": "upper_arm",
    "arm": "upper_arm",
    "shoulder": "clavicle",
    "collar": "clavicle",
    "clavicle": "clavicle",
    "elbow": "forearm",
    "lowerarm": "forearm",
    "forearm": "forearm",
    "wrist": "hand",
    "palm": "hand",
    "thigh": "thigh",
    "upleg": "thigh",
    "upperleg": "thigh",
    "knee": "shank",
    "calf": "shank",
    "shin": "shank",
    "leg": "shank",
    "lowerleg": "shank",
    "ankle": "foot",
    "ball": "toes",
    "toe": "toes",
    "toebase": "toes",
}
NEEDED = (
    "hips",
    *(
        f"{side}_{bone}"
        for side in ("left", "right")
        for bone in ("upper_arm", "forearm", "thigh", "shank", "foot")
    ),
)


@dataclass(frozen=True, kw_only=True)
class BoneMap:
    """Nodes by our bones' names, and the spine from the hips up."""

    bones: dict[str, int]
    spine: tuple[int, ...]


def bone_map(character: Character, by_hand: Mapping[str, str]) -> BoneMap:
    """Raises `InputError` that says what was found where a bone that is needed was not."""
    found = _from_vrm(character) or _guessed(character)
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
    return BoneMap(bones=found, spine=_spine(character, found))


def _ours() -> set[str]:
    return {joint.sits_at for joint in PRESETS["native"].joints}


def _from_vrm(character: Character) -> dict[str, int]:
    of_vrm = {joint.name: joint.sits_at for joint in PRESETS["vrm"].joints}
    return {
        of_vrm[name]: node
        for name, node in character.told.items()
        if name in of_vrm and not of_vrm[name].startswith("spine")
    }


def _guessed(character: Character) -> dict[str, int]:
    words = {node: _words(character.names[node]) for node in character.joints}
    first = Counter(w[0] for w in words.values() if len(w) > 1)
    common = {word for word, times in first.items() if times > 0.6 * len(words)}
    common -= {*_SIDES}
    table = _table()
    found: dict[str, int] = {}
    for node in (n for n in character.order if n in words):
        named = words[node]
        while named and named[0] in common | {"def", "org", "cc", "base", "bip", "b", "j"}:
            named = named[1:]
        sides = [_SIDES[word] for word in named if word in _SIDES]
        rest = "".join(word for word in named if word not in _SIDES and not word.isdigit())
        kind = table.get(rest)
        if kind is None or len(sides) > 1:
            continue
        if rest == "hip" and sides:
            kind = "thigh"
        sided = kind not in ("hips", "neck", "head")
        if sided != bool(sides):
            continue
        found.setdefault(f"{sides[0]}_{kind}" if sides else kind, node)
    for side in ("left", "right"):
        _take_shoulder_for_arm(character, words, found, side)
    return found


def _take_shoulder_for_arm(
    character: Character, words: Mapping[int, list[str]], found: dict[str, int], side: str
) -> None:
    """Where collar, shoulder and elbow are the names, the shoulder is the upper arm's joint."""
    elbow = found.get(f"{side}_forearm")
    if f"{side}_upper_arm" in found or elbow is None:
        return
    above = character.parents[elbow]
    if "shoulder" in words.get(above, ()):
        if found.get(f"{side}_clavicle") == above:
            del found[f"{side}_clavicle"]
        found[f"{side}_upper_arm"] = above


def _table() -> dict[str, str]:
    """Words without side, run together, to bones without side."""
    table = dict(_MORE)
    for preset in PRESETS.values():
        for joint in preset.joints:
            bone = joint.sits_at.removeprefix("left_").removeprefix("right_")
            if not joint.turns_with or joint.towards or bone.startswith("spine"):
                continue
            words = _words(joint.name.rpartition(":")[2])
            plain = "".join(w for w in words if w not in _SIDES and not w.isdigit())
            table.setdefault(plain, bone)
    return table


def _words(name: str) -> list[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    return re.findall(r"[a-z]+|\d+", spaced.lower())


def _spine(character: Character, found: Mapping[str, int]) -> tuple[int, ...]:
    """Between the hips and what hangs on the top of the spine."""
    top = found.get("neck", found.get("head", found.get("left_clavicle", found["left_upper_arm"])))
    chain, node = [], character.parents[top]
    while node >= 0 and node != found["hips"]:
        chain.append(node)
        node = character.parents[node]
    return tuple(chain[::-1]) if node == found["hips"] else ()
