"""The terms between instants in slow NumPy that reads like their derivations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 9.80665, 0.0])
LOSS_SCALE = 9.0


def heavy_tailed(weight, residual):
    """½ k log(1 + λ ‖r‖² / k)."""
    return 0.5 * LOSS_SCALE * np.log1p(weight * residual @ residual / LOSS_SCALE)


def bones_in_world(shape, theta):
    """(rotation, position) per bone [1, eq. 1]."""
    rotations, positions = [], []
    for bone, parent in enumerate(shape.skeleton.parents):
        local = Rotation.from_rotvec(theta[3 + 3 * bone : 6 + 3 * bone])
        if parent < 0:
            rotations.append(local)
            positions.append(theta[:3])
        else:
            rotations.append(rotations[parent] * local)
            positions.append(positions[parent] + rotations[parent].apply(shape.offsets_m[bone]))
    return rotations, positions


def increment(shape, sites, weight, theta, measured):
    """A bone turns from one instant to the next as its sensor did: 2 v of Dᵀ D̂."""
    cost = 0.0
    for before, after, m0, m1 in zip(theta, theta[1:], measured, measured[1:], strict=False):
        r0, r1 = bones_in_world(shape, before)[0], bones_in_world(shape, after)[0]
        for i, bone in enumerate(sites.bone):
            if np.isnan(m0[i]).any() or np.isnan(m1[i]).any():
                continue
            solved = r0[bone].inv() * r1[bone]
            sensed = Rotation.from_matrix(m0[i]).inv() * Rotation.from_matrix(m1[i])
            x, y, z, w = (solved.inv() * sensed).as_quat()
            cost += heavy_tailed(weight, 2 * np.array([x, y, z]) * (1.0 if w >= 0 else -1.0))
    return cost


def specific_force(shape, sites, weight, theta, force, times_s):
    """r = R₁ᵀ (a + g) - f, a from three places at their own times."""
    cost = 0.0
    posed = [bones_in_world(shape, one) for one in theta]
    for t in range(1, len(theta) - 1):
        h0, h1 = times_s[t] - times_s[t - 1], times_s[t + 1] - times_s[t]
        for i, bone in enumerate(sites.bone):
            if np.isnan(force[t, i]).any():
                continue
            x0, x1, x2 = (
                posed[k][1][bone] + posed[k][0][bone].apply(sites.position_m[i])
                for k in (t - 1, t, t + 1)
            )
            accel = ((x2 - x1) / h1 - (x1 - x0) / h0) / ((h0 + h1) / 2)
            felt = posed[t][0][bone].inv().apply(accel + GRAVITY)
            cost += heavy_tailed(weight, felt - force[t, i])
    return cost


def motion(weights, theta, times_s):
    """Joints and the root keep their velocity; `weights` (1 + B,) of the root, then joints."""
    cost = 0.0
    for t in range(1, len(theta) - 1):
        h0, h1 = times_s[t] - times_s[t - 1], times_s[t + 1] - times_s[t]
        mean = (h0 + h1) / 2
        root = (theta[t + 1, :3] - theta[t, :3]) / h1 - (theta[t, :3] - theta[t - 1, :3]) / h0
        cost += heavy_tailed(weights[0], root / mean)
        for bone, weight in enumerate(weights[1:]):
            r0, r1, r2 = (
                Rotation.from_rotvec(theta[k, 3 + 3 * bone : 6 + 3 * bone])
                for k in (t - 1, t, t + 1)
            )
            turn = (r1.inv() * r2).as_rotvec() / h1 - (r0.inv() * r1).as_rotvec() / h0
            cost += heavy_tailed(weight, turn / mean)
    return cost


def rest(shape, floor_bones, weight, contact, theta, times_s):
    """What stands does not move: r = (x₁ - x₀) / h, counted by `contact` (T, F)."""
    cost = 0.0
    for t in range(1, len(theta)):
        before, after = bones_in_world(shape, theta[t - 1])[1], bones_in_world(shape, theta[t])[1]
        for share, bone in zip(contact[t], floor_bones, strict=True):
            speed = (after[bone] - before[bone]) / (times_s[t] - times_s[t - 1])
            cost += share * heavy_tailed(weight, speed)
    return cost
