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
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.appearance import unknown
from fusecap.believable import surest_of_views
from fusecap.geometry.camera import Y_UP_FROM_Z_UP
from fusecap.geometry.quaternions import from_wxyz
from fusecap.geometry.same_people import same_people
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.types import GRAVITY_M_S2, Detections, ImuReading

EXACT_S = 1e-6
"""A frame this close to an instant is taken as it is."""
MAX_GAP_S = 0.1
"""IMU samples further apart are not interpolated between; frames, where `MAX_GAP_PERIODS` of the
camera's own are no longer."""
MAX_GAP_PERIODS = 2.5
GATE_EXTENTS = 0.25
"""Detections of two frames further apart than this share of a person's extent are two people."""


class ViewOfPeople(NamedTuple):
    """Whom one camera sees."""

    people: np.ndarray
    """(n, K, 3)."""
    appearance: np.ndarray | None = None
    """(n, 40) how their clothes look; None without pictures."""


Frame = tuple[float, ViewOfPeople]
"""When one camera looked [s], and whom it saw."""


def people_at(track: KeypointTrack, t_s: float) -> np.ndarray:
    """(n, K, 3): the people of `seen_at`."""
    return seen_at(track, t_s).people


def seen_at(track: KeypointTrack, t_s: float) -> ViewOfPeople:
    """Whom the camera sees at `t_s`; nobody where there is no frame near.

    `seen_amid` the frames around the instant; between frames that do not follow each other
    nothing is interpolated.
    """
    after = int(np.searchsorted(track.times_s, t_s - EXACT_S))
    before, last = after - 1, len(track.frames) - 1
    in_a_row = 0 <= before < last and track.frames[after] == track.frames[before] + 1
    found = seen_amid(
        (float(track.times_s[before]), _seen_in(track, before)) if before >= 0 else None,
        (float(track.times_s[after]), _seen_in(track, after)) if after <= last else None,
        t_s,
        period_s=1.0 / track.rate_hz,
        in_a_row=in_a_row,
    )
    return (
        ViewOfPeople(np.empty((0, len(track.landmarks.landmark_names), 3)))
        if found is None
        else found
    )


def _seen_in(track: KeypointTrack, frame: int) -> ViewOfPeople:
    looks = track.appearance
    return ViewOfPeople(track.people[frame], None if looks is None else looks[frame])


def detections_of(
    timestamp_ns: int, views: Sequence[ViewOfPeople], looked: tuple[bool, ...] | None = None
) -> Detections:
    """Everyone at one instant; of a view that is too full for all nobody's clothes are kept."""
    people = surest_of_views([seen.people for seen in views])
    appearance = None
    if any(seen.appearance is not None for seen in views):
        appearance = tuple(
            seen.appearance
            if seen.appearance is not None and len(seen.appearance) == len(some)
            else unknown(len(some))
            for some, seen in zip(people, views, strict=True)
        )
    return Detections(
        timestamp_ns=timestamp_ns, people=people, looked=looked, appearance=appearance
    )


def seen_amid(
    before: Frame | None,
    after: Frame | None,
    t_s: float,
    *,
    period_s: float,
    in_a_row: bool = True,
) -> ViewOfPeople | None:
    """People at `t_s` from a camera's last frame before it and the first not before it.

    A frame within 1 us is taken as it is. Between two frames keypoints that both have are
    interpolated; a keypoint or a person that only one of them has is missing, and clothes look as
    in the nearer one. Where one of the
    neighbours does not exist, or the camera froze between them (more than 0.1 s and 2.5 of its
    frame periods), the nearer holds for half a period; None where neither is so near.
    """
    if after is not None and abs(after[0] - t_s) <= EXACT_S:
        return after[1]
    if before is not None and after is not None and in_a_row:
        gap_s = after[0] - before[0]
        if gap_s <= max(MAX_GAP_S, MAX_GAP_PERIODS * period_s):
            return _between(before[1], after[1], (t_s - before[0]) / gap_s)
    neighbours = [frame for frame in (before, after) if frame is not None]
    nearest = min(neighbours, key=lambda frame: abs(frame[0] - t_s), default=None)
    if nearest is None or abs(nearest[0] - t_s) > period_s / 2:
        return None
    return nearest[1]


def _between(first: ViewOfPeople, second: ViewOfPeople, share: float) -> ViewOfPeople:
    """People in both frames, `share` (0-1) of the way from the first to the second."""
    rows, columns = same_people(first.people, second.people, gate_extents=GATE_EXTENTS)
    a, b = first.people[rows], second.people[columns]
    mixed = a + share * (b - a)
    mixed[np.isnan(mixed[:, :, 0]), 2] = 0.0
    kept = (mixed[:, :, 2] > 0).any(axis=1)
    nearer, same = (first, rows) if share < 0.5 else (second, columns)
    looks = nearer.appearance
    return ViewOfPeople(mixed[kept], None if looks is None else looks[same][kept])


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


UPRIGHT = {"y": np.eye(3), "z": Y_UP_FROM_Z_UP, "-z": Y_UP_FROM_Z_UP.T}
"""Rotates a sensor's reference world into one that is y up, by its up axis; x stays."""


def world_from_imu_world(imu_up: str, heading_deg: float) -> np.ndarray:
    """R_ig: the reference world's up axis, of `UPRIGHT`, onto ours, then turned about it."""
    return Rotation.from_euler("y", heading_deg, degrees=True).as_matrix() @ UPRIGHT[imu_up]


def resample_imus(imus: Sequence[MountedImu], times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bone rotations (T, I, 3, 3) and accelerations without gravity (T, I, 3), in the world.

    NaN outside a track and between samples more than `MAX_GAP_S` apart.
    """
    rotations = np.full((len(times_s), len(imus), 3, 3), np.nan)
    accelerations = np.full((len(times_s), len(imus), 3), np.nan)
    for i, imu in enumerate(imus):
        orientation, accel, valid = _resample(imu.track, times_s)
        rotations[valid, i], accelerations[valid, i] = in_world(
            orientation, accel, imu.world_from_imu_world, imu.bone_from_imu
        )
    return rotations, accelerations


def readings_at(imus: Sequence[MountedImu], t_s: float) -> ImuReading:
    """`resample_imus` at one instant."""
    rotations, accelerations = resample_imus(imus, np.array([t_s]))
    return ImuReading(bone_rotation_in_world=rotations[0], accel_in_world_m_s2=accelerations[0])


def in_world(
    orientation: np.ndarray,
    accel_m_s2: np.ndarray,
    world_from_imu_world: np.ndarray,
    bone_from_imu: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Bone rotations (N, 3, 3) and accelerations without gravity (N, 3) from N measurements.

        R_bone = R_ig R_i R_ib^-1           [1, eq. 8]
        a = R_ig R_i a_i - g                [1, eq. 12]

    `orientation` (N, 3, 3) is imu_world_from_imu, `accel_m_s2` (N, 3) the specific force; the
    mounting is one for all (3, 3) or one each (N, 3, 3).
    """
    world_from_imu = world_from_imu_world @ orientation
    accel = np.einsum("nij,nj->ni", world_from_imu, accel_m_s2)
    accel[:, 1] -= GRAVITY_M_S2
    return world_from_imu @ np.swapaxes(bone_from_imu, -1, -2), accel


def orientations_between(
    first_wxyz: np.ndarray, second_wxyz: np.ndarray, share: np.ndarray
) -> np.ndarray:
    """(N, 3, 3): `share` (N,) of the way from the first to the second orientation, by slerp."""
    first = from_wxyz(first_wxyz)
    second = from_wxyz(second_wxyz)
    turn = (first.inv() * second).as_rotvec()
    return (first * Rotation.from_rotvec(share[:, None] * turn)).as_matrix()


def accels_between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(N, 3): linearly; on a sample that sample alone, even where the other is NaN."""
    accel = first + share[:, None] * (second - first)
    return np.where(share[:, None] == 0, first, np.where(share[:, None] == 1, second, accel))


def _resample(track: ImuTrack, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Orientations (V, 3, 3) and specific force (V, 3) at the V valid instants; their mask (T,)."""
    own = track.times_s
    if len(own) == 1:
        valid = np.abs(times_s - own[0]) <= EXACT_S
        count = int(valid.sum())
        once = from_wxyz(track.orientation_wxyz).as_matrix()
        return np.repeat(once, count, 0), np.repeat(track.accel_m_s2, count, 0), valid
    inside = (times_s >= own[0] - EXACT_S) & (times_s <= own[-1] + EXACT_S)
    clamped = np.clip(times_s, own[0], own[-1])
    after = np.clip(np.searchsorted(own, clamped), 1, len(own) - 1)
    gap = own[after] - own[after - 1]
    on_a_sample = np.minimum(clamped - own[after - 1], own[after] - clamped) <= EXACT_S
    valid = inside & ((gap <= MAX_GAP_S) | on_a_sample)
    after, clamped = after[valid], clamped[valid]
    share = (clamped - own[after - 1]) / (own[after] - own[after - 1])
    quaternion, accel = track.orientation_wxyz, track.accel_m_s2
    orientation = orientations_between(quaternion[after - 1], quaternion[after], share)
    return orientation, accels_between(accel[after - 1], accel[after], share), valid
