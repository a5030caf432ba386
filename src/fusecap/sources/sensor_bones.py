"""Which bone a sensor's name means: `L_LowArm`, `LTibia`, `femur_r_imu`, `Sternum`, `RightForeArm`.

Names of Xsens MVN and Awinda, Total Capture, OpenSense, and plain words.
"""

from __future__ import annotations

import re

_SIDED = (
    ("upper_arm", ("upperarm", "uparm", "humerus")),
    ("forearm", ("forearm", "lowarm", "lowerarm", "radius", "ulna", "wrist")),
    ("hand", ("hand",)),
    ("thigh", ("upleg", "upperleg", "thigh", "femur")),
    ("shank", ("lowleg", "lowerleg", "shank", "tibia", "calf")),
    ("toes", ("toe",)),
    ("foot", ("foot", "calcn")),
    ("upper_arm", ("arm",)),
    ("shank", ("leg",)),
)
_MIDDLE = (
    ("hips", ("pelvis", "hips", "sacrum")),
    ("spine3", ("sternum", "chest", "thorax", "torso", "spine3", "t8")),
    ("head", ("head",)),
)


def bone_of(name: str) -> str | None:
    """The bone of either skeleton, or None where the name tells none or no side."""
    words = re.findall(r"[A-Z]?[a-z]+\d*|[A-Z]+(?![a-z])|\d+", name)
    together = "".join(words).lower()
    for bone, spellings in _MIDDLE:
        if any(spelling in together for spelling in spellings):
            return bone
    for bone, spellings in _SIDED:
        if any(spelling in together for spelling in spellings):
            side = _side([word.lower() for word in words], spellings)
            return f"{side}_{bone}" if side else None
    return None


def _side(words: list[str], spellings: tuple[str, ...]) -> str | None:
    for side in ("left", "right"):
        starts = tuple(side[0] + spelling for spelling in spellings)
        if any(word.startswith((side, *starts)) or word == side[0] for word in words):
            return side
    return None
