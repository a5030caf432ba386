"""Which bone a sensor's name means: `L_LowArm`, `LTibia`, `femur_r_imu`, `Lumbar`, `RightForeArm`.

Names are read by whole words: a side first, then the longest run of words that is a place on the
body, so that `redhead_right_hand` is a hand and `Participant8` no vertebra. Names of Xsens MVN and
Awinda, Total Capture, OpenSense, APDM, SlimeVR, and plain words.
"""

from __future__ import annotations

import re

_SIDED = {
    "upper_arm": "upperarm uparm humerus arm bicep biceps triceps",
    "forearm": "forearm fore_arm lowarm lowerarm radius ulna wrist",
    "hand": "hand palm metacarpal",
    "shoulder": "shoulder clavicle scapula collar",
    "thigh": "upleg upperleg thigh femur knee quad quadriceps",
    "shank": "lowleg lowerleg shank tibia calf shin leg ankle fibula",
    "foot": "foot calcn instep shoe talus",
    "toes": "toe toes forefoot",
}
_MIDDLE = {
    "hips": "pelvis hips hip sacrum lumbar waist l5 lowerback lowback belt",
    "spine3": "sternum chest thorax torso trunk spine3 t8 upperback",
    "head": "head skull helmet forehead",
}
_PLACES = {
    spelling.replace("_", ""): bone
    for table in (_SIDED, _MIDDLE)
    for bone, spellings in table.items()
    for spelling in spellings.split()
}
_SIDES = {"left": "left", "l": "left", "lt": "left", "right": "right", "r": "right", "rt": "right"}


def bone_of(name: str) -> str | None:
    """The bone of either skeleton, or None where the name tells none or no side."""
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]
    words = [part for word in _with_numbers(words) for part in _split_side(word)]
    sides = {_SIDES[word] for word in words if word in _SIDES}
    found = _place(words)
    if found in _MIDDLE and sides and "hip" in words:
        return None  # the side of the pelvis, or the joint of a thigh
    if found is None or found in _MIDDLE:
        return found
    return f"{sides.pop()}_{found}" if len(sides) == 1 else None


def _with_numbers(words: list[str]) -> list[str]:
    """A number belongs to the word before it where both together are a place: `T`, `8`."""
    joined: list[str] = []
    for word in words:
        if joined and word.isdigit() and joined[-1] + word in _PLACES:
            joined[-1] += word
        else:
            joined.append(word)
    return joined


def _split_side(word: str) -> tuple[str, ...]:
    """`leftankle`, `rthigh`, `ltibia` as two words; `leg` and `lumbar` as they are."""
    if word in _PLACES or word in _SIDES:
        return (word,)
    for side in ("left", "right", "l", "r"):
        if word.startswith(side) and word[len(side) :] in _PLACES:
            return side, word[len(side) :]
        if word.endswith(side) and word[: -len(side)] in _PLACES:
            return word[: -len(side)], side
    return (word,)


def _place(words: list[str]) -> str | None:
    """Of the longest run of words; of equal ones the last, as names go from coarse to fine."""
    runs = [
        (end - start, start, _PLACES["".join(words[start:end])])
        for start in range(len(words))
        for end in range(start + 1, min(start + 3, len(words)) + 1)
        if "".join(words[start:end]) in _PLACES
    ]
    return max(runs)[2] if runs else None
