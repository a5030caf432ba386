"""R_ib from a T-pose: the bones' rotations are known, so one look at each sensor is enough.

The heading cannot be found so and stays as stated. Whatever the subject's pose deviates from the
rest pose, R_ib is off by; nothing in the recording tells, but these two do tell that something
else is wrong: a sensor that turned meanwhile (the subject moved), and a specific force that does
not point up in the sensor's own world (it moved as well, or `imu_up` is wrong).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings, SubjectSettings
from fusecap.sources.session_sensors import still_samples, world_from_still_bone
from fusecap.sources.synchronizer import world_from_imu_world

STILL_DEG = 4.0
"""A sensor that stays within this of its mean is on a person who stands still."""
GRAVITY_DEG = 5.0
TPOSE_SIGMA_RAD = np.radians(7.0)
"""Per axis, how far a person's bones are from the rest pose in what they take for a T-pose. An
assumption: no source for it was found."""


@dataclass(frozen=True, kw_only=True)
class TPose:
    """One sensor in the T-pose."""

    time_s: float
    bone_in_world: Float[np.ndarray, "3 3"]
    sensor_in_imu_world: Float[np.ndarray, "3 3"]
    """Mean, with up along y, without the stated heading."""
    bone_from_imu: Float[np.ndarray, "3 3"]
    """With the stated heading."""
    moved_deg: float
    """95th percentile of the angle from the mean."""
    gravity_deg: float
    """Between the mean specific force and up; NaN without an accelerometer."""

    @property
    def complaints(self) -> tuple[str, ...]:
        """What speaks against it, in words."""
        said = []
        if self.moved_deg > STILL_DEG:
            said.append(f"moved by {self.moved_deg:.1f} deg during the T-pose")
        if self.gravity_deg > GRAVITY_DEG:
            said.append(f"gravity is {self.gravity_deg:.1f} deg off up during the T-pose")
        return tuple(said)


def look_at_tpose(subject: SubjectSettings, imu: ImuSettings, track: ImuTrack) -> TPose:
    """The sensor in the T- or N-pose; raises as `still_samples`."""
    still = still_samples(subject, imu, track)
    upright = world_from_imu_world(imu.imu_up, 0.0)
    turned = from_wxyz(still.orientation_wxyz)
    mean = turned.mean()
    known = np.flatnonzero(np.isfinite(still.accel_m_s2).all(axis=1))
    gravity_deg = float("nan")
    if len(known):
        force = upright @ from_wxyz(still.orientation_wxyz[known]).apply(
            still.accel_m_s2[known]
        ).mean(axis=0)
        gravity_deg = float(np.degrees(np.arccos(force[1] / np.linalg.norm(force))))
    bone = world_from_still_bone(subject, imu.bone)
    sensor = upright @ mean.as_matrix()
    return TPose(
        # A static trial has no time on the motion's clock: before it.
        time_s=float(track.times_s[0])
        if imu.static_file is not None
        else float(still.times_s[0] + still.times_s[-1]) / 2,
        bone_in_world=bone,
        sensor_in_imu_world=sensor,
        bone_from_imu=bone.T @ world_from_imu_world("y", imu.heading_deg) @ sensor,
        moved_deg=float(np.degrees(np.percentile((mean.inv() * turned).magnitude(), 95))),
        gravity_deg=gravity_deg,
    )
