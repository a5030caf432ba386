"""The table of joints: which bone turns against which, decomposed how, and what is positive.

A bone's axes here are those of the International Society of Biomechanics on a right-sided body that
stands in the anatomical position: X forward, Y up along the bone, Z to the right [1, 2]. A left
joint is the right joint of the mirrored person, so both sides have the same signs.

[1] Wu et al., J. Biomech. 35 (2002): ankle, hip, spine. [2] Wu et al., J. Biomech. 38 (2005):
shoulder, elbow, wrist, hand. Knee: Grood and Suntay, J. Biomech. Eng. 105 (1983).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.body.skeleton import ELBOW_HINGE

CARDAN, GLOBE = "ZXY", "YXY"
"""Turns about moving axes: flexion, sideways, axial; or plane, elevation, axial rotation."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnglesOfJoint:
    """One joint: the bone below against the bone above, as three angles."""

    name: str
    above: str
    """A bone without its side."""
    below: str
    order: str = CARDAN
    """`CARDAN` or `GLOBE`."""
    angles: tuple[str, str, str] = ("flexion", "adduction", "rotation")
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Of the turns about the ISB axes, so that what `angles` names is positive."""
    sided: bool = True


_BENDING = ("flexion", "bending", "rotation")
_FIRST_REVERSED = (-1.0, 1.0, 1.0)

JOINTS = (
    AnglesOfJoint(name="hip", above="hips", below="thigh"),
    AnglesOfJoint(name="knee", above="thigh", below="shank", signs=_FIRST_REVERSED),
    AnglesOfJoint(
        name="ankle", above="shank", below="foot", angles=("dorsiflexion", "inversion", "rotation")
    ),
    AnglesOfJoint(
        name="shoulder",
        above="spine3",
        below="upper_arm",
        order=GLOBE,
        angles=("plane", "elevation", "rotation"),
        signs=(1.0, -1.0, 1.0),
    ),
    AnglesOfJoint(name="arm", above="spine3", below="upper_arm"),
    AnglesOfJoint(
        name="elbow",
        above="upper_arm",
        below="forearm",
        angles=("flexion", "adduction", "pronation"),
    ),
    AnglesOfJoint(
        name="wrist",
        above="forearm",
        below="hand",
        angles=("flexion", "ulnar_deviation", "rotation"),
    ),
    AnglesOfJoint(
        name="trunk",
        above="hips",
        below="spine3",
        angles=_BENDING,
        signs=_FIRST_REVERSED,
        sided=False,
    ),
    AnglesOfJoint(
        name="neck",
        above="spine3",
        below="head",
        angles=_BENDING,
        signs=_FIRST_REVERSED,
        sided=False,
    ),
)

MIRROR = np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, 1.0], [-1.0, 1.0, 1.0]])
"""Times a rotation matrix: that of the same bone of the person seen in a mirror, x to -x."""

_UPRIGHT = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
_INWARD = np.array([1.0, 0.0, 0.0])
"""From a right hand to its elbow and on to the shoulder, in the rest pose."""
_UPPER_ARM = np.column_stack([np.cross(_INWARD, ELBOW_HINGE), _INWARD, ELBOW_HINGE])
_FOREARM = np.column_stack([[0.0, -1.0, 0.0], _INWARD, [0.0, 0.0, 1.0]])
_AXES = {"upper_arm": _UPPER_ARM, "forearm": _FOREARM, "hand": _FOREARM}


def isb_axes(bone: str) -> Float[np.ndarray, "3 3"]:
    """X, Y and Z of the society, columns, in the frame of a bone of the right side or the middle.

    Our rest pose has arms to the sides and palms down: there X of the upper arm comes out of the
    elbow's pit, X of forearm and hand out of the palm, and Z of forearm and hand lies towards the
    thumb.
    """
    return _AXES.get(bone, _UPRIGHT)
