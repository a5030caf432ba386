"""How one sensor sits on its bone and where its world faces, from how the bone turned.

At every instant, with R the bone's rotation as the reference has it, G = U R_i the sensor's own
orientation with up brought to y, Y(psi) a turn about up and C = R_ib:

    E = R^T Y(psi) G C^T,     e = log E,     cost = sum of rho(e^T L e)

L is the inverse of the reference's covariance and the sensor's own. Both start in closed form. With
W = trace(L)/2 1 - L, the chordal cost whose curvature at e = 0 is L is minimal where
tr(C^T B) is maximal, B(psi) = sum of W R^T Y(psi) G = B0 + cos(psi) Bc + sin(psi) Bs: for every
psi of a grid an SVD of B gives the best C (Wahba's problem), and the grid's best psi the start. It
is global: a sensor mounted any way round is found. Gauss-Newton then minimises the cost itself,
with

    C -> exp(d) C:   de = -Jr^-1(e) d            psi -> psi + a:   de = Jl^-1(e) R^T y a

(the right and left Jacobians of SO(3); Chirikjian, "Stochastic Models, Information Theory, and Lie
Groups", vol. 2, sec. 10.8) and Cauchy weights on sqrt(e^T L e).

Errors of neighbouring instants are alike, so a recording of many instants is worth only one per
`CORRELATION_S`: L is scaled down to that, and priors (the heading that sensors share, a T-pose)
weigh what they should.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

CORRELATION_S = 2.0
"""Errors this far apart are independent."""
SENSOR_SIGMA_RAD = np.radians(2.0)
"""Per axis, of a sensor's own orientation in motion (Xsens, MTi and MTx user manual, MT0100P rev.
N, sec. 4.2)."""
CONSTANT_SHARE = 0.3
"""Of the reference's variance: landmarks that are always off the same way. No recording, however
long, averages it out."""
HEADING_STEPS = 72
MAX_ITERATIONS = 15
_CAUCHY = 2.4
_CHI3_MEDIAN = 1.538
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """N instants at which a bone and a sensor are both known."""

    times_s: Float[np.ndarray, " n"]
    bone_in_world: Float[np.ndarray, "n 3 3"]
    sensor_in_imu_world: Float[np.ndarray, "n 3 3"]
    """With up along y: U R_i."""
    information: Float[np.ndarray, "n 3 3"]
    """L [1/rad²] in the bone's frame, each instant worth its share of independent ones."""
    block: Int[np.ndarray, " n"]
    """Which stretch of `CORRELATION_S` each belongs to; -1: knowledge that is not a stretch of the
    recording."""

    def __len__(self) -> int:
        return len(self.times_s)

    def where(self, mask: Bool[np.ndarray, " n"]) -> Pairs:
        """Those of the mask, and knowledge of block -1."""
        mask = mask | (self.block < 0)
        return Pairs(
            times_s=self.times_s[mask],
            bone_in_world=self.bone_in_world[mask],
            sensor_in_imu_world=self.sensor_in_imu_world[mask],
            information=self.information[mask],
            block=self.block[mask],
        )


@dataclass(frozen=True, kw_only=True)
class HeadingPrior:
    """What is known of a sensor's heading before its motion is looked at."""

    mean_rad: float = 0.0
    sigma_rad: float = np.inf


FREE = HeadingPrior()


@dataclass(frozen=True, kw_only=True)
class Fit:
    """The result for one sensor; angles [rad]."""

    bone_from_imu: Float[np.ndarray, "3 3"]
    heading_rad: float
    """In the middle of the recording."""
    drift_rad_s: float
    middle_s: float
    covariance: Float[np.ndarray, "p p"]
    """Of (turn of bone_from_imu in the bone's frame (3), heading, drift where it was fitted)."""
    cost: float
    """Robust, per independent instant."""

    def heading_at(self, times_s: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """With its drift [rad]."""
        return self.heading_rad + self.drift_rad_s * (times_s - self.middle_s)

    def errors(self, pairs: Pairs) -> Float[np.ndarray, "n 3"]:
        """The rotation e [rad] from the reference's bone to the sensor's, in the bone's frame."""
        return _errors(pairs, self.bone_from_imu, self.heading_at(pairs.times_s))

    def sigma_rad(self, pairs: Pairs) -> Float[np.ndarray, "3"]:
        """Standard deviation, about the bone's axes, of the bone's rotation as this calibrates it.

        Over the given poses: a heading and a mounting that are unsure only together count once.
        """
        _, jacobian = _linearised(
            pairs, self.bone_from_imu, self.heading_at(pairs.times_s), np.zeros(len(pairs)), 4
        )
        spread = np.einsum("nij,jk,nik->ni", jacobian, self.covariance[:4, :4], jacobian)
        return np.sqrt(spread.mean(axis=0))


def make_pairs(
    times_s: Float[np.ndarray, " t"],
    bone_in_world: Float[np.ndarray, "t 3 3"],
    covariance_rad2: Float[np.ndarray, "t 3 3"],
    sensor_in_imu_world: Float[np.ndarray, "t 3 3"],
) -> Pairs:
    """The instants at which both are known (not NaN), weighed."""
    known = np.isfinite(bone_in_world).all((1, 2)) & np.isfinite(sensor_in_imu_world).all((1, 2))
    times_s = times_s[known]
    block = np.floor(times_s / CORRELATION_S).astype(np.int64) if known.any() else np.zeros(0, int)
    block -= block.min() if len(block) else 0
    worth = len(np.unique(block)) / max(len(block), 1)
    covariance = covariance_rad2[known] + np.eye(3) * SENSOR_SIGMA_RAD**2
    return Pairs(
        times_s=times_s,
        bone_in_world=bone_in_world[known],
        sensor_in_imu_world=sensor_in_imu_world[known],
        information=np.linalg.inv(covariance) * worth,
        block=block,
    )


def with_known_pose(
    pairs: Pairs,
    bone_in_world: Float[np.ndarray, "3 3"],
    sensor_in_imu_world: Float[np.ndarray, "3 3"],
    time_s: float,
    sigma_rad: float,
) -> Pairs:
    """The pairs and one more, independent of the cameras: a bone's rotation in a T-pose."""
    return Pairs(
        times_s=np.append(pairs.times_s, time_s),
        bone_in_world=np.concatenate([pairs.bone_in_world, bone_in_world[None]]),
        sensor_in_imu_world=np.concatenate([pairs.sensor_in_imu_world, sensor_in_imu_world[None]]),
        information=np.concatenate([pairs.information, np.eye(3)[None] / sigma_rad**2]),
        block=np.append(pairs.block, -1),
    )


def start(pairs: Pairs, prior: HeadingPrior = FREE) -> tuple[Float[np.ndarray, "3 3"], float]:
    """R_ib and heading [rad] that minimise the chordal cost, over all rotations and headings."""
    trace = np.trace(pairs.information, axis1=1, axis2=2)
    vectors = trace[:, None, None] / 2 * np.eye(3) - pairs.information
    left = vectors @ np.swapaxes(pairs.bone_in_world, 1, 2)
    upright = np.outer(_UP, _UP)
    spin = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    fixed, cosine, sine = (
        np.sum(left @ part @ pairs.sensor_in_imu_world, axis=0)
        for part in (upright, np.eye(3) - upright, spin)
    )
    heading = 2 * np.pi * np.arange(HEADING_STEPS) / HEADING_STEPS
    profile = (
        fixed + np.cos(heading)[:, None, None] * cosine + np.sin(heading)[:, None, None] * sine
    )
    u, singular, vt = np.linalg.svd(profile)
    sign = np.linalg.det(u) * np.linalg.det(vt)
    gain = singular[:, 0] + singular[:, 1] + sign * singular[:, 2]
    away = np.angle(np.exp(1j * (heading - prior.mean_rad)))
    best = int(np.argmax(gain - 0.5 * (away / prior.sigma_rad) ** 2))
    turn = np.diag([1.0, 1.0, sign[best]])
    return u[best] @ turn @ vt[best], float(heading[best])


def fit(
    pairs: Pairs,
    prior: HeadingPrior = FREE,
    *,
    drift_sigma_rad_s: float = 0.0,
    max_iterations: int = MAX_ITERATIONS,
) -> Fit:
    """The robust minimum from the closed-form start; needs three pairs or more.

    A heading that may drift gets one more parameter, with a prior deviation about zero.
    """
    mounting, heading = start(pairs, prior)
    recorded = pairs.times_s[pairs.block >= 0]
    middle_s = float((recorded[0] + recorded[-1]) / 2)
    ahead_s = np.where(pairs.block >= 0, pairs.times_s - middle_s, 0.0)
    size = 5 if drift_sigma_rad_s > 0 else 4
    knowledge = np.zeros(size)
    knowledge[3] = prior.sigma_rad**-2
    if size == 5:
        knowledge[4] = drift_sigma_rad_s**-2
    drift = 0.0
    for iteration in range(max_iterations):
        error, jacobian = _linearised(pairs, mounting, heading + drift * ahead_s, ahead_s, size)
        # The first steps are taken plainly: a rough start must not make good pairs look bad.
        weight = np.ones(len(pairs)) if iteration < 2 else robust_weights(pairs, error)
        weighted = (pairs.information @ jacobian) * weight[:, None, None]
        normal = np.einsum("nij,nik->jk", jacobian, weighted) + np.diag(knowledge)
        gradient = np.einsum("nij,ni->j", weighted, error)
        away = np.array([0.0, 0.0, 0.0, _turn(heading - prior.mean_rad), drift][:size])
        step = -np.linalg.solve(normal + 1e-9 * np.eye(size), gradient + knowledge * away)
        mounting = Rotation.from_rotvec(step[:3]).as_matrix() @ mounting
        heading = _turn(heading + step[3])
        drift += step[4] if size == 5 else 0.0
        if iteration >= 3 and np.linalg.norm(step[:4]) < 1e-5:
            break
    error, jacobian = _linearised(pairs, mounting, heading + drift * ahead_s, ahead_s, size)
    weight = robust_weights(pairs, error)
    squared = np.einsum("ni,nij,nj->n", error, pairs.information, error)
    return Fit(
        bone_from_imu=mounting,
        heading_rad=heading,
        drift_rad_s=drift,
        middle_s=middle_s,
        covariance=_covariance(pairs, error, jacobian, weight, knowledge),
        cost=float(np.sum(weight * squared) / max(len(np.unique(pairs.block)), 1)),
    )


def robust_weights(pairs: Pairs, error: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Cauchy's, scaled by the median of the recording's own errors."""
    recorded = pairs.block >= 0
    worth = np.where(recorded, _worth(pairs), 1.0)
    distance = np.sqrt(np.einsum("ni,nij,nj->n", error, pairs.information, error) / worth)
    scale = float(np.median(distance[recorded])) / _CHI3_MEDIAN if recorded.any() else 1.0
    return 1.0 / (1.0 + (distance / (_CAUCHY * max(scale, 0.2))) ** 2)


def observed_share(pairs: Pairs) -> Float[np.ndarray, "n 3 3"]:
    """Information scaled to 1 about the axis that is known best: weighs axes for residuals."""
    return pairs.information / np.linalg.eigvalsh(pairs.information)[:, -1][:, None, None]


def residual_rad(pairs: Pairs, error: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Size of e about axes that the reference observes; a limb's twist hardly counts."""
    squared = np.einsum("ni,nij,nj->n", error, observed_share(pairs), error)
    return np.sqrt(np.maximum(squared, 0.0))


def _worth(pairs: Pairs) -> float:
    """Of one instant, in independent ones."""
    recorded = pairs.block[pairs.block >= 0]
    return len(np.unique(recorded)) / max(len(recorded), 1)


def _errors(
    pairs: Pairs, mounting: Float[np.ndarray, "3 3"], heading_rad: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    spin = Rotation.from_rotvec(np.outer(heading_rad, _UP)).as_matrix()
    between = np.swapaxes(pairs.bone_in_world, 1, 2) @ spin @ pairs.sensor_in_imu_world @ mounting.T
    return Rotation.from_matrix(between).as_rotvec()


def _linearised(
    pairs: Pairs,
    mounting: Float[np.ndarray, "3 3"],
    heading_rad: Float[np.ndarray, " n"],
    ahead_s: Float[np.ndarray, " n"],
    size: int,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 p"]]:
    """The error and its derivatives by (mounting, heading, drift)."""
    error = _errors(pairs, mounting, heading_rad)
    right = inverse_right_jacobian(error)
    jacobian = np.zeros((len(pairs), 3, size))
    jacobian[:, :, :3] = -right
    up_in_bone = pairs.bone_in_world[:, 1, :]
    jacobian[:, :, 3] = np.einsum("nji,nj->ni", right, up_in_bone)
    if size == 5:
        jacobian[:, :, 4] = jacobian[:, :, 3] * ahead_s[:, None]
    return error, jacobian


def inverse_right_jacobian(vector: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Jr^-1 of SO(3), whose transpose is Jl^-1; finite up to just below pi."""
    angle = np.minimum(np.linalg.norm(vector, axis=1), np.pi - 1e-3)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    factor = np.where(small, 1 / 12, 1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2)))
    x, y, z = vector.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + cross / 2 + factor[:, None, None] * (cross @ cross)


def linearised(
    pairs: Pairs, mounting: Float[np.ndarray, "3 3"], heading_rad: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 4"]]:
    """The error e and its derivatives by (turn of the mounting, heading)."""
    return _linearised(pairs, mounting, heading_rad, np.zeros(len(pairs)), 4)


def _covariance(
    pairs: Pairs,
    error: Float[np.ndarray, "n 3"],
    jacobian: Float[np.ndarray, "n 3 p"],
    weight: Float[np.ndarray, " n"],
    knowledge: Float[np.ndarray, " p"],
) -> Float[np.ndarray, "p p"]:
    """The larger of the normal equations' and the sandwich's (how stretches of time scatter).

    On top comes the part of the reference's error that is always the same.
    """
    weighted = (pairs.information @ jacobian) * weight[:, None, None]
    each = np.einsum("nij,nik->njk", jacobian, weighted)
    normal = each.sum(axis=0) + np.diag(knowledge)
    inverse = np.linalg.inv(normal + 1e-9 * np.eye(len(normal)))
    score = np.einsum("nij,ni->nj", weighted, error)
    blocks = np.unique(pairs.block)
    per_block = np.array([score[pairs.block == b].sum(axis=0) for b in blocks])
    freedom = len(blocks) / max(len(blocks) - 1, 1)
    sandwich = inverse @ (freedom * per_block.T @ per_block) @ inverse
    recorded = len(blocks[blocks >= 0])
    scattered = inverse if np.trace(inverse[:3, :3]) > np.trace(sandwich[:3, :3]) else sandwich
    return scattered + CONSTANT_SHARE * max(recorded, 1) * inverse


def _turn(angle_rad: float) -> float:
    return float(np.angle(np.exp(1j * angle_rad)))
