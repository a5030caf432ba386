"""Which bones of a character are which of ours, by their names alone.

A name is cut into words (`mixamorig:LeftForeArm` is mixamorig, left, fore, arm), a word for the
side is taken out, what all names begin with is left away, and the rest is looked up. Hips without a
name that says so are where the thighs meet; of joints called spine, those above the arms are necks,
the last one the head (Rigify's metarig is spine, spine.001, ... spine.006).

The Blender extension has this module too: it imports Python's own library alone.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence

_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
_BONES = {
    "hips": "hips",
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
    "toes": "toes",
    "neck": "neck",
    "head": "head",
    "hand": "hand",
    "shank": "shank",
    "foot": "foot",
}
"""Words without side, run together."""
NEEDED = (
    "hips",
    *(
        f"{side}_{bone}"
        for side in ("left", "right")
        for bone in ("upper_arm", "forearm", "thigh", "shank", "foot")
    ),
)
"""Without these no motion goes onto a character."""


def guess_bones(names: Mapping[int, str], parents: Sequence[int]) -> dict[str, int]:
    """Joints by our bones' names; `names` are of joints, parents before children."""
    words = {joint: _words(name) for joint, name in names.items()}
    first = Counter(w[0] for w in words.values() if len(w) > 1)
    common = {word for word, times in first.items() if times > 0.6 * len(words)}
    common -= {*_SIDES}
    found: dict[str, int] = {}
    for joint, named in words.items():
        while named and named[0] in common | {"def", "org", "cc", "base", "bip", "b", "j"}:
            named = named[1:]
        sides = [_SIDES[word] for word in named if word in _SIDES]
        rest = "".join(word for word in named if word not in _SIDES and not word.isdigit())
        kind = _BONES.get(rest)
        if kind is None or len(sides) > 1:
            continue
        if rest == "hip" and sides:
            kind = "thigh"
        sided = kind not in ("hips", "neck", "head")
        if sided != bool(sides):
            continue
        found.setdefault(f"{sides[0]}_{kind}" if sides else kind, joint)
    for side in ("left", "right"):
        _take_shoulder_for_arm(words, parents, found, side)
    thighs = [_up_from(found.get(f"{side}_thigh", -1), parents) for side in ("left", "right")]
    for joint in thighs[0]:
        if "hips" not in found and joint in thighs[1] and joint in names:
            found["hips"] = joint
    if not {"neck", "head"} & {*found} and "left_upper_arm" in found:
        _take_spines_for_neck(words, parents, found)
    return found


def loose_bones(found: Mapping[str, int], parents: Sequence[int]) -> list[str]:
    """Of those that are needed, the ones that do not hang on the hips."""
    return [b for b in NEEDED if b != "hips" and found["hips"] not in _up_from(found[b], parents)]


def spine_of(found: Mapping[str, int], parents: Sequence[int]) -> tuple[int, ...]:
    """From the lowest up: between the hips and what hangs on the top of the spine."""
    top = found.get("neck", found.get("head", found.get("left_clavicle", found["left_upper_arm"])))
    chain, joint = [], parents[top]
    while joint >= 0 and joint != found["hips"]:
        chain.append(joint)
        joint = parents[joint]
    return tuple(chain[::-1]) if joint == found["hips"] else ()


def spine_shares(count: int) -> list[tuple[str, str, float]]:
    """Per bone of a spine two neighbours of ours, and how far it turns from one to the other.

    The lowest of n turns as ours does at 1/n of the way up, the highest as our highest.
    """
    ours, shares = ("spine", "spine1", "spine2", "spine3"), []
    for index in range(count):
        at = 4 * (index + 1) / count
        low = min(int(at), 3)
        below = ours[max(low - 1, 0)]
        shares.append((below, ours[low] if low else below, at - low if low else 0.0))
    return shares


def _up_from(joint: int, parents: Sequence[int]) -> list[int]:
    """What a joint hangs on, the nearest first."""
    chain = []
    while joint >= 0 and parents[joint] >= 0:
        joint = parents[joint]
        chain.append(joint)
    return chain


def _take_spines_for_neck(
    words: Mapping[int, list[str]], parents: Sequence[int], found: dict[str, int]
) -> None:
    above_arm, hips = _up_from(found["left_upper_arm"], parents), found.get("hips")
    line = [
        joint
        for joint, named in words.items()
        if [word for word in named if not word.isdigit()][-1:] == ["spine"]
        and joint not in above_arm
        and hips in _up_from(joint, parents)
    ]
    if line:
        found["head"] = line[-1]
    if len(line) > 1:
        found["neck"] = line[0]


def _take_shoulder_for_arm(
    words: Mapping[int, list[str]], parents: Sequence[int], found: dict[str, int], side: str
) -> None:
    """Where collar, shoulder and elbow are the names, the shoulder is the upper arm's joint."""
    elbow = found.get(f"{side}_forearm")
    if f"{side}_upper_arm" in found or elbow is None:
        return
    above = parents[elbow]
    if "shoulder" in words.get(above, ()):
        if found.get(f"{side}_clavicle") == above:
            del found[f"{side}_clavicle"]
        found[f"{side}_upper_arm"] = above


def _words(name: str) -> list[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    return re.findall(r"[a-z]+|\d+", spaced.lower())
