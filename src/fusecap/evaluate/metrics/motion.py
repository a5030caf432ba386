"""How a motion moves: jitter and acceleration error, by finite differences of joint positions.

A difference reaches over three or four frames, so the first and last frames, and those beside a
gap, have none: NaN. Frames are taken to be evenly spaced.

Both are harsh on noise: 1 mm of it per axis, white, at 60 Hz is 14.1 m/s² of acceleration (a
second difference adds 1 + 4 + 1 variances, and the mean length of three axes is 1.6 sigma) and
1.5 km/s³ of jitter.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def acceleration_error_m_s2(
    estimate_m: Float[np.ndarray, "*n t j 3"],
    truth_m: Float[np.ndarray, "*n t j 3"],
    rate_hz: float,
) -> Float[np.ndarray, "*n t j"]:
    """Length of the difference of accelerations, by second central differences [m/s²].

    Kanazawa et al. (2019) introduced it, in mm per squared frame.
    """
    error = _difference(estimate_m - truth_m, 2) * rate_hz**2
    result = np.full(truth_m.shape[:-1], np.nan)
    result[..., 1:-1, :] = np.linalg.norm(error, axis=-1)
    return result


def jitter_m_s3(
    position_m: Float[np.ndarray, "*n t j 3"], rate_hz: float
) -> Float[np.ndarray, "*n t j"]:
    """Length of the third finite difference of each joint's position [m/s³], dated at its third.

    Its mean is the jitter of TransPose (Yi et al. 2021, eq. 14), which prints it in km/s³ or
    10² m/s³. It needs no truth; a smooth but wrong motion has little, and the truth has some.
    """
    result = np.full(position_m.shape[:-1], np.nan)
    result[..., 2:-1, :] = np.linalg.norm(_difference(position_m, 3), axis=-1) * rate_hz**3
    return result


def _difference(values: Float[np.ndarray, "*n t j 3"], order: int) -> Float[np.ndarray, "*n u j 3"]:
    """Differences over time; none where there are too few frames."""
    if values.shape[-3] <= order:
        return values[..., :0, :, :]
    return np.diff(values, n=order, axis=-3)
