"""Error bars: what the covariance of a solve comes to in degrees and metres.

The inverse of the normal equations is a covariance only if every weight is one over a variance and
errors are independent, and neither is true: neighbouring instants err alike, and where the rig
stands, landmarks and mountings is wrong by a constant. So variances are a share of what the normal
equations say and a constant more, fitted on the twin's training sequences (docs/accuracy.md), for
the default weights.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from fusecap.body.skeleton import Skeleton

_TURN_SHARE = 0.17
_TURN_SHARES = {
    "spine": 0.06,
    "spine1": 0.06,
    "spine2": 0.06,
    "spine3": 0.06,
    "neck": 0.12,
    "head": 0.12,
    "thigh": 0.09,
    "shank": 0.09,
    "foot": 0.09,
    "toes": 0.05,
}
"""Of the variance of a bone's turn; less where the prior is vaguer than people are."""
_TURN_DEG = 2.5
"""Of sensors' mountings and landmarks beside their joints, which no time averages away."""
_PLACE_SHARE = 0.12
_PLACE_M = 0.016
"""Of where a rig stands in the world, and the same landmarks."""
_ONE_VIEW = 4.7
"""Times that share where one camera and no sensor sees somebody: sizes, which tell the depth then,
err alike for long."""
_MOST_DEG, _MOST_M = 180.0, 10.0
_GROWTH_DEG_S, _GROWTH_M_S = 90.0, 1.0
"""How fast somebody whom nothing measures may be elsewhere by now."""


class Sigmas(NamedTuple):
    """Expected root mean square errors per bone (B,)."""

    bone_deg: Float[np.ndarray, " b"]
    """Of its rotation in the world."""
    position_m: Float[np.ndarray, " b"]
    """Of its joint."""


def unknown(skeleton: Skeleton) -> Sigmas:
    """Of somebody not measured yet."""
    count = skeleton.bone_count
    return Sigmas(np.full(count, _MOST_DEG), np.full(count, _MOST_M))


def turn_shares(skeleton: Skeleton) -> Float[np.ndarray, " b"]:
    """Per bone, for `sigmas`."""
    parts = [re.sub("^(left|right)_", "", bone) for bone in skeleton.bone_names]
    return np.array([_TURN_SHARES.get(part, _TURN_SHARE) for part in parts])


def sigmas(
    turn_rad2: Float[np.ndarray, "*n b"],
    place_m2: Float[np.ndarray, "*n b"],
    shares: Float[np.ndarray, " b"],
    *,
    one_view: bool,
) -> Sigmas:
    """Of the traces of `kernels.uncertainty.spread`; NaN there is as uncertain as can be.

    `one_view`: nothing but one camera told where somebody is.
    """
    turn = np.degrees(np.sqrt(shares * np.maximum(turn_rad2, 0.0) + np.radians(_TURN_DEG) ** 2))
    share = _PLACE_SHARE * (_ONE_VIEW if one_view else 1.0)
    place = np.sqrt(share * np.maximum(place_m2, 0.0) + _PLACE_M**2)
    return Sigmas(np.fmin(turn, _MOST_DEG), np.fmin(place, _MOST_M))


def grown(before: Sigmas, silent_s: float) -> Sigmas:
    """What they are after a time without any measurement."""
    return Sigmas(
        np.minimum(np.hypot(before.bone_deg, _GROWTH_DEG_S * silent_s), _MOST_DEG),
        np.minimum(np.hypot(before.position_m, _GROWTH_M_S * silent_s), _MOST_M),
    )
