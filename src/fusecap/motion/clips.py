"""Clips of captured motion, fitted for shipping.

Each clip is retargeted, bridged where markers were swapped, slowed where it is short, turned and
placed in the room, set on the floor, and fitted by a cosine series up to 8 Hz (see
`fusecap.body.motion_model`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from scipy.fft import dct
from scipy.ndimage import binary_dilation, gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from fusecap.body.motion_model import evaluate_series, theta_of_channels
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.geometry.quaternions import to_wxyz
from fusecap.motion.motion import Motion
from fusecap.motion.motion_folder import MotionFolder
from fusecap.motion.retarget import retarget, sole_heights_m
from fusecap.motion.train_prior import ACKNOWLEDGEMENT, max_angles_rad

RATE_HZ = 60.0
_MARGIN_S = 0.25
_CUTOFF_HZ = 8.0
_MAX_SPEED_RAD_S = np.deg2rad(2000.0)
"""A bone that turns faster was mislabelled; the motion is bridged across it."""
_BRIDGE_S = 0.1
"""Bridged on either side of what was mislabelled."""
_FLOOR_WINDOW_S = 1.2
"""Within so long a foot touches the floor, also in a jump."""


_SHAPE = BodyShape.from_height(PAPER21, REFERENCE_HEIGHT_M)


@dataclass(frozen=True, kw_only=True)
class Clip:
    """One person's motion, out of a take."""

    name: str
    take: str
    """Key of `MotionFolder`."""
    start_s: float = 0.0
    """In the take's own time."""
    speed: float = 1.0
    """Seconds of the take per second of the clip."""
    heading_deg: float = 0.0
    """The whole clip is turned about the vertical by this."""
    centre_m: tuple[float, float] = (0.0, 0.0)
    """x, z of the middle of the root's path."""


def save_clips(
    motion_folder: Path,
    path: Path,
    clips: Sequence[Clip],
    *,
    duration_s: float,
    precision: type[np.floating] = np.float32,
) -> None:
    """Write the coefficients of `clips`, taken from the CMU archives in `motion_folder`."""
    folder = MotionFolder(motion_folder)
    coefficients = np.stack([_fit(clip, folder[clip.take], duration_s) for clip in clips])
    np.savez_compressed(
        path,
        names=np.array([clip.name for clip in clips]),
        takes=np.array([clip.take for clip in clips]),
        acknowledgement=np.array(ACKNOWLEDGEMENT),
        rate_hz=RATE_HZ,
        frames=round(duration_s * RATE_HZ),
        start_s=_MARGIN_S,
        interval_s=duration_s + 2 * _MARGIN_S,
        coefficients=coefficients.astype(precision),
    )


def _fit(clip: Clip, motion: Motion, duration_s: float) -> Float[np.ndarray, "k c"]:
    """Cosine coefficients of the clip's channels (see `theta_of_channels`), placed in the room."""
    interval_s = duration_s + 2 * _MARGIN_S
    samples = round(interval_s * RATE_HZ)
    time_s = (np.arange(samples) + 0.5) / RATE_HZ
    frame = (clip.start_s + clip.speed * time_s) * motion.rate_hz
    if frame[-1] > len(motion) - 1:
        raise InputError(
            f"{motion.name}: {len(motion) / motion.rate_hz:.1f} s long; the clip goes up to "
            f"{frame[-1] / motion.rate_hz:.1f} s"
        )
    theta = _placed(clip, retarget(motion, PAPER21)[: int(np.ceil(frame[-1])) + 1])
    channels = _interpolated(_bridged_channels(theta, motion.rate_hz), frame)
    channels[:, 1] -= _floor_height_m(theta_of_channels(channels[None])[0])
    coefficients = np.asarray(dct(channels, axis=0))[: round(2 * _CUTOFF_HZ * interval_s)] / samples
    coefficients[0] /= 2

    smooth = theta_of_channels(evaluate_series(coefficients, interval_s, time_s)[None])[0]
    coefficients[0, 1] -= sole_heights_m(_SHAPE, smooth).min()
    return coefficients


def _placed(clip: Clip, theta: Float[np.ndarray, "t p"]) -> Float[np.ndarray, "t p"]:
    turn = Rotation.from_euler("y", clip.heading_deg, degrees=True)
    placed = theta.copy()
    placed[:, :3] = turn.apply(theta[:, :3])
    placed[:, 3:6] = (turn * Rotation.from_rotvec(theta[:, 3:6])).as_rotvec()
    ground = placed[:, [0, 2]]
    placed[:, [0, 2]] += np.array(clip.centre_m) - (ground.min(axis=0) + ground.max(axis=0)) / 2
    return placed


def _bridged_channels(theta: Float[np.ndarray, "t p"], rate_hz: float) -> Float[np.ndarray, "t c"]:
    """Root position and quaternions wxyz whose signs do not jump, mislabelled frames bridged."""
    frames = len(theta)
    rotation = Rotation.from_rotvec(theta[:, 3:].reshape(-1, 3))
    quaternion = to_wxyz(rotation).reshape(frames, -1, 4)
    cosine = np.abs(np.sum(quaternion[1:] * quaternion[:-1], axis=-1))
    jump = 2 * np.arccos(np.minimum(cosine, 1.0)) * rate_hz > _MAX_SPEED_RAD_S
    mislabelled = rotation.magnitude().reshape(frames, -1) > np.append(
        np.inf, max_angles_rad(PAPER21)
    )
    mislabelled[1:] |= jump
    around = np.ones((2 * round(_BRIDGE_S * rate_hz) + 1, 1))
    bad = np.asarray(binary_dilation(mislabelled, around), dtype=bool)

    channels = theta[:, :3].copy()
    columns = [_across(bad[:, 0], channels)]
    for bone in range(quaternion.shape[1]):
        good = quaternion[~bad[:, bone], bone]
        flips = np.cumsum(np.sum(good[1:] * good[:-1], axis=-1) < 0) % 2
        good[1:][flips == 1] *= -1
        continuous = np.zeros((frames, 4))
        continuous[~bad[:, bone]] = good
        columns.append(_across(bad[:, bone], continuous))
    return np.concatenate(columns, axis=1)


def _across(bad: Bool[np.ndarray, " t"], values: Float[np.ndarray, "t c"]) -> np.ndarray:
    """`values` (t, c) with the bad frames interpolated from the good ones."""
    frames = np.arange(len(values))
    good = frames[~bad]
    return np.stack([np.interp(frames, good, column[good]) for column in values.T], axis=1)


def _floor_height_m(theta: Float[np.ndarray, "t p"]) -> Float[np.ndarray, " t"]:
    """Height of what the soles stand on: their lower envelope, smoothed."""
    lowest = sole_heights_m(_SHAPE, theta).min(axis=1)
    window = round(_FLOOR_WINDOW_S * RATE_HZ)
    return gaussian_filter1d(minimum_filter1d(lowest, window), window / 4)


def _interpolated(
    channels: Float[np.ndarray, "t c"], frame: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n c"]:
    below = np.floor(frame).astype(np.int64)
    above = np.minimum(below + 1, len(channels) - 1)
    share = (frame - below)[:, None]
    return (1 - share) * channels[below] + share * channels[above]
