"""The motion that ships, as truncated cosine series: the demo's three people, the twin's takes.

Root positions and the components of sign-continuous quaternions are smooth in time, so 8 Hz of
cosines carry them:

    x(t) = Σ_k c_k cos(π k t / D)

A series is flat at both ends of its interval D; the motion is taken from its inside.
"""

from __future__ import annotations

from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fusecap.errors import InputError
from fusecap.geometry.quaternions import from_wxyz


class ShippedMotion(NamedTuple):
    """S clips over T frames, for skeleton `paper21` at 1.75 m."""

    names: tuple[str, ...]
    takes: tuple[str, ...]
    """Of the CMU archives, keys of `MotionFolder`."""
    rate_hz: float
    theta: Float[np.ndarray, "s t 66"]
    """Angles at most pi."""


def load_demo_motion() -> ShippedMotion:
    """The subjects, then the bystander; all but it within 4 x 4 m round the origin."""
    return _load("demo_motion.npz")


def load_twin_motion() -> ShippedMotion:
    """Every clip of the twin, each with the middle of its path over the origin."""
    return _load("twin_motion.npz")


def _load(name: str) -> ShippedMotion:
    source = resources.files("fusecap.data") / name
    if not source.is_file():
        raise InputError(f"no motion at {source}; the installation is incomplete")
    with source.open("rb") as file, np.load(file, allow_pickle=False) as stored:
        names = tuple(str(name) for name in stored["names"])
        takes = tuple(str(take) for take in stored["takes"])
        rate_hz = float(stored["rate_hz"])
        time_s = float(stored["start_s"]) + np.arange(int(stored["frames"])) / rate_hz
        coefficients = stored["coefficients"].astype(np.float64)
        interval_s = float(stored["interval_s"])
    channels = np.stack([evaluate_series(c, interval_s, time_s) for c in coefficients])
    return ShippedMotion(
        names=names, takes=takes, rate_hz=rate_hz, theta=theta_of_channels(channels)
    )


def evaluate_series(
    coefficients: Float[np.ndarray, "k c"], interval_s: float, time_s: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t c"]:
    """x(t) above at the given times."""
    orders = np.arange(len(coefficients))
    return np.cos(np.pi / interval_s * np.outer(time_s, orders)) @ coefficients


def theta_of_channels(channels: Float[np.ndarray, "s t c"]) -> Float[np.ndarray, "s t p"]:
    """Poses from root position [m] and one quaternion wxyz of any length per bone, c = 3 + 4B."""
    people, frames = channels.shape[:2]
    quaternions = channels[..., 3:].reshape(-1, 4)
    vectors = from_wxyz(quaternions).as_rotvec()
    return np.concatenate([channels[..., :3], vectors.reshape(people, frames, -1)], axis=-1)
