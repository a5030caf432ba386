"""All sensors of one subject at once, held together by joint centres.

A keypoint that is always 20 mm off turns a limb's direction by the same angle at every instant, and
no recording is long enough to average it out. Sensors help: where both bones of a joint wear one,
the joint is the one point that neither's motion moves, wherever keypoints lie. With R_b = Y(psi_b)
G_b C_b^T from sensor b alone, the triangulated landmark k of instant t is

    P_tk = root_t + sum over the chain to b of R_c(t) s_c + R_b(t) (o_k + d_k) + noise

s_c leads from joint to joint along bones that wear sensors, d_k is how far the keypoint is from
its default. Gauss-Newton finds mountings C, headings psi, all d and the s, with priors: d about 0,
the s about the body's (lengths surer across than along), headings about a common one, and what
single sensors were fitted to (`fusecap.calibrate.imus.fit`), worth `REFERENCE_WORTH` independent
instants: joint limits, hinges and the pose prior speak through it where landmarks do not. Roots
are free at every instant and eliminated; a chain starts where the bone above wears no sensor.

A worked number (simulated, nine training recordings): elbows and wrists 11 mm off per axis leave an
upper arm's direction 2.7 deg off in the median as sensors are fitted alone, 1.3 deg here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from fusecap.body.landmarks import LandmarkSet
from fusecap.body.skeleton import Skeleton
from fusecap.calibrate.imus.fit import CORRELATION_S, Fit, Pairs, linearised, robust_weights
from fusecap.calibrate.offset_samples import SAME_INSTANT_NS, measure_offsets
from fusecap.geometry.camera import Rig
from fusecap.take import Take
from fusecap.types import Detections

MAX_INSTANTS = 100
"""Of a recording; more tell nothing new."""
LANDMARK_SIGMA_M = 0.012
"""Per axis, of a triangulated landmark against rigid bones, without its constant distance."""
LANDMARK_CORRELATION_S = 1.0
"""Errors of landmarks this far apart are independent."""
OFFSET_SIGMA_M = 0.020
"""Prior, per axis, of a keypoint's constant distance from its default."""
LENGTH_SIGMA = 0.03
"""Prior, of the distance between two joints, of that distance."""
ACROSS_SIGMA_M = {"hips": 0.006, "spine3": 0.006}
"""Prior, of a joint across that: where hips and shoulders sit differs between people."""
LIMB_ACROSS_SIGMA_M = 0.001
"""A limb's frame is defined along it."""
HEADING_SIGMA_RAD = np.radians(5.0)
"""Prior, of sensors' headings about their common one."""
REFERENCE_WORTH = 6.0
SIGMA_SCALE = 0.8
"""Root mean square of true errors over the normal equations' sigma, simulated training
recordings (docs/imu_calibration.md)."""
MAX_ITERATIONS = 8
CONVERGED_RAD = 1e-3
_CAUCHY = 4.6
_UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, kw_only=True)
class SeenLandmarks:
    """Triangulated landmarks of one subject: K at M instants."""

    times_s: Float[np.ndarray, " m"]
    """On the session's clock."""
    points_in_world_m: Float[np.ndarray, "m k 3"]
    """NaN where not triangulated."""
    landmark_bone: Int[np.ndarray, " k"]
    landmark_offset_m: Float[np.ndarray, "k 3"]
    """Defaults, in the bones' frames."""
    joint_offset_m: Float[np.ndarray, "b 3"]
    """From the parent's joint, in the parent's frame."""


def landmarks_seen(
    rig: Rig,
    landmarks: LandmarkSet,
    take: Take,
    subject: int,
    detections: Sequence[Detections],
) -> SeenLandmarks:
    """At up to `MAX_INSTANTS` of the given instants, those that the take also has."""
    landmarks = landmarks.of(take.subject_names[subject])
    bones = landmarks.bones(take.skeleton)
    when_ns, points = [], []
    for moment in detections[:: max(1, -(-len(detections) // MAX_INSTANTS))]:
        frame = int(np.argmin(np.abs(take.timestamps_ns - moment.timestamp_ns)))
        away_ns = abs(int(take.timestamps_ns[frame]) - moment.timestamp_ns)
        if away_ns > SAME_INSTANT_NS or not take.tracked[subject, frame]:
            continue
        instant = take.of_frames(frame, frame + 1)
        samples = measure_offsets(rig, landmarks, instant, [moment])
        mine = np.flatnonzero(samples.person == subject)
        if not len(mine):
            continue
        in_bone_m = samples.in_bone[mine[0]] * take.heights_m[subject]
        rotation = instant.bone_rotation_in_world(subject)[0][bones]
        place = instant.bone_position_in_world_m[subject, 0, bones]
        points.append(place + np.einsum("kij,kj->ki", rotation, in_bone_m))
        when_ns.append(moment.timestamp_ns)
    return SeenLandmarks(
        times_s=np.array(when_ns, dtype=np.float64) * 1e-9,
        points_in_world_m=np.array(points).reshape(-1, len(bones), 3),
        landmark_bone=np.asarray(bones),
        landmark_offset_m=landmarks.offsets_m(take.shape(subject)),
        joint_offset_m=take.offsets_m[subject],
    )


def fit_together(
    skeleton: Skeleton,
    seen: SeenLandmarks,
    bones: Sequence[int],
    sensors: Float[np.ndarray, "i m 3 3"],
    pairs: Sequence[Pairs],
    fits: Sequence[Fit],
    *,
    use: Bool[np.ndarray, " m"] | None = None,
) -> list[Fit]:
    """Sensors on different bones; `fits` is where the search starts.

    `sensors` are U R_i at the landmarks' instants, NaN where not measured; `use` leaves instants
    out. Where nobody's landmarks were seen, the fits come back as they are.
    """
    rows = np.ones(len(seen.times_s), bool) if use is None else use
    problem = _Problem(skeleton, seen, bones, sensors, rows)
    if not problem.known.any():
        return list(fits)
    mounting = np.array([each.bone_from_imu for each in fits])
    heading = np.array([each.heading_rad for each in fits])
    offsets = np.zeros((problem.size - 4 * problem.count) // 3 * 3)
    normal = np.eye(problem.size)
    for iteration in range(MAX_ITERATIONS):
        normal, gradient = problem.normal_equations(mounting, heading, offsets, iteration > 0)
        _add_single(normal, gradient, pairs, mounting, heading)
        step = -np.linalg.solve(normal, gradient)
        own = step[: 4 * problem.count].reshape(-1, 4)
        mounting = Rotation.from_rotvec(own[:, :3]).as_matrix() @ mounting
        heading = heading + own[:, 3]
        offsets = offsets + step[4 * problem.count :]
        if iteration >= 2 and np.abs(own).max() < CONVERGED_RAD:
            break
    covariance = SIGMA_SCALE**2 * np.linalg.inv(normal)
    return [
        replace(
            each,
            bone_from_imu=mounting[index],
            heading_rad=float(np.angle(np.exp(1j * heading[index]))),
            drift_rad_s=0.0,
            covariance=covariance[4 * index : 4 * index + 4, 4 * index : 4 * index + 4],
        )
        for index, each in enumerate(fits)
    ]


class _Problem:
    """What stays the same from step to step. Unknowns: per sensor (turn, heading), d_k, s_c."""

    def __init__(
        self,
        skeleton: Skeleton,
        seen: SeenLandmarks,
        bones: Sequence[int],
        sensors: Float[np.ndarray, "i m 3 3"],
        rows: Bool[np.ndarray, " m"],
    ) -> None:
        self.count = len(bones)
        worn = {bone: index for index, bone in enumerate(bones)}
        chain: dict[int, list[int]] = {}
        for bone in sorted(bones):
            chain[bone] = [*chain.get(skeleton.parents[bone], []), bone]
        used, carrier, vector = [], [], []
        for landmark, bone in enumerate(seen.landmark_bone.tolist()):
            offset, above = seen.landmark_offset_m[landmark], skeleton.parents[bone]
            if bone in worn:
                place = (bone, offset)
            elif above in worn:
                place = (above, seen.joint_offset_m[bone] + offset)
            else:
                continue
            used.append(landmark)
            carrier.append(place[0])
            vector.append(place[1])
        joints = [bone for bone in bones if skeleton.parents[bone] in worn]
        self.vectors = np.array([*vector, *seen.joint_offset_m[joints]]).reshape(-1, 3)
        self.size = 4 * self.count + self.vectors.size
        # Per landmark the (sensor, vector) pairs that lead to it from where its chain starts.
        self.paths = [
            [
                (worn[link], len(used) + joints.index(below))
                for link, below in zip(chain[bone], chain[bone][1:], strict=False)
            ]
            + [(worn[bone], landmark)]
            for landmark, bone in enumerate(carrier)
        ]
        roots = [chain[bone][0] for bone in carrier]
        self.groups = [np.flatnonzero(np.array(roots) == root) for root in sorted(set(roots))]
        sensors = sensors[:, rows]
        valid: np.ndarray = np.asarray(np.isfinite(sensors).all((2, 3)))
        points = seen.points_in_world_m[rows][:, used]
        self.known = np.isfinite(points[..., 0]) & np.all(valid, axis=0).reshape(-1, 1)
        self.sensors = np.where(valid[:, :, None, None], sensors, np.eye(3))
        self.points = np.where(self.known[..., None], points, 0.0)
        seconds = float(np.ptp(seen.times_s[rows])) if rows.any() else 0.0
        count = max(int(self.known.any(axis=1).sum()), 1)
        self.worth = min(1.0, seconds / LANDMARK_CORRELATION_S / count)
        self.prior = self._prior(skeleton, seen, joints, len(used))

    def _prior(
        self, skeleton: Skeleton, seen: SeenLandmarks, joints: list[int], landmarks: int
    ) -> Float[np.ndarray, "p p"]:
        prior = np.zeros((self.size, self.size))
        first = 4 * self.count
        last = first + 3 * landmarks
        prior[range(first, last), range(first, last)] = OFFSET_SIGMA_M**-2
        for number, bone in enumerate(joints):
            offset = seen.joint_offset_m[bone]
            above = skeleton.bone_names[skeleton.parents[bone]]
            across = ACROSS_SIGMA_M.get(above, LIMB_ACROSS_SIGMA_M)
            covariance = across**2 * np.eye(3) + LENGTH_SIGMA**2 * np.outer(offset, offset)
            at = slice(last + 3 * number, last + 3 * number + 3)
            prior[at, at] = np.linalg.inv(covariance)
        turns = np.arange(3, first, 4)
        common = np.eye(self.count) - np.full((self.count, self.count), 1 / self.count)
        prior[np.ix_(turns, turns)] = common / HEADING_SIGMA_RAD**2
        prior[range(first), range(first)] += 1e-6
        return prior

    def normal_equations(
        self,
        mounting: Float[np.ndarray, "i 3 3"],
        heading_rad: Float[np.ndarray, " i"],
        offsets: Float[np.ndarray, " q"],
        robust: bool,
    ) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
        """Of landmarks and priors, with every root eliminated."""
        error, jacobian = self.residuals(mounting, heading_rad, offsets)
        weight = self.known.astype(np.float64)
        centred = self._centred(error, weight)
        for _ in range(3 if robust else 0):
            distance = np.linalg.norm(centred, axis=2) / LANDMARK_SIGMA_M
            weight = self.known / (1.0 + (distance / _CAUCHY) ** 2)
            centred = self._centred(error, weight)
        root = np.sqrt(weight)
        shape = (-1, self.size)
        rows = (self._centred(jacobian, weight) * root[:, :, None, None]).reshape(shape)
        scale = self.worth / LANDMARK_SIGMA_M**2
        away = np.zeros(self.size)
        away[3 : 4 * self.count : 4] = np.angle(np.exp(1j * (heading_rad - heading_rad[0])))
        away[4 * self.count :] = offsets
        return (
            scale * rows.T @ rows + self.prior,
            scale * rows.T @ (centred * root[:, :, None]).ravel() + self.prior @ away,
        )

    def residuals(
        self,
        mounting: Float[np.ndarray, "i 3 3"],
        heading_rad: Float[np.ndarray, " i"],
        offsets: Float[np.ndarray, " q"],
    ) -> tuple[Float[np.ndarray, "m k 3"], Float[np.ndarray, "m k 3 p"]]:
        """Predicted less triangulated landmarks, up to the root, and the derivatives."""
        vectors = self.vectors + offsets.reshape(-1, 3)
        spin = Rotation.from_rotvec(np.outer(heading_rad, _UP)).as_matrix()
        bone = spin[:, None] @ self.sensors @ np.swapaxes(mounting, 1, 2)[:, None]
        error = -self.points
        jacobian = np.zeros((*error.shape, self.size))
        for landmark, path in enumerate(self.paths):
            for sensor, number in path:
                reach = bone[sensor] @ vectors[number]
                error[:, landmark] += reach
                at = 4 * sensor
                jacobian[:, landmark, :, at : at + 3] += bone[sensor] @ _cross(vectors[number])
                jacobian[:, landmark, :, at + 3] += np.cross(_UP, reach)
                at = 4 * self.count + 3 * number
                jacobian[:, landmark, :, at : at + 3] += bone[sensor]
        error[~self.known] = 0.0
        jacobian[~self.known] = 0.0
        return error, jacobian

    def _centred(
        self, values: Float[np.ndarray, "m k *_"], weight: Float[np.ndarray, "m k"]
    ) -> Float[np.ndarray, "m k *_"]:
        """Less each chain's weighted mean: its root moved to where it fits best."""
        result = np.empty_like(values)
        for group in self.groups:
            share = weight[:, group] / np.maximum(weight[:, group].sum(axis=1), 1e-12)[:, None]
            part = values[:, group]
            mean = share[:, None] @ part.reshape(*part.shape[:2], -1)
            result[:, group] = part - mean.reshape(-1, 1, *part.shape[2:])
        return result


def _add_single(
    normal: Float[np.ndarray, "p p"],
    gradient: Float[np.ndarray, " p"],
    pairs: Sequence[Pairs],
    mounting: Float[np.ndarray, "i 3 3"],
    heading_rad: Float[np.ndarray, " i"],
) -> None:
    """What each sensor says alone; a T-pose, which no keypoint moves, counts fully."""
    for index, some in enumerate(pairs):
        heading = np.full(len(some), heading_rad[index])
        error, jacobian = linearised(some, mounting[index], heading)
        stretches = max(len(np.unique(some.block[some.block >= 0])), 1)
        worth = np.where(some.block >= 0, min(REFERENCE_WORTH / stretches, 1.0), 1.0)
        weight = robust_weights(some, error) * worth
        weighted = (some.information @ jacobian) * weight[:, None, None]
        at = slice(4 * index, 4 * index + 4)
        normal[at, at] += np.einsum("nij,nik->jk", jacobian, weighted)
        gradient[at] += np.einsum("nij,ni->j", weighted, error)


def held_back(times_s: Float[np.ndarray, " m"], pairs: Pairs) -> Int[np.ndarray, " m"]:
    """The stretch of `pairs` that each instant belongs to."""
    recorded = np.flatnonzero(pairs.block >= 0)
    first = recorded[0]
    origin = np.floor(pairs.times_s[first] / CORRELATION_S) - pairs.block[first]
    return (np.floor(times_s / CORRELATION_S) - origin).astype(np.int64)


def _cross(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
