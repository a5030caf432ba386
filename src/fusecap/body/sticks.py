"""How thick a person of the reference height is, drawn as sticks and balls."""

from __future__ import annotations

_RADII_M = {
    "hips": 0.055,
    "spine": 0.065,
    "neck": 0.040,
    "head": 0.035,
    "pelvis": 0.055,
    "clavicle": 0.040,
    "upper_arm": 0.040,
    "forearm": 0.033,
    "hand": 0.024,
    "thigh": 0.056,
    "shank": 0.044,
    "foot": 0.028,
    "toes": 0.018,
}
"""Of a bone's stick, by its name without side and number."""
HEAD_M = (0.075, 0.105, 0.092)
"""Half axes of the head: left, up, forward."""
HEAD_CENTRE_M = (0.0, 0.085, 0.015)
NOSE_M = (0.0, 0.065, 0.110)
"""From the head's joint, as the centre is."""
NOSE_RADIUS_M = 0.020
RIGHT_SHADE = 0.65
"""The right side is darker, so that a mirrored pose is seen."""


def stick_radius_m(bone: str) -> float:
    """Of one of our bones, or of those that `native` connects them with."""
    return _RADII_M[bone.removeprefix("left_").removeprefix("right_").rstrip("0123456789")]
