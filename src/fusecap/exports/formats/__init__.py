"""The table of formats that a take is exported to, one module each with its `FORMAT`.

A module is imported when its format is asked for, so that the table itself costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.exports.take_format import TakeFormat

FORMATS = {
    "bvh": "a skeleton and its rotations, for Blender, Unity, Unreal, MotionBuilder",
    "glb": "everybody with a body, for viewers, Blender and engines",
    "usd": "everybody with a body (UsdSkel), for Omniverse, Houdini, Maya",
    "fbx": "a person with a body, for Unreal, Unity, MotionBuilder, Maya; needs Blender",
    "html": "a page that plays the take in any browser, without a server",
    "vrma": "a person's motion for any VRM avatar",
    "csv": "a tidy table of bones, for pandas, R and spreadsheets",
    "npz": "NumPy arrays of joints on a rig",
    "trc": "marker trajectories for OpenSim",
    "mot": "joint angles for OpenSim",
    "osim": "the person as an OpenSim model with markers",
    "c3d": "points, segment rotations and steps, for biomechanics",
    "openpose": "landmarks as the session's cameras see them, OpenPose JSON",
    "sto": "bone orientations for OpenSense",
}
"""What each is, by its name and that of its module."""


def format_named(name: str) -> TakeFormat:
    """One of `FORMATS`."""
    return import_module(f"{__name__}.{name}").FORMAT
