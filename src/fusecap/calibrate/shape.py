"""Bone lengths of a person from a range of motion, with what is known about their errors.

A keypoint does not lie on a joint. The distance from the hip's keypoint to the knee's is the thigh
plus two offsets of a centimetre or two that every detector has and nobody knows, and averaging over
frames does not remove them. Motion removes some: an offset turns with its bone, so with the knee
bent the distance reads differently than with the leg straight. For bone rotations R_b known from a
solve, the triangulated landmark k on bone b of instant t is linear in all unknowns:

    P_tk = root_t + sum over the chain to b of R_t,parent(c) u_c l_c + R_tb o_k + noise

u_c the direction of bone c in its parent, l_c its length, o_k the landmark's offset. Root
positions are eliminated, the rest is one weighted least-squares problem, with priors where motion
does not tell: offsets about their defaults, lengths about the proportions of the stature, left
about right. Solves and fits alternate (`ROUNDS`), for rotations depend a little on lengths.

The covariance of that fit is the stated uncertainty. Errors of a detector last: samples count as
fewer by their autocorrelation, and rotations err as well (`MODEL_SIGMA_M`).

Worked number: the two offsets of a thigh, 12 mm of ignorance each, make 17 mm; what the fit leaves
of it on simulated bodies is in docs/body_shape.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from fusecap.batch.solve import Instants, solve_instants
from fusecap.body.landmarks import LandmarkSet
from fusecap.body.shape import MAX_HEIGHT_M, MIN_HEIGHT_M, BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.calibrate.offset_samples import (
    MIN_SAMPLES,
    measure_offsets,
    reprojection_error_px,
)
from fusecap.calibrate.offsets import JOINT_SIGMA, SURFACE_SIGMA
from fusecap.errors import InputError, nearest
from fusecap.evaluate.metrics import Summary
from fusecap.progress import Progress
from fusecap.setup import Setup
from fusecap.solve.estimator import SubjectModel
from fusecap.sources.toml_text import quoted
from fusecap.take import Take

ROUNDS = 2
LENGTH_SIGMA = 0.04
"""Prior standard deviation of a bone's length from the stature's proportions, of that length: an
assumption, a little wider than that of the simulated bodies (0.03)."""
SYMMETRY_SIGMA_M = 0.004
"""Standard deviation of left from right."""
MODEL_SIGMA_M = 0.010
"""Error of a fitted length that motion does not average out: of rotations and of the model.

Raised from 0.007, with which too few lengths of simulated bodies lay within two standard deviations
(docs/body_shape.md)."""
HELD_OUT_SHARE = 0.25
MAX_INSTANTS = 400
"""Fitted; more of one recording do not tell more."""
HUBER = 2.0
"""In standard deviations: samples farther off count less."""
STATURE_SIGMA = 0.03
"""Of a stature that follows from bone lengths, of the stature: proportions differ."""

_JOINT_WORDS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")


@dataclass(frozen=True, kw_only=True)
class BoneLength:
    """One bone's length, the distance [m] between its joint and its parent's."""

    bone: str
    length_m: float
    sigma_m: float
    """Standard deviation."""
    told: bool
    """By data; else the stature's proportions are surer than what this recording shows of it."""
    from_height_m: float
    """What the stature alone says."""
    asymmetry_m: float | None
    """Left minus right, fitted without the assumption of symmetry; None in the middle."""
    asymmetry_sigma_m: float | None


@dataclass(frozen=True, kw_only=True)
class MeasuredBody:
    """One person."""

    name: str
    height_m: float
    height_sigma_m: float
    """0 where the session states it."""
    height_stated: bool
    bones: tuple[BoneLength, ...]
    instants: int
    shape: BodyShape

    @property
    def lengths_m(self) -> dict[str, float]:
        """Those told by data: `bone_lengths_m` of a session's subject."""
        return {bone.bone: bone.length_m for bone in self.bones if bone.told}


@dataclass(frozen=True, kw_only=True)
class ShapeCalibration:
    """Everyone, and what the instants that were not used say."""

    bodies: tuple[MeasuredBody, ...]
    held_out_before_px: Summary
    """Distance of keypoints from the projected landmarks, with the bodies the session had."""
    held_out_after_px: Summary


Part = Callable[[int, int], Instants]
"""The instants first to end (excluded)."""


def calibrate_shape(
    setup: Setup,
    part: Part,
    instants: int,
    *,
    heights_m: Mapping[str, float],
    subject: str | None = None,
    progress: Progress | None = None,
) -> ShapeCalibration:
    """Bodies from the first three quarters of a recording, checked on the rest.

    `heights_m` are the stated statures. Raises `InputError` where nobody can be measured.
    """
    trained = instants - round(HELD_OUT_SHARE * instants)
    if len(setup.rig) < 2:
        raise InputError(f"bone lengths need two cameras or more, found {len(setup.rig)}")
    bodies = measure_bodies(
        setup, part(0, trained), heights_m=heights_m, subject=subject, progress=progress
    )
    rest = part(trained, instants)
    held_out = [rest.detections(instant) for instant in range(len(rest))]
    before = solve_instants(setup, rest, progress=progress).whole_take
    shapes = {body.name: body.shape for body in bodies}
    measured = replace(setup, subjects=_models(setup, before, shapes))
    after = solve_instants(measured, rest, progress=progress).whole_take
    return ShapeCalibration(
        bodies=bodies,
        held_out_before_px=reprojection_error_px(setup.rig, setup.landmarks, before, held_out),
        held_out_after_px=reprojection_error_px(setup.rig, setup.landmarks, after, held_out),
    )


def measure_bodies(
    setup: Setup,
    instants: Instants,
    *,
    heights_m: Mapping[str, float],
    subject: str | None = None,
    progress: Progress | None = None,
) -> tuple[MeasuredBody, ...]:
    """Alternates solves and fits over all these instants."""
    take = solve_instants(setup, instants, progress=progress).whole_take
    if subject is not None and subject not in take.subject_names:
        raise InputError(
            f"no '{subject}' was found in the session{nearest(subject, take.subject_names)}"
        )
    bodies: dict[str, MeasuredBody] = {}
    for round_ in range(ROUNDS):
        if round_:
            shapes = {name: body.shape for name, body in bodies.items()}
            setup = replace(setup, subjects=_models(setup, take, shapes))
            take = solve_instants(setup, instants, progress=progress).whole_take
        for index, name in enumerate(take.subject_names):
            if subject is not None and name != subject:
                continue
            moments = _moments(setup, take, index, instants)
            if len(moments.points) >= MIN_SAMPLES:
                bodies[name] = _fitted(
                    setup.skeleton,
                    setup.landmarks.of(name),
                    name,
                    moments,
                    heights_m.get(name),
                    float(take.heights_m[index]),
                )
    if not bodies:
        raise InputError(
            f"nobody was triangulated in {MIN_SAMPLES} instants or more; look at the session with: "
            "fusecap doctor"
        )
    return tuple(bodies.values())


@dataclass(frozen=True, kw_only=True)
class _Moments:
    points: Float[np.ndarray, "t k 3"]
    """Triangulated landmarks in the world [m]; NaN where missing."""
    rotation: Float[np.ndarray, "t b 3 3"]


def _moments(setup: Setup, take: Take, subject: int, instants: Instants) -> _Moments:
    frames = np.flatnonzero(take.tracked[subject])
    frames = frames[:: max(1, len(frames) // MAX_INSTANTS)]
    rotation = take.bone_rotation_in_world(subject)
    bones = setup.landmarks.bones(setup.skeleton)
    points, kept = [], []
    for frame in frames:
        moment = instants.detections(int(frame))
        samples = measure_offsets(setup.rig, setup.landmarks, take, [moment])
        row = np.flatnonzero(samples.person == subject)
        if len(row):
            local = samples.in_bone[row[0]] * take.heights_m[subject]
            turned = np.einsum("kij,kj->ki", rotation[frame][bones], local)
            points.append(take.bone_position_in_world_m[subject, frame][bones] + turned)
            kept.append(frame)
    return _Moments(
        points=np.array(points).reshape(-1, len(bones), 3), rotation=rotation[np.array(kept, int)]
    )


def _models(setup: Setup, take: Take, shapes: Mapping[str, BodyShape]) -> tuple[SubjectModel, ...]:
    """The setup's subjects, and people it did not name, with these shapes."""
    known = {model.name: model for model in setup.subjects}
    models = []
    for index, name in enumerate(take.subject_names):
        model = known.get(name) or SubjectModel(name=name, start_m=_start_m(take, index))
        models.append(replace(model, shape=shapes.get(name, model.shape)))
    return tuple(models)


def _start_m(take: Take, subject: int) -> tuple[float, float] | None:
    seen = np.flatnonzero(take.tracked[subject])
    if not len(seen):
        return None
    root = take.bone_position_in_world_m[subject, seen[0], 0]
    return float(root[0]), float(root[2])


def _fitted(
    skeleton: Skeleton,
    landmarks: LandmarkSet,
    name: str,
    moments: _Moments,
    stated_m: float | None,
    guess_m: float,
) -> MeasuredBody:
    problem = _Problem(skeleton, landmarks, moments)
    height_m, height_sigma_m = stated_m or guess_m, 0.0
    lengths, covariance = problem.solve(height_m, symmetric=True)
    if stated_m is None:
        for _ in range(2):
            height_m, height_sigma_m = _stature(skeleton, lengths, covariance, height_m)
            lengths, covariance = problem.solve(height_m, symmetric=True)
    free, free_covariance = problem.solve(height_m, symmetric=False)
    proportions = _lengths(BodyShape.from_height(skeleton, height_m))
    bones = []
    for index, bone in enumerate(skeleton.bone_names[1:]):
        sigma = float(np.hypot(np.sqrt(covariance[index, index]), MODEL_SIGMA_M))
        told = sigma < LENGTH_SIGMA * proportions[index]
        asymmetry = asymmetry_sigma = None
        if bone.startswith("left_"):
            other = skeleton.bone(f"right_{bone.removeprefix('left_')}") - 1
            asymmetry = float(free[index] - free[other])
            pair = [index, other]
            spread = np.array([1.0, -1.0]) @ free_covariance[np.ix_(pair, pair)] @ [1.0, -1.0]
            asymmetry_sigma = float(np.sqrt(spread + 2 * MODEL_SIGMA_M**2))
        bones.append(
            BoneLength(
                bone=bone,
                length_m=float(lengths[index] if told else proportions[index]),
                sigma_m=min(sigma, LENGTH_SIGMA * float(proportions[index])),
                told=bool(told),
                from_height_m=float(proportions[index]),
                asymmetry_m=asymmetry,
                asymmetry_sigma_m=asymmetry_sigma,
            )
        )
    shape = BodyShape.from_height(skeleton, height_m)
    return MeasuredBody(
        name=name,
        height_m=height_m,
        height_sigma_m=height_sigma_m,
        height_stated=stated_m is not None,
        bones=tuple(bones),
        instants=len(moments.points),
        shape=shape.with_lengths({bone.bone: bone.length_m for bone in bones if bone.told}),
    )


class _Problem:
    """The linear least-squares problem of one person."""

    def __init__(self, skeleton: Skeleton, landmarks: LandmarkSet, moments: _Moments) -> None:
        self._skeleton, self._landmarks = skeleton, landmarks
        self._count = skeleton.bone_count - 1
        self._size = self._count + 3 * len(landmarks.landmark_names)
        self._seen = np.isfinite(moments.points[:, :, 0])
        self._points = np.where(self._seen[:, :, None], moments.points, 0.0)
        self._design = self._designed(moments.rotation)

    def solve(self, height_m: float, *, symmetric: bool) -> tuple[np.ndarray, np.ndarray]:
        """Lengths (B - 1,) [m] and their covariance."""
        mean, precision = self._prior(height_m, symmetric)
        weight = self._seen.astype(float)
        solution = mean
        sigma_m, lasting = 0.02, 1.0
        covariance = np.linalg.inv(precision)
        for _ in range(6):
            normal, right = self._normal(weight)
            scale = 1.0 / (sigma_m**2 * lasting)
            covariance = np.linalg.inv(scale * normal + precision)
            solution = covariance @ (scale * right + precision @ mean)
            away = self._residual(solution, weight)
            distance = np.linalg.norm(away, axis=2)
            sigma_m = max(float(np.median(distance[self._seen])) / 1.538, 1e-4)
            lasting = _lasting(away, self._seen)
            robust = HUBER * 1.73 * sigma_m / np.maximum(distance, 1e-9)
            weight = np.where(self._seen, np.minimum(1.0, robust), 0.0)
        return solution[: self._count], covariance[: self._count, : self._count]

    def _designed(self, rotation: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per landmark its unknowns and its derivative by them (T, 3, m), without the root."""
        skeleton = self._skeleton
        shape = BodyShape.from_height(skeleton, 1.75)
        direction = shape.offsets_m[1:] / np.linalg.norm(shape.offsets_m[1:], axis=1)[:, None]
        design = []
        for k, bone in enumerate(self._landmarks.bones(skeleton)):
            chain, at = [], int(bone)
            while at > 0:
                chain.append(at)
                at = skeleton.parents[at]
            along = [rotation[:, skeleton.parents[at]] @ direction[at - 1] for at in chain]
            own = self._count + 3 * k
            columns = np.array([*(at - 1 for at in chain), own, own + 1, own + 2])
            parts = [np.stack(along, axis=2)] if along else []
            design.append((columns, np.concatenate([*parts, rotation[:, bone]], axis=2)))
        return design

    def _normal(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of what each landmark is from the weighted mean of its instant: the root drops out."""
        total = np.maximum(weight.sum(axis=1), 1e-12)[:, None, None]
        normal, right = np.zeros((self._size, self._size)), np.zeros(self._size)
        mean = np.zeros((len(weight), 3, self._size))
        for k, (columns, design) in enumerate(self._design):
            weighted = design * weight[:, k, None, None]
            flat = weighted.reshape(-1, len(columns))
            normal[np.ix_(columns, columns)] += flat.T @ design.reshape(-1, len(columns))
            right[columns] += flat.T @ self._points[:, k].reshape(-1)
            mean[:, :, columns] += weighted
        middle = (weight[:, :, None] * self._points).sum(axis=1)
        share = (mean / total).reshape(-1, self._size)
        normal -= share.T @ mean.reshape(-1, self._size)
        return normal, right - share.T @ middle.reshape(-1)

    def _residual(self, solution: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """(T, K, 3), from the weighted mean of the instant; 0 where missing."""
        away = self._points.copy()
        for k, (columns, design) in enumerate(self._design):
            away[:, k] -= design @ solution[columns]
        total = np.maximum(weight.sum(axis=1), 1e-12)[:, None, None]
        away -= (weight[:, :, None] * away).sum(axis=1, keepdims=True) / total
        return away * self._seen[:, :, None]

    def _prior(self, height_m: float, symmetric: bool) -> tuple[np.ndarray, np.ndarray]:
        """Mean and precision of all unknowns."""
        skeleton, landmarks = self._skeleton, self._landmarks
        shape = BodyShape.from_height(skeleton, height_m)
        lengths = _lengths(shape)
        joint = [name.split("_")[-1] in _JOINT_WORDS for name in landmarks.landmark_names]
        sigma = np.where(joint, JOINT_SIGMA, SURFACE_SIGMA) * height_m
        mean = np.concatenate([lengths, landmarks.offsets_m(shape).ravel()])
        deviation = np.concatenate([LENGTH_SIGMA * lengths, np.repeat(sigma, 3)])
        precision = np.diag(deviation**-2.0)
        if symmetric:
            for bone, name in enumerate(skeleton.bone_names[1:]):
                if name.startswith("left_"):
                    other = skeleton.bone(f"right_{name.removeprefix('left_')}") - 1
                    pair = np.ix_([bone, other], [bone, other])
                    precision[pair] += np.array([[1, -1], [-1, 1]]) / SYMMETRY_SIGMA_M**2
        return mean, precision


def subject_keys(body: MeasuredBody) -> dict[str, Any]:
    """What a session's [[subject]] says of this body, rounded to millimetres and tenths of them."""
    keys: dict[str, Any] = {"height_m": round(body.height_m, 3)}
    if body.lengths_m:
        lengths = body.lengths_m.items()
        keys["bone_lengths_m"] = {name: round(float(length), 4) for name, length in lengths}
    return keys


def shape_toml(bodies: Sequence[MeasuredBody], *, origin: str) -> str:
    """[[subject]] tables for a session file; `origin` says where the lengths are from."""
    lines = [f"# Bone lengths [m] with standard deviations; {origin}."]
    for body in bodies:
        lines += ["", "[[subject]]", f"name = {quoted(body.name)}"]
        how = "stated" if body.height_stated else f"+- {body.height_sigma_m:.3f}, from bone lengths"
        lines.append(f"height_m = {body.height_m:.3f}  # {how}")
        if body.lengths_m:
            pairs = [f"{name} = {length:.4f}" for name, length in body.lengths_m.items()]
            lines.append(f"bone_lengths_m = {{ {', '.join(pairs)} }}")
        lines += [
            f"#   {bone.bone:<16} {bone.length_m:.4f} +- {bone.sigma_m:.4f}"
            + ("" if bone.told else ", from the stature")
            for bone in body.bones
        ]
    return "\n".join(lines) + "\n"


def _lasting(away: np.ndarray, seen: np.ndarray) -> float:
    """Samples per independent one, from the correlation of neighbours: (1 + r) / (1 - r)."""
    both = seen[1:] & seen[:-1]
    power = float(np.sum(away[seen] ** 2) / max(seen.sum(), 1))
    product = float(np.sum((away[1:] * away[:-1])[both]) / max(both.sum(), 1))
    r = np.clip(product / max(power, 1e-12), 0.0, 0.98)
    return float((1 + r) / (1 - r))


def _lengths(shape: BodyShape) -> np.ndarray:
    return np.linalg.norm(shape.offsets_m[1:], axis=1)


def _stature(
    skeleton: Skeleton, lengths: np.ndarray, covariance: np.ndarray, height_m: float
) -> tuple[float, float]:
    """The stature whose proportions are nearest to the lengths, and its standard deviation."""
    fractions = _lengths(BodyShape.from_height(skeleton, 1.0))
    spread = covariance + np.diag((LENGTH_SIGMA * fractions * height_m) ** 2)
    weighted = np.linalg.solve(spread, fractions)
    found = float(weighted @ lengths / (weighted @ fractions))
    sigma = float(np.hypot(1.0 / np.sqrt(weighted @ fractions), STATURE_SIGMA * found))
    return float(np.clip(found, MIN_HEIGHT_M, MAX_HEIGHT_M)), sigma
