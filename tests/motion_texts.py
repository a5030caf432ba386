"""Tiny motion files in the database's own formats, written by hand."""

from __future__ import annotations

import numpy as np

_ASF_BONES = {
    "lhipjoint": ("root", (0.6, -0.8, 0.0), 2.5, (0, 0, 0), ""),
    "lfemur": ("lhipjoint", (0.34202014, -0.93969262, 0.0), 7.0, (0, 0, 20), "rx ry rz"),
    "ltibia": ("lfemur", (0.34202014, -0.93969262, 0.0), 7.5, (0, 0, 20), "rx"),
    "lfoot": ("ltibia", (0.07, -0.18, 0.98), 2.4, (-90, 0, 20), "rx rz"),
    "ltoes": ("lfoot", (0.0, 0.0, 1.0), 1.2, (-90, 0, 20), "rx"),
    "rhipjoint": ("root", (-0.6, -0.8, 0.0), 2.5, (0, 0, 0), ""),
    "rfemur": ("rhipjoint", (-0.34202014, -0.93969262, 0.0), 7.0, (0, 0, -20), "rx ry rz"),
    "rtibia": ("rfemur", (-0.34202014, -0.93969262, 0.0), 7.5, (0, 0, -20), "rx"),
    "rfoot": ("rtibia", (-0.07, -0.18, 0.98), 2.4, (-90, 0, -20), "rx rz"),
    "rtoes": ("rfoot", (0.0, 0.0, 1.0), 1.2, (-90, 0, -20), "rx"),
    "lowerback": ("root", (0.0, 1.0, 0.0), 2.0, (0, 0, 0), "rx ry rz"),
    "upperback": ("lowerback", (0.0, 1.0, 0.0), 2.0, (0, 0, 0), "rx ry rz"),
    "thorax": ("upperback", (0.0, 1.0, 0.0), 2.0, (0, 0, 0), "rx ry rz"),
    "lowerneck": ("thorax", (0.0, 1.0, 0.0), 1.7, (0, 0, 0), "rx ry rz"),
    "upperneck": ("lowerneck", (0.0, 1.0, 0.0), 1.7, (0, 0, 0), "rx ry rz"),
    "head": ("upperneck", (0.0, 1.0, 0.0), 1.7, (0, 0, 0), "rx ry rz"),
    "lclavicle": ("thorax", (0.9, 0.4, 0.0), 3.5, (0, 0, 0), "ry rz"),
    "lhumerus": ("lclavicle", (1.0, 0.0, 0.0), 5.0, (180, -30, -90), "rx ry rz"),
    "lradius": ("lhumerus", (1.0, 0.0, 0.0), 3.5, (180, -30, -90), "rx"),
    "lwrist": ("lradius", (1.0, 0.0, 0.0), 1.7, (0, 90, 90), "ry"),
    "lhand": ("lwrist", (1.0, 0.0, 0.0), 0.7, (0, 90, 90), "rx rz"),
    "rclavicle": ("thorax", (-0.9, 0.4, 0.0), 3.5, (0, 0, 0), "ry rz"),
    "rhumerus": ("rclavicle", (-1.0, 0.0, 0.0), 5.0, (180, 30, 90), "rx ry rz"),
    "rradius": ("rhumerus", (-1.0, 0.0, 0.0), 3.5, (180, 30, 90), "rx"),
    "rwrist": ("rradius", (-1.0, 0.0, 0.0), 1.7, (0, -90, -90), "ry"),
    "rhand": ("rwrist", (-1.0, 0.0, 0.0), 0.7, (0, -90, -90), "rx rz"),
}


def asf_text() -> str:
    """A skeleton of the database's joints, 1 unit = 0.0254 / 0.45 m."""
    lines = [
        ":version 1.10",
        ":units",
        "  length 0.45",
        "  angle deg",
        ":root",
        "  order TX TY TZ RX RY RZ",
        "  axis XYZ",
        ":bonedata",
    ]
    for name, (_, direction, length, axis, dof) in _ASF_BONES.items():
        lines += ["begin", f"  name {name}", "  direction " + " ".join(map(str, direction))]
        lines += [f"  length {length}", f"  axis {axis[0]} {axis[1]} {axis[2]} XYZ"]
        lines += [f"  dof {dof}"] if dof else []
        lines += ["end"]
    lines += [":hierarchy", "begin"]
    lines += [f"{parent} {name}" for name, (parent, *_) in _ASF_BONES.items()]
    return "\n".join([*lines, "end", ""])


def amc_text(frames: list[dict[str, tuple[float, ...]]]) -> str:
    """One frame per dict of bone to values; bones left out stay at zero."""
    lines = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for number, values in enumerate(frames, start=1):
        lines.append(str(number))
        root = values.get("root", (0, 15, 0, 0, 0, 0))
        lines.append("root " + " ".join(map(str, root)))
        for name, (*_, dof) in _ASF_BONES.items():
            if dof:
                bone = values.get(name, (0.0,) * len(dof.split()))
                lines.append(f"{name} " + " ".join(map(str, bone)))
    return "\n".join([*lines, ""])


BVH_TEXT = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Arm
  {
    OFFSET 1 0 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    JOINT Hand
    {
      OFFSET 2 0 0
      CHANNELS 3 Zrotation Yrotation Xrotation
      End Site
      {
        OFFSET 0.5 0 0
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.01
1 2 3 90 0 0 10 20 30 0 0 0
4 5 6 0 0 45 0 0 0 5 0 0
"""


def expmap_text(vectors: np.ndarray, root: tuple[float, float, float] = (1.0, 17.0, 2.0)) -> str:
    """Rows of 38 exponential maps (n, 38, 3) after the rest pose that opens every file."""
    rows = np.concatenate([np.zeros((1, 114)), vectors.reshape(len(vectors), 114)])
    return "\n".join(",".join(map(str, [*root, *row])) for row in rows) + "\n"
