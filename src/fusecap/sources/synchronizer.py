"""Brings cameras and IMUs with clocks and rates of their own to the instants of the solve.

Keypoints are interpolated linearly between the two frames around an instant, once the people of
both frames are matched by their distance in the image; orientations by slerp along the shorter arc.
At 60 Hz a person who walks 1.5 m/s moves 25 mm between two frames: interpolation keeps an
instant that falls between them within a fraction of a millimetre, taking the nearer frame would be
12 mm off.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation, Slerp

from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.sources.imu_files.track import GRAVITY_M_S2, ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.types import ImuReading

EXACT_S = 1e-6
"""A frame this close to an instant is taken as it is."""
MAX_GAP_S = 0.1
"""IMU samples further apart are not interpolated between; frames, where `MAX_GAP_PERIODS` of the
camera's own are no longer."""
MAX_GAP_PERIODS = 2.5
GATE_HEIGHTS = 0.25
"""Two detections further apart than this share of a person's height are two people."""


def people_at(track: KeypointTrack, t_s: float) -> np.ndarray:
    """(n, K, 3): the camera's people at `t_s`; empty where there is no frame near.

    A frame within 1 us is taken as it is. Between two frames keypoints that both have are
    interpolated; a keypoint or a person that only one of them has is missing. Where one of the
    neighbours does not exist, or the camera froze between them (more than 0.1 s and 2.5 of its
    frame periods), the nearer holds for half a period.
    """
    period_s = 1.0 / track.rate_hz
    max_gap_s = max(MAX_GAP_S, MAX_GAP_PERIODS * period_s)
    after = int(np.searchsorted(track.times_s, t_s - EXACT_S))
    nobody = np.empty((0, len(track.landmarks.landmark_names), 3))
    if after < len(track.frames) and abs(track.times_s[after] - t_s) <= EXACT_S:
        return track.people[after]
    before = after - 1
    neighbours = [i for i in (before, after) if 0 <= i < len(track.frames)]
    if len(neighbours) == 2 and track.frames[after] == track.frames[before] + 1:
        gap_s = float(track.times_s[after] - track.times_s[before])
        if gap_s <= max_gap_s:
            share = float(t_s - track.times_s[before]) / gap_s
            return _between(track.people[before], track.people[after], share)
    neighbours.sort(key=lambda i: abs(track.times_s[i] - t_s))
    near = [i for i in neighbours if abs(track.times_s[i] - t_s) <= period_s / 2]
    return track.people[near[0]] if near else nobody


def _between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """People in both frames, `share` (0-1) of the way from the first to the second."""
    if len(first) == 0 or len(second) == 0:
        return first[:0]
    cost = _distance_in_heights(first, second)
    rows, columns = linear_sum_assignment(np.minimum(cost, 10 * GATE_HEIGHTS))
    same = cost[rows, columns] <= GATE_HEIGHTS
    a, b = first[rows[same]], second[columns[same]]
    mixed = a + share * (b - a)
    mixed[np.isnan(mixed[:, :, 0]), 2] = 0.0
    return mixed[(mixed[:, :, 2] > 0).any(axis=1)]


def _distance_in_heights(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(n, m): mean distance of the shared keypoints over the larger extent of the two people."""
    offset = np.linalg.norm(first[:, None, :, :2] - second[None, :, :, :2], axis=3)
    shared = np.isfinite(offset)
    distance = np.where(shared, offset, 0.0).sum(2) / np.maximum(shared.sum(2), 1)
    extent = np.maximum(_extent(first)[:, None], _extent(second)[None, :])
    return np.where(shared.any(axis=2), distance / np.maximum(extent, 1.0), np.inf)


def _extent(people: np.ndarray) -> np.ndarray:
    xy = people[:, :, :2]
    span = np.fmax.reduce(xy, axis=1) - np.fmin.reduce(xy, axis=1)
    return span.max(axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class MountedImu:
    """A sensor's samples, and how it sits on its bone."""

    bone: str
    track: ImuTrack
    """Its times on the session's clock."""
    world_from_imu_world: np.ndarray
    """(3, 3) R_ig [1, eq. 8]: from the sensor's reference world to ours."""
    bone_from_imu: np.ndarray
    """(3, 3) R_ib."""
    position_in_bone_m: np.ndarray
    """(3,) t_ib."""


def world_from_imu_world(imu_up: str, heading_deg: float) -> np.ndarray:
    """R_ig: the reference world's up axis ("y" or "z") onto ours, then turned about it."""
    upright = Y_UP_FROM_Z_UP if imu_up == "z" else np.eye(3)
    return Rotation.from_euler("y", heading_deg, degrees=True).as_matrix() @ upright


def resample_imus(imus: Sequence[MountedImu], times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bone rotations (T, I, 3, 3) and accelerations without gravity (T, I, 3), in the world.

        R_bone = R_ig R_i R_ib^-1           [1, eq. 8]
        a = R_ig R_i a_i - g                [1, eq. 12]

    NaN outside a track and between samples more than `MAX_GAP_S` apart.
    """
    rotations = np.full((len(times_s), len(imus), 3, 3), np.nan)
    accelerations = np.full((len(times_s), len(imus), 3), np.nan)
    for i, imu in enumerate(imus):
        orientation, accel, valid = _resample(imu.track, times_s)
        world_from_imu = imu.world_from_imu_world @ orientation
        rotations[valid, i] = world_from_imu @ imu.bone_from_imu.T
        accelerations[valid, i] = np.einsum("tij,tj->ti", world_from_imu, accel)
        accelerations[:, i, 1] -= GRAVITY_M_S2
    return rotations, accelerations


def readings_at(imus: Sequence[MountedImu], t_s: float) -> ImuReading:
    """`resample_imus` at one instant."""
    rotations, accelerations = resample_imus(imus, np.array([t_s]))
    return ImuReading(bone_rotation_in_world=rotations[0], accel_in_world_m_s2=accelerations[0])


def _resample(track: ImuTrack, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orientations (V, 3, 3) and specific force (V, 3) at the V valid instants; their mask (T,)."""
    own = track.times_s
    rotation = Rotation.from_quat(track.orientation_wxyz[:, [1, 2, 3, 0]])
    if len(own) == 1:
        valid = np.abs(times_s - own[0]) <= EXACT_S
        count = int(valid.sum())
        once = rotation.as_matrix()
        return np.repeat(once, count, 0), np.repeat(track.accel_m_s2, count, 0), valid
    inside = (times_s >= own[0] - EXACT_S) & (times_s <= own[-1] + EXACT_S)
    clamped = np.clip(times_s, own[0], own[-1])
    after = np.clip(np.searchsorted(own, clamped), 1, len(own) - 1)
    gap = own[after] - own[after - 1]
    on_a_sample = np.minimum(clamped - own[after - 1], own[after] - clamped) <= EXACT_S
    valid = inside & ((gap <= MAX_GAP_S) | on_a_sample)
    after, clamped = after[valid], clamped[valid]
    share = (clamped - own[after - 1]) / (own[after] - own[after - 1])
    first, second = track.accel_m_s2[after - 1], track.accel_m_s2[after]
    accel = first + share[:, None] * (second - first)
    accel = np.where(share[:, None] == 0, first, np.where(share[:, None] == 1, second, accel))
    return Slerp(own, rotation)(clamped).as_matrix(), accel, valid
