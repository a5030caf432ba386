"""Motions and takes for tests that need no recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from fusecap.batch.solve import Solved, SolveReport
from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import PAPER21, Skeleton
from fusecap.take import Take, take_from_theta
from fusecap.take_builder import TakeBuilder
from fusecap.types import Estimate, Status


def walk(
    shape: BodyShape, frames: int, *, rate_hz: float = 60.0, phase_rad: float = 0.0
) -> np.ndarray:
    """A walk to and fro along z, arms down, theta (T, P)."""
    skeleton = shape.skeleton
    time_s = np.arange(frames) / rate_hz
    stride_rad = 2 * np.pi * 0.9 * time_s + phase_rad
    theta = np.zeros((frames, skeleton.pose_size))
    theta[:, 1] = shape.standing_root_height_m
    theta[:, 2] = 1.2 * np.sin(0.5 * time_s)

    def column(bone: str, axis: int) -> int:
        return 3 + 3 * skeleton.bone(bone) + axis

    for side, sign in (("left", 1), ("right", -1)):
        theta[:, column(f"{side}_upper_arm", 2)] = -sign * 1.2
        theta[:, column(f"{side}_thigh", 0)] = -sign * 0.5 * np.sin(stride_rad)
        theta[:, column(f"{side}_shank", 0)] = 0.4 * (1 + np.sin(sign * stride_rad))
    return theta


def any_poses(rng: np.random.Generator, skeleton: Skeleton, frames: int) -> np.ndarray:
    """Every joint anywhere, up to half a turn; theta (T, P)."""
    vector = rng.standard_normal((frames, skeleton.bone_count, 3))
    angle = rng.uniform(0, np.pi, (frames, skeleton.bone_count, 1))
    vector *= angle / np.linalg.norm(vector, axis=-1, keepdims=True)
    root_m = rng.uniform(-3, 3, (frames, 3))
    return np.concatenate([root_m, vector.reshape(frames, -1)], axis=1)


def take_of(
    theta: np.ndarray, shapes: list[BodyShape], *, names: tuple[str, ...], rate_hz: float = 60.0
) -> Take:
    """A take of motions (S, T, P), tracked throughout."""
    frames = theta.shape[1]
    return take_from_theta(
        theta,
        shapes,
        timestamps_ns=np.round(np.arange(frames) * (1e9 / rate_hz)).astype(np.int64),
        rate_hz=rate_hz,
        subject_names=names,
        skeleton=shapes[0].skeleton,
    )


def person(height_m: float = 1.75, skeleton: Skeleton = PAPER21) -> BodyShape:
    return BodyShape.from_height(skeleton, height_m)


def solved(take: Take, **told: Any) -> Solved:
    """A take as a solve would hand it over, with what its report tells."""
    report: dict[str, Any] = {
        "instants": len(take.timestamps_ns),
        "duration_s": len(take.timestamps_ns) / take.rate_hz,
        "cameras": 0,
        "subjects": {},
        "reprojection_px": {},
        "solve_ms_median": 1.25,
        "solve_ms_p99": 2.5,
        "solves": 120,
        "statuses": {"converged": 120},
        "elapsed_s": 3.0,
        "interrupted": False,
    }
    builder = TakeBuilder(
        skeleton=take.skeleton,
        rate_hz=take.rate_hz,
        subject_names=take.subject_names,
        provenance=take.provenance,
    )
    for frame, timestamp_ns in enumerate(take.timestamps_ns.tolist()):
        builder.add(timestamp_ns, [_estimate(take, row, frame) for row in _tracked(take, frame)])
    return Solved(builder=builder, report=SolveReport(**(report | told)))


def _tracked(take: Take, frame: int) -> list[int]:
    return np.flatnonzero(take.tracked[:, frame]).tolist()


def _estimate(take: Take, row: int, frame: int) -> Estimate:
    bones = len(take.bone_names)
    return Estimate(
        track_id=row,
        name=take.subject_names[row],
        timestamp_ns=int(take.timestamps_ns[frame]),
        theta=take.theta[row, frame],
        bone_position_in_world_m=take.bone_position_in_world_m[row, frame],
        bone_rotation_in_world=np.zeros((bones, 3, 3)),
        bone_sigma_deg=take.bone_sigma_deg[row, frame],
        position_sigma_m=take.position_sigma_m[row, frame],
        shape=take.shape(row),
        status=Status.CONVERGED,
        iterations=1,
        cost=0.0,
        solve_s=0.0,
        views=np.zeros(0, dtype=bool),
        measured=True,
    )
