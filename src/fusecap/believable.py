"""What a measurement can be, checked where measurements enter: sorter, estimator, live run, files.

Bad data is ordinary: what no sensor could have measured counts as missing. Arrays of another
shape, things that are no numbers, crowds and times that do not run forwards are misuse, and raise
`InputError` before anything has changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from fusecap.appearance import APPEARANCE_SIZE
from fusecap.errors import InputError
from fusecap.types import Detections, ImuReading

MAX_PX = 1e5
"""From the corner of a picture."""
MOST_CONFIDENCE = 2.0
"""Peaks of heatmaps go a little over 1, and count as 1."""
MAX_M = 1e4
"""From the world's origin."""
MAX_ACCEL_M_S2 = 1e4
"""A thousand times gravity: beyond any sensor on a body."""
MAX_SHEAR = 0.1
"""Of RᵀR from the unit matrix: rounding and interpolation make less than a tenth of it."""
MOST_PEOPLE = 64
"""In one view: pairs of people in two views grow with its square."""
MOST_DETECTIONS = 1024
"""In all views of an instant."""
_MISSING = np.array([np.nan, np.nan, 0.0])


def shaped_numbers(values: Any, shape: tuple[int, ...], what: str) -> Float[np.ndarray, "..."]:
    """`values` as a float64 array of this shape, -1 where a side is free; raises `InputError`."""
    array = np.asarray(values)
    fits = array.ndim == len(shape) and all(
        wanted in (-1, found) for wanted, found in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "fiu":
        sides = " x ".join("n" if side < 0 else str(side) for side in shape)
        raise InputError(f"{what}: {array.shape} of {array.dtype}, expected {sides} numbers")
    return np.ascontiguousarray(array, dtype=np.float64)


def believable_keypoints(values: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """x, y [px], confidence; NaN, NaN, 0 for what lies nowhere near a picture."""
    confidence = values[..., 2]
    seen = (np.abs(values[..., :2]) <= MAX_PX).all(axis=-1)
    seen &= (confidence > 0.0) & (confidence <= MOST_CONFIDENCE)
    if (seen | (confidence == 0.0)).all() and not (confidence > 1.0).any():
        return values
    kept = np.where(seen[..., None], values, _MISSING)
    kept[..., 2] = np.minimum(kept[..., 2], 1.0)
    return kept


def surest(people: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, "m k 3"]:
    """People with any believable keypoint; of a crowd the 64 with the most confidence."""
    people = believable_keypoints(people)
    return people[surest_rows(people)]


def surest_rows(people: Float[np.ndarray, "n k 3"]) -> Int[np.ndarray, " m"]:
    """Rows of people with any keypoint, all of them believable; of a crowd the 64 surest."""
    confidence = people[:, :, 2].sum(axis=1)
    rows = np.flatnonzero(confidence > 0)
    if len(rows) > MOST_PEOPLE:
        rows = np.sort(rows[np.argsort(-confidence[rows], kind="stable")[:MOST_PEOPLE]])
    return rows


def surest_of_views(
    views: Sequence[Float[np.ndarray, "_ k 3"]],
) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
    """The people of an instant, per camera; of a crowd the 1024 with the most confidence.

    For who cannot choose: readers, live runs. A sorter refuses more.
    """
    people = [surest(some) if len(some) > MOST_PEOPLE else some for some in views]
    if sum(map(len, people)) <= MOST_DETECTIONS:
        return tuple(people)
    confidence = np.concatenate([some[:, :, 2].sum(axis=1) for some in people])
    kept = np.zeros(len(confidence), dtype=bool)
    kept[np.argsort(-confidence, kind="stable")[:MOST_DETECTIONS]] = True
    ends = np.cumsum([len(some) for some in people])[:-1]
    return tuple(some[mine] for some, mine in zip(people, np.split(kept, ends), strict=True))


@dataclass(frozen=True, slots=True, kw_only=True)
class BelievableDetections(Detections):
    """What `believable_detections` returns: checked, so not checked again."""


def believable_detections(given: Detections, cameras: int, landmarks: int) -> BelievableDetections:
    """The same people, row by row; raises `InputError`."""
    if len(given.people) != cameras or (given.looked and len(given.looked) != cameras):
        raise InputError(f"detections of {len(given.people)} cameras, expected {cameras}")
    if isinstance(given, BelievableDetections):
        return given
    people = []
    for camera, some in enumerate(given.people):
        where = f"people of camera {camera}"
        people.append(shaped_numbers(some, (-1, landmarks, 3), where))
        if len(some) > MOST_PEOPLE:
            raise InputError(f"{where}: {len(some)}; keep the {MOST_PEOPLE} surest")
    total = sum(map(len, people))
    if total > MOST_DETECTIONS:
        raise InputError(
            f"{total} people in all views of an instant, expected at most {MOST_DETECTIONS}; keep "
            "the surest of each view"
        )
    return BelievableDetections(
        timestamp_ns=checked_moment(given.timestamp_ns, None),
        people=_believable_views(people),
        looked=given.looked,
        appearance=_checked_appearance(given.appearance, people),
    )


def _checked_appearance(
    given: tuple[np.ndarray, ...] | None, people: list[Float[np.ndarray, "_ k 3"]]
) -> tuple[UInt8[np.ndarray, "_ 40"], ...] | None:
    if given is None:
        return None
    shapes = [(len(some), APPEARANCE_SIZE) for some in people]
    if [np.shape(some) for some in given] != shapes or any(a.dtype != np.uint8 for a in given):
        found = ", ".join(f"{np.shape(some)} of {some.dtype}" for some in given)
        raise InputError(f"appearance: {found}; expected uint8, per view {shapes}")
    return given


def _believable_views(
    people: list[Float[np.ndarray, "_ k 3"]],
) -> tuple[Float[np.ndarray, "_ k 3"], ...]:
    if not people:
        return ()
    together = np.concatenate(people)
    believed = believable_keypoints(together)
    if believed is together:
        return tuple(people)
    return tuple(np.split(believed, np.cumsum([len(some) for some in people])[:-1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class BelievableReading(ImuReading):
    """What `believable_reading` returns: checked, so not checked again."""


def believable_reading(given: ImuReading, sensors: int) -> BelievableReading:
    """What I sensors say; NaN for turns that are none and for impossible accelerations."""
    if isinstance(given, BelievableReading) and len(given.bone_rotation_in_world) == sensors:
        return given
    rotation = shaped_numbers(
        given.bone_rotation_in_world, (sensors, 3, 3), "orientations of sensors"
    )
    accel = shaped_numbers(given.accel_in_world_m_s2, (sensors, 3), "accelerations of sensors")
    sound = np.abs(rotation).max(axis=(1, 2), initial=0.0) < 2.0
    turns = np.where(sound[:, None, None], rotation, 0.0)
    square = np.swapaxes(turns, -1, -2) @ turns
    sound &= np.abs(square - np.eye(3)).max(axis=(1, 2), initial=0.0) < MAX_SHEAR
    sound &= np.linalg.det(turns) > 0.0
    felt = np.abs(accel).max(axis=1, initial=0.0) < MAX_ACCEL_M_S2
    if sound.all() and felt.all():
        return BelievableReading(bone_rotation_in_world=rotation, accel_in_world_m_s2=accel)
    return BelievableReading(
        bone_rotation_in_world=np.where(sound[:, None, None], rotation, np.nan),
        accel_in_world_m_s2=np.where(felt[:, None], accel, np.nan),
    )


def believable_points(values: Any, landmarks: int) -> Float[np.ndarray, "k 3"]:
    """Landmarks in the world [m]; NaN for those that are nowhere near."""
    found = shaped_numbers(values, (landmarks, 3), "landmarks in the world")
    near = np.abs(found).max(axis=1, keepdims=True) <= MAX_M
    return np.where(near, found, np.nan)


def checked_moment(timestamp_ns: Any, last_ns: int | None) -> int:
    """A time that is after the last one; raises `InputError`."""
    if not isinstance(timestamp_ns, int | np.integer) or abs(int(timestamp_ns)) >= 1 << 62:
        raise InputError(f"the time {timestamp_ns!r} is no number of nanoseconds")
    if last_ns is not None and timestamp_ns <= last_ns:
        raise InputError(
            f"the time {timestamp_ns} ns is not after the last one, {last_ns} ns; instants go "
            "forwards, each with a time of its own"
        )
    return int(timestamp_ns)


def tells(reading: ImuReading | None) -> bool:
    """Whether any sensor measured how its bone is turned."""
    return reading is not None and bool(np.isfinite(reading.bone_rotation_in_world[:, 0, 0]).any())
