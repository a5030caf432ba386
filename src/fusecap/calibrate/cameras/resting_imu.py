"""Which way is up, from an IMU that lies still on a camera or on a board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.errors import InputError, nearest
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.geometry.quaternions import from_wxyz
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.types import GRAVITY_M_S2

AT_REST_M_S2 = 0.15
"""Standard deviation per axis of an accelerometer that lies still."""
GRAVITY_WITHIN_M_S2 = 0.5
AXES = {
    "right": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "down": (0.0, 1.0, 0.0),
    "up": (0.0, -1.0, 0.0),
    "forward": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
}
"""Directions of a camera as seen in its image, and of a board as seen by who looks at it."""


@dataclass(frozen=True, kw_only=True)
class RestingImu:
    """What an IMU that lies still says about the thing it is fixed to."""

    up_in_body: Float[np.ndarray, "3"]
    """Unit, in the frame of the camera (OpenCV's axes) or of the board."""
    reference_from_body: Float[np.ndarray, "3 3"]
    """From its orientation, into its reference world turned to y up."""
    spread_m_s2: float
    contradiction_deg: float
    """Between up by its accelerometer and up by its orientation."""


def resting_imu(track: ImuTrack, *, axes: str, imu_up: str = "z") -> RestingImu:
    """The mean of a recording at rest.

    `axes` says where the sensor's x and y axes point, such as "right,up": words of `AXES`. `imu_up`
    is the up axis of its reference world. Raises `InputError` for a sensor that moves or does not
    measure gravity.
    """
    body_from_imu = _axes(axes)
    accel = track.accel_m_s2[np.isfinite(track.accel_m_s2[:, 0])].astype(np.float64)
    if len(accel) < 10:
        raise InputError(
            f"{len(accel)} samples have an acceleration, expected a second of them or more; export "
            "the recording with its calibrated acceleration"
        )
    mean = accel.mean(axis=0)
    spread = float(accel.std(axis=0).max())
    if spread > AT_REST_M_S2:
        raise InputError(
            f"the sensor moved: its acceleration varies by {spread:.2f} m/s2, expected less than "
            f"{AT_REST_M_S2} m/s2; leave it alone for some seconds, and cut the file to these"
        )
    size = float(np.linalg.norm(mean))
    if abs(size - GRAVITY_M_S2) > GRAVITY_WITHIN_M_S2:
        raise InputError(
            f"the sensor's mean acceleration is {size:.2f} m/s2, expected {GRAVITY_M_S2:.2f}: "
            "gravity must not be removed, and the unit be m/s2"
        )
    imu = from_wxyz(track.orientation_wxyz).mean()
    y_up = Y_UP_FROM_Z_UP if imu_up == "z" else np.eye(3)
    reference_from_imu = y_up @ imu.as_matrix()
    told = reference_from_imu @ (mean / size)
    return RestingImu(
        up_in_body=body_from_imu @ (mean / size),
        reference_from_body=reference_from_imu @ body_from_imu.T,
        spread_m_s2=spread,
        contradiction_deg=float(np.degrees(np.arccos(np.clip(told[1], -1.0, 1.0)))),
    )


def _axes(words: str) -> np.ndarray:
    """body_from_imu, from where the sensor's x and y point."""
    names = [word.strip() for word in words.split(",")]
    for name in names:
        if name not in AXES:
            raise InputError(f"sensor axes '{words}': no direction '{name}'{nearest(name, AXES)}")
    directions = np.array([AXES[name] for name in names])
    if len(names) != 2 or abs(directions[0] @ directions[1]) > 0.5:
        raise InputError(
            f"sensor axes '{words}', expected where its x and its y point, such as right,up"
        )
    return np.column_stack([*directions, np.cross(*directions)])
