"""What a sensor and the motion it is held against must show before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.imus.reference import ReferenceMotion
from fusecap.calibrate.imus.speeds import lag_s
from fusecap.calibrate.imus.tpose import TPose
from fusecap.errors import InputError
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import ImuSettings
from fusecap.sources.synchronizer import UPRIGHT, MountedImu, resample_imus, world_from_imu_world

MIN_OVERLAP_S = 6.0
MAX_LAG_S = 0.1
"""Beyond it nothing sensible can be calibrated."""
MIN_LAG_GAIN = 0.1
"""In correlation, before another lag is believed."""
STILL_RAD = np.radians(2.0)
"""A sensor that never turns farther is not recording."""


@dataclass(frozen=True, kw_only=True)
class Worn:
    """A sensor as the session states it."""

    settings: ImuSettings
    track: ImuTrack
    """On the session's clock."""
    tpose: TPose | None = None


def sensor_rotations(
    worn: Sequence[Worn], times_s: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "i t 3 3"]:
    """U R_i at the given instants; NaN where not measured."""
    mounted = [
        MountedImu(
            bone=each.settings.bone,
            track=each.track,
            world_from_imu_world=world_from_imu_world(each.settings.imu_up, 0.0),
            bone_from_imu=np.eye(3),
            position_in_bone_m=np.zeros(3),
        )
        for each in worn
    ]
    return np.swapaxes(resample_imus(mounted, times_s)[0], 0, 1)


def check_reference(reference: ReferenceMotion) -> None:
    if reference.duration_s < MIN_OVERLAP_S:
        raise InputError(
            f"subject '{reference.subject}' is seen for {reference.duration_s:.1f} s, expected "
            f"{MIN_OVERLAP_S:g} s of motion or more; record longer, or calibrate with --from tpose"
        )


def why_unusable(
    reference: ReferenceMotion, worn: Worn, rotation: Float[np.ndarray, "t 3 3"]
) -> str:
    """Why a sensor cannot be calibrated; empty where it can."""
    known = np.isfinite(rotation).all((1, 2))
    step_s = float(np.median(np.diff(reference.times_s)))
    if known.sum() * step_s < MIN_OVERLAP_S:
        return (
            f"only {known.sum() * step_s:.1f} s of its samples ({worn.track.times_s[0]:.1f} to "
            f"{worn.track.times_s[-1]:.1f} s) fall within what the cameras saw "
            f"({reference.times_s[0]:.1f} to {reference.times_s[-1]:.1f} s), expected "
            f"{MIN_OVERLAP_S:g} s; check the file, or run: fusecap calibrate sync"
        )
    turned = Rotation.from_matrix(rotation[known])
    if float((turned[0].inv() * turned).magnitude().max()) < STILL_RAD:
        return (
            "its orientation never changes by more than 2 deg; check that the sensor was "
            "switched on and that its file is the right one"
        )
    return _wrong_up(worn)


def _wrong_up(worn: Worn) -> str:
    """Over a recording the specific force averages to gravity, which is up."""
    found = worn.track.up_axis
    if found is None or found == worn.settings.imu_up:
        return ""
    hint = f'set imu_up = "{found}"' if found in UPRIGHT else "check the axes of its file"
    if found.lstrip("-") == worn.settings.imu_up.lstrip("-"):
        hint += ", or multiply its accelerations by -1"
    return (
        f'gravity points along {found} of its reference world, imu_up is "{worn.settings.imu_up}"; '
        f"{hint}"
    )


def checked_lag(reference: ReferenceMotion, worn: Sequence[Worn]) -> tuple[float, float]:
    bones = [reference.skeleton.bone(each.settings.bone) for each in worn]
    late_s, best, at_zero = lag_s(reference, bones, [each.track for each in worn])
    if abs(late_s) > MAX_LAG_S and best > at_zero + MIN_LAG_GAIN:
        word = "behind" if late_s > 0 else "ahead of"
        raise InputError(
            f"the sensors of '{reference.subject}' are {abs(late_s):.2f} s {word} the cameras "
            f"(angular speeds correlate by {best:.2f} there, by {at_zero:.2f} as the session has "
            "it); run: fusecap calibrate sync"
        )
    return (late_s, best) if best > at_zero + MIN_LAG_GAIN / 2 else (0.0, at_zero)
