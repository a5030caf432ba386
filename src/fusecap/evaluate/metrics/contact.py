"""Feet that should stand still: foot skate while the truth has them on the floor."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fusecap.body.shape import BodyShape

CONTACT_SPEED_M_S = 0.15
"""A foot joint slower than this may be in contact; optical truth wanders by about 0.05 m/s."""
CONTACT_HEIGHT_M = 0.05
"""And no higher than this above where it rests on the floor."""


def standing_heights_m(shape: BodyShape) -> Float[np.ndarray, " b"]:
    """Height of every joint over the floor in the rest pose [m]."""
    height = np.empty(shape.skeleton.bone_count)
    height[0] = shape.standing_root_height_m
    for bone, parent in enumerate(shape.skeleton.parents[1:], start=1):
        height[bone] = height[parent] + shape.offsets_m[bone, 1]
    return height


def foot_contact(
    truth_m: Float[np.ndarray, "*n t f 3"],
    rest_height_m: Float[np.ndarray, " f"],
    rate_hz: float,
    *,
    speed_m_s: float = CONTACT_SPEED_M_S,
    height_m: float = CONTACT_HEIGHT_M,
) -> Bool[np.ndarray, "*n t f"]:
    """Which foot joints (ankles, toes) truly stand on the floor from this frame to the next.

    Slower than `speed_m_s`, and at both frames within `height_m` of their height when standing. The
    last frame has no next one: false.
    """
    contact = np.zeros(truth_m.shape[:-1], dtype=bool)
    if truth_m.shape[-3] < 2:
        return contact
    speed = np.linalg.norm(np.diff(truth_m, axis=-3), axis=-1) * rate_hz
    with np.errstate(invalid="ignore"):
        low = truth_m[..., 1] <= rest_height_m + height_m
        contact[..., :-1, :] = (speed < speed_m_s) & low[..., :-1, :] & low[..., 1:, :]
    return contact


def foot_skate_m_s(
    estimate_m: Float[np.ndarray, "*n t f 3"],
    contact: Bool[np.ndarray, "*n t f"],
    rate_hz: float,
) -> Float[np.ndarray, "*n t f"]:
    """Horizontal speed of each foot joint to the next frame while in contact, NaN elsewhere [m/s].

    Divide by the rate for the literature's metres per frame. Noise counts as skating.
    """
    skate = np.full(contact.shape, np.nan)
    if estimate_m.shape[-3] < 2:
        return skate
    step = np.diff(estimate_m[..., [0, 2]], axis=-3)
    skate[..., :-1, :] = np.linalg.norm(step, axis=-1) * rate_hz
    skate[~contact] = np.nan
    return skate
