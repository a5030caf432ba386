"""A person as OpenSim sees one: bodies, joint coordinates and markers.

OpenSim's people face x with y up and z to their right, and stand with their arms down. So our world
turns by 90 degrees about up, and the rest pose has hanging arms. Every joint has three coordinates,
about z, x and y in this order, with the names and signs of the Rajagopal model where it has them:
flexion forward, adduction and inward rotation are positive, and so is a bent knee.

    x_opensim = z    y_opensim = y    z_opensim = -x
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.body.rigs import RigJoint, RigPreset
from fusecap.body.shape import BodyShape
from fusecap.exports.euler import euler_rad
from fusecap.exports.markers import bone_markers
from fusecap.exports.rest_rig import RestRig
from fusecap.exports.rig_motion import rig_motion
from fusecap.exports.take_format import AnyTake
from fusecap.files import written_whole

OPENSIM_FROM_OURS = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])

_TRUNK = {"hips": "pelvis", "spine3": "torso"}
_LIMBS = {
    "thigh": "femur",
    "shank": "tibia",
    "foot": "calcn",
    "upper_arm": "humerus",
    "forearm": "radius",
}
_COORDINATES = {
    "pelvis": ("pelvis_tilt", "pelvis_list", "pelvis_rotation"),
    "femur": ("hip_flexion", "hip_adduction", "hip_rotation"),
    "tibia": ("knee_angle", "knee_adduction", "knee_rotation"),
    "calcn": ("ankle_angle", "subtalar_angle", "ankle_rotation"),
    "toes": ("mtp_angle", "mtp_adduction", "mtp_rotation"),
    "humerus": ("arm_flex", "arm_add", "arm_rot"),
    "radius": ("elbow_flex", "elbow_add", "pro_sup"),
    "hand": ("wrist_flex", "wrist_dev", "wrist_rot"),
    "clavicle": ("clavicle_flex", "clavicle_add", "clavicle_rot"),
}
"""About z, x and y; bodies of the trunk have extension, bending and rotation."""
TRANSLATIONS = ("pelvis_tx", "pelvis_ty", "pelvis_tz")


@dataclass(frozen=True, slots=True, kw_only=True)
class Coordinate:
    """One angle of a joint."""

    name: str
    axis: tuple[float, float, float]
    """In OpenSim's axes, with the sign of what is positive."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OpensimMarker:
    """A point on a body."""

    name: str
    body: str
    location_m: Float[np.ndarray, "3"]


def body_name(bone: str) -> str:
    """As Rajagopal's model calls it, where it has one: left_thigh is femur_l."""
    side, _, rest = bone.partition("_")
    if side in ("left", "right"):
        return f"{_LIMBS.get(rest, rest)}_{side[0]}"
    return _TRUNK.get(bone, bone)


def coordinates(body: str) -> tuple[Coordinate, Coordinate, Coordinate]:
    """Of the joint that ties a body to its parent: about z, x and y."""
    kind, _, side = body.partition("_")
    names = _COORDINATES.get(kind) or tuple(
        f"{kind}_{turn}" for turn in ("extension", "bending", "rotation")
    )
    tail = f"_{side}" if side else ""
    mirrored = -1.0 if side == "l" else 1.0
    bent = -1.0 if kind == "tibia" else 1.0
    z, x, y = names
    return (
        Coordinate(name=z + tail, axis=(0.0, 0.0, bent)),
        Coordinate(name=x + tail, axis=(mirrored, 0.0, 0.0)),
        Coordinate(name=y + tail, axis=(0.0, mirrored, 0.0)),
    )


def opensim_preset(take: AnyTake) -> RigPreset:
    """Our bones under OpenSim's names, standing with arms down."""
    names = [body_name(bone) for bone in take.bone_names]
    return RigPreset(
        name="opensim",
        about="",
        joints=tuple(
            RigJoint(
                name=name,
                parent=names[parent] if parent >= 0 else "",
                turns_with=(bone,),
                sits_at=bone,
            )
            for name, bone, parent in zip(names, take.bone_names, take.parents, strict=True)
        ),
        rest_deg={"left_upper_arm": (0.0, 0.0, -90.0), "right_upper_arm": (0.0, 0.0, 90.0)},
    )


def coordinate_values(take: AnyTake) -> tuple[list[str], Float[np.ndarray, "t c"]]:
    """Names and values of all coordinates of the take's one subject [deg, m]."""
    motion = rig_motion(take, 0, opensim_preset(take))
    names, columns = [], []
    for joint, body in enumerate(motion.rest.names):
        turns = coordinates(body)
        signs = [sum(turn.axis) for turn in turns]
        names += [turn.name for turn in turns]
        rotation = OPENSIM_FROM_OURS @ motion.rotation_from_rest(joint) @ OPENSIM_FROM_OURS.T
        columns.append(np.degrees(euler_rad(rotation, "ZXY")) * signs)
        if joint == 0:
            names += TRANSLATIONS
            columns.append(motion.position_m[:, 0] @ OPENSIM_FROM_OURS.T)
    return names, np.concatenate(columns, axis=1)


def write_motion(
    path: Path,
    title: str,
    names: Sequence[str],
    time_s: Float[np.ndarray, " t"],
    deg: Float[np.ndarray, "t c"],
) -> None:
    """A MOT file of columns in degrees (and metres), whole or not at all."""
    head = [
        title,
        "version=1",
        f"nRows={len(time_s)}",
        f"nColumns={1 + len(names)}",
        "inDegrees=yes",
        "endheader",
        "\t".join(("time", *names)),
    ]
    with written_whole(path) as file:
        file.write(("\n".join(head) + "\n").encode())
        np.savetxt(file, np.column_stack([time_s, deg]), fmt="%.6f", delimiter="\t")


def opensim_markers(shape: BodyShape, rest: RestRig) -> list[OpensimMarker]:
    """The markers on their bodies; `rest` is `opensim_preset`'s."""
    return [
        OpensimMarker(
            name=name,
            body=body_name(bone),
            location_m=OPENSIM_FROM_OURS @ rest.rest_of(bone) @ at,
        )
        for name, bone, at in bone_markers(shape)
    ]
