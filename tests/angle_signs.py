"""docs/images/angle_signs.jpg, what is positive: `uv run python tests/angle_signs.py` draws it.

Per angle the right side of a figure, grey with every angle of that joint at its first value, in
colour with this one larger. The arrow is an axis of the bone below: X, forward or out of the palm,
and for the middle angle, which turns about X, Z to the right.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from fusecap.angles.joints import JOINTS, MIRROR, AnglesOfJoint, isb_axes
from fusecap.body.skeleton import PAPER21
from fusecap.exports.stick_figures import TakeSticks
from fusecap.take import Take
from motions import person, take_of

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "angle_signs.jpg"
SIDE, FRONT, TOP = (2, 1, 1, 1), (0, 1, 1, 1), (0, 2, 1, -1)
"""Axes to the right and up, and their signs: from the person's right, front, and above."""
VIEWS = {SIDE: "from its right", FRONT: "from the front", TOP: "from above"}
MORE_DEG = (40.0, 25.0, 40.0)
"""By which the first, middle and last angle of a joint grow."""
STARTS = {"shoulder": (0.0, 60.0, -30.0)}
BENT = {
    "arm_rotation": {"elbow": (90.0, 0.0, 0.0)},
    "shoulder_rotation": {"elbow": (90.0, 0.0, 0.0)},
    "elbow_pronation": {"elbow": (90.0, 0.0, 0.0)},
    "hip_rotation": {"knee": (70.0, 0.0, 0.0)},
    "knee_rotation": {"knee": (70.0, 0.0, 0.0), "hip": (50.0, 0.0, 0.0)},
}
"""What else is bent, for a turn about a long axis to be seen."""
TRUNK = ("spine", "spine1", "spine2", "spine3")


def angle_name(joint: AnglesOfJoint, place: int) -> str:
    return f"{joint.name}_{joint.angles[place]}"


def start_deg(joint: AnglesOfJoint, place: int) -> tuple[float, float, float]:
    bent = BENT.get(angle_name(joint, place), {})
    return bent.get(joint.name, STARTS.get(joint.name, (0.0, 0.0, 0.0)))


def figures(joint: AnglesOfJoint, place: int) -> tuple[Take, Take]:
    """At the first values, and with one angle larger."""
    first = start_deg(joint, place)
    more = tuple(a + MORE_DEG[place] * (k == place) for k, a in enumerate(first))
    others = BENT.get(angle_name(joint, place), {})
    return posed(others | {joint.name: first}), posed(others | {joint.name: more})


def posed(deg: dict[str, tuple[float, ...]]) -> Take:
    """The right side with these angles, everything else in the anatomical position."""
    shape = person()
    local = np.tile(np.eye(3), (PAPER21.bone_count, 1, 1))
    asked = deg if "shoulder" in deg else {"arm": (0.0, 0.0, 0.0)} | deg
    for joint in JOINTS:
        if joint.name not in asked and joint.name in ("shoulder", "arm"):
            continue
        turns = np.multiply(asked.get(joint.name, (0.0, 0.0, 0.0)), joint.signs)
        turn = Rotation.from_euler(joint.order, turns, degrees=True).as_matrix()
        turn = isb_axes(joint.above) @ turn @ isb_axes(joint.below).T
        if joint.name == "trunk":
            part = Rotation.from_rotvec(Rotation.from_matrix(turn).as_rotvec() / len(TRUNK))
            for bone in TRUNK:
                local[PAPER21.bone(bone)] = part.as_matrix()
        elif joint.sided:
            local[PAPER21.bone(f"right_{joint.below}")] = turn
            if joint.name != "shoulder":
                straight = isb_axes(joint.above) @ isb_axes(joint.below).T
                local[PAPER21.bone(f"left_{joint.below}")] = straight * MIRROR
        else:
            local[PAPER21.bone(joint.below)] = turn
    theta = np.zeros((1, 1, PAPER21.pose_size))
    theta[0, 0, 1] = shape.standing_root_height_m
    theta[0, 0, 3:] = Rotation.from_matrix(local).as_rotvec().ravel()
    return take_of(theta, [shape], names=("a",))


def draw(ax: Axes, take: Take, joint: AnglesOfJoint, place: int, colour: str) -> None:
    sticks = TakeSticks(take).at_frame(0, 0)
    assert sticks is not None
    across, up, right, over = view_of(joint, place)
    for start, end, left in zip(sticks.start_m, sticks.end_m, sticks.left, strict=True):
        ax.plot(
            [right * start[across], right * end[across]],
            [over * start[up], over * end[up]],
            color="0.88" if left else colour,
            linewidth=1.5 if left else 2.2,
            solid_capstyle="round",
        )
    bone = PAPER21.bone(f"right_{joint.below}" if joint.sided else joint.below)
    at = take.bone_position_in_world_m[0, 0, bone]
    axis = isb_axes(joint.below)[:, 2 if place == 1 else 0]
    tip = at + take.bone_rotation_in_world(0)[0, bone] @ axis * 0.2
    ax.annotate(
        "",
        (right * tip[across], over * tip[up]),
        (right * at[across], over * at[up]),
        arrowprops={"arrowstyle": "->", "color": colour, "linewidth": 1.2},
    )
    reach_m = 0.8 if joint.name in ("trunk", "hip") else 0.5
    ax.set_xlim(right * at[across] - reach_m, right * at[across] + reach_m)
    ax.set_ylim(over * at[up] - reach_m, over * at[up] + reach_m)


def view_of(joint: AnglesOfJoint, place: int) -> tuple[int, ...]:
    name = angle_name(joint, place)
    if name == "elbow_pronation":
        return FRONT
    if name == "shoulder_plane":
        return TOP
    return (SIDE, FRONT, TOP)[place]


def main() -> None:
    figure = Figure(figsize=(9, 2.7 * len(JOINTS)), layout="constrained")
    for row, joint in zip(figure.subplots(len(JOINTS), 3), JOINTS, strict=True):
        for place, ax in enumerate(row):
            before, after = figures(joint, place)
            draw(ax, after, joint, place, "C0")
            draw(ax, before, joint, place, "0.55")
            name = angle_name(joint, place).replace("_", " ")
            ax.set_title(
                f"{name} +{MORE_DEG[place]:.0f}, {VIEWS[view_of(joint, place)]}", fontsize=9
            )
            ax.set_aspect("equal")
            ax.set_axis_off()
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=70, pil_kwargs={"quality": 80})


if __name__ == "__main__":
    main()
