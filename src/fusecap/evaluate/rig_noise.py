"""What a calibration gets wrong: where the cameras are believed to stand.

Each camera's pose is off on its own, which the views contradict each other over; and the whole rig
is off together against the world that the truth is measured in, which no view can tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.geometry.camera import Rig


@dataclass(frozen=True, kw_only=True)
class RigNoise:
    """Standard deviations of constant errors; by default a calibration is right."""

    rotation_deg: float = 0.0
    """Of each camera, about each of its axes."""
    position_m: float = 0.0
    """Of each camera, along each axis."""
    world_m: float = 0.0
    """Of all cameras together, along each axis of the world."""


def believed(rng: np.random.Generator, rig: Rig, noise: RigNoise) -> Rig:
    """The rig as its calibration has it, `rig` being where the cameras are."""
    if noise == RigNoise():
        return rig
    shift_m = noise.world_m * rng.standard_normal(3)
    cameras = []
    for camera in rig.cameras:
        turn = Rotation.from_rotvec(np.radians(noise.rotation_deg) * rng.standard_normal(3))
        rotation = turn.as_matrix() @ camera.rotation
        own_m = noise.position_m * rng.standard_normal(3)
        centre = camera.position_in_world + shift_m + own_m
        cameras.append(replace(camera, rotation=rotation, translation=-rotation @ centre))
    return Rig(cameras=tuple(cameras))
