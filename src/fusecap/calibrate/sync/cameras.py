"""When each camera exposed, from the people that several of them saw.

Two searches, one after the other.

*Where in the range.* With a calibration a keypoint of one view confines the same keypoint of
another to a line; its distance from the line, through a robust loss, is averaged over the
recording for every shift between two cameras. Nobody needs to be identified: each person takes the
other view's person that fits best. Without a calibration how fast people move stands in for where
they are: the speed of arms, legs and trunk in each image, in body extents per second, summed over
the people, correlated between two views. The curves of all pairs are added up over one common set
of offsets.

*To a fraction of a frame* (`camera_refinement`): all offsets together, by distances from the lines.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from fusecap.calibrate.sync.camera_refinement import (
    MIN_SHARED,
    SCALE_PX,
    Pair,
    essential_of,
    homogeneous,
    refine,
)
from fusecap.calibrate.sync.curves import (
    Curve,
    Peak,
    blocks_of,
    peak_of,
)
from fusecap.calibrate.sync.signals import View
from fusecap.geometry.camera import Rig
from fusecap.progress import Progress

_COARSE_INSTANTS = 100
_SEPARATION_S = 0.25
_COARSE_LANDMARKS = ("nose", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")


@dataclass(frozen=True, kw_only=True)
class CameraClocks:
    """Offsets of C cameras against the reference's clock."""

    reference: int
    offset_s: Float[np.ndarray, " c"]
    """Added to the camera's times at `middle_s`; NaN where the data cannot tell."""
    drift_ppm: Float[np.ndarray, " c"]
    """By which the camera's clock is slow; NaN where the recording is too short to tell."""
    error_s: Float[np.ndarray, " c"]
    drift_error_ppm: Float[np.ndarray, " c"]
    middle_s: Float[np.ndarray, " c"]
    """The camera's own time at which `offset_s` holds."""
    peaks: tuple[Peak | None, ...]
    """Of each camera's curve against all others; its shifts are offsets. None: no curve."""
    curves: tuple[Curve | None, ...]
    refined: bool
    """Whether a calibration allowed the second search."""
    residual_px: tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]
    """Median distance from the others' lines on the times as stated and as found, image 1920 wide;
    NaN where not refined."""


def joint_offsets(
    curves: Mapping[Pair, Curve], count: int
) -> tuple[int, Float[np.ndarray, " c"], list[Curve | None]]:
    """Reference, offsets (NaN where not connected) and each camera's curve against the others.

    A pair's curve is over offset of the second less offset of the first.
    """
    both = dict(curves)
    both |= {(j, i): curve.reversed() for (i, j), curve in curves.items()}
    depth = {}
    for pair, curve in both.items():
        peak = peak_of(curve, _SEPARATION_S)
        depth[pair] = peak.depth * min(max(peak.depth_z, 0.0), 10.0) if peak else 0.0
    seeing = [c for c in range(count) if any(depth[p] > 0 for p in both if p[0] == c)]
    reference = seeing[0] if seeing else 0
    offset_s = np.full(count, np.nan)
    offset_s[reference] = 0.0
    while True:
        reach = [
            (depth[i, j], i, j)
            for i, j in both
            if np.isfinite(offset_s[i]) and np.isnan(offset_s[j]) and depth[i, j] > 0
        ]
        if not reach:
            break
        _, i, j = max(reach)
        peak = peak_of(both[i, j], _SEPARATION_S)
        offset_s[j] = offset_s[i] + (peak.shift_s if peak else 0.0)
    own: list[Curve | None] = [None] * count
    for _ in range(6):
        before = offset_s.copy()
        for camera in range(count):
            if np.isnan(offset_s[camera]):
                continue
            own[camera] = _own_curve(both, offset_s, camera)
            if camera != reference and (curve := own[camera]) is not None:
                peak = peak_of(curve, _SEPARATION_S)
                offset_s[camera] = peak.shift_s if peak else offset_s[camera]
        if np.array_equal(before, offset_s, equal_nan=True):
            break
    return reference, offset_s, own


def _own_curve(
    both: Mapping[Pair, Curve], offset_s: Float[np.ndarray, " c"], camera: int
) -> Curve | None:
    """The camera's cost over its own offset, the others where they are."""
    parts = [
        curve.moved(-float(offset_s[other]))
        for (other, c), curve in both.items()
        if c == camera and np.isfinite(offset_s[other])
    ]
    if not parts:
        return None
    return Curve(
        shifts_s=parts[0].shifts_s,
        total=np.concatenate([part.total for part in parts]),
        count=np.concatenate([part.count for part in parts]),
    )


def shifts_s(views: Sequence[View], max_offset_s: float) -> Float[np.ndarray, " s"]:
    """Evenly from -max to +max, half a frame of the slower cameras apart."""
    step_s = float(np.clip(max(view.period_s for view in views), 1 / 60, 1 / 25))
    count = int(np.ceil(max_offset_s / step_s))
    return np.arange(-count, count + 1) * step_s


def epipolar_curve(
    rig: Rig,
    views: Sequence[View],
    pair: Pair,
    shifts_s: Float[np.ndarray, " s"],
    landmarks: Int[np.ndarray, " k"],
) -> Curve | None:
    """Mean robust distance from the lines over the second camera's offset less the first's.

    None where one of them sees nobody.
    """
    first, second = (views[c] for c in pair)
    rows = first.row[(first.row >= 0).any(axis=1)]
    own_s = first.times_s[(first.row >= 0).any(axis=1)]
    if not (len(rows) and second.seen):
        return None
    picked = np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _COARSE_INSTANTS)).astype(int))
    rows, own_s = rows[picked], own_s[picked]
    essential = essential_of(rig, pair)
    x = homogeneous(first.point[:, landmarks])[rows]  # t p k 3
    x = np.where((rows >= 0)[:, :, None, None], x, np.nan)
    line = x @ essential.T
    y_all = homogeneous(second.point[:, landmarks])
    back_size = np.sum((y_all @ essential)[..., :2] ** 2, axis=-1)
    line_size = np.sum(line[..., :2] ** 2, axis=-1)
    block = blocks_of(own_s)
    total = np.zeros((int(block.max()) + 1, len(shifts_s)))
    count = np.zeros_like(total)
    focal_px = (first.focal_px + second.focal_px) / 2
    for index, shift_s in enumerate(shifts_s):
        other = second.people_at(own_s - shift_s)  # t q
        some = (other >= 0).any(axis=1)
        if not some.any():
            continue
        who = other[some]
        y = y_all[who]
        product = sum(line[some][:, :, None, :, i] * y[:, None, :, :, i] for i in range(3))
        size = line_size[some][:, :, None] + back_size[who][:, None]
        squared = focal_px**2 * product**2 / np.maximum(size, 1e-12)
        loss = squared / (squared + SCALE_PX**2)
        shared = np.isfinite(loss)
        number = shared.sum(-1)
        loss = np.where(shared, loss, 0.0).sum(-1) / np.maximum(number, 1)
        absent = (who < 0)[:, None, :] | (number < MIN_SHARED)
        loss = np.where(absent, np.inf, loss).min(axis=2)  # t p
        real = np.isfinite(loss)
        size = len(total)
        sums = np.where(real, loss, 0.0).sum(1)
        total[:, index] = np.bincount(block[some], sums, size)
        count[:, index] = np.bincount(block[some], real.sum(1), size)
    return Curve(shifts_s=shifts_s, total=total, count=count)


def coarse_landmarks(names: Sequence[str]) -> Int[np.ndarray, " k"]:
    """Those of the limbs and the nose."""
    return np.array([i for i, name in enumerate(names) if name.endswith(_COARSE_LANDMARKS)])


def limb_speeds(view: View, names: Sequence[str], at_s: Float[np.ndarray, " t"]) -> np.ndarray:
    """(T, 5) extents per second, summed over people: arms, legs, trunk; NaN where nobody is seen.

    Fast movement counts less than it is fast (square root), so that one jump does not decide.
    """
    groups = []
    for side in ("left_", "right_"):
        for parts in (("elbow", "wrist"), ("knee", "ankle", "heel", "big_toe")):
            groups.append([i for i, n in enumerate(names) if n in [side + part for part in parts]])
    trunk = ("nose", "neck", "upper_neck", "left_shoulder", "right_shoulder", "mid_hip")
    groups.append([i for i, n in enumerate(names) if n in trunk])
    if not view.seen:
        return np.full((len(at_s), len(groups)), np.nan)
    rows = view.people_at(at_s)
    speed = np.linalg.norm(view.velocity, axis=2) / np.maximum(view.extent, 1e-9)[:, None]
    result = np.full((len(at_s), len(groups)), np.nan)
    for column, group in enumerate(groups):
        known = np.isfinite(speed[:, group])
        each = np.where(known, speed[:, group], 0.0).sum(1) / np.maximum(known.sum(1), 1)
        each = np.sqrt(np.where(known.any(1), each, np.nan))[rows]
        each = np.where(rows >= 0, each, np.nan)
        some = np.isfinite(each)
        total = np.where(some, each, 0.0).sum(1)
        result[:, column] = np.where(some.any(1), total, np.nan)
    return result


def speed_curve(
    first: Float[np.ndarray, "t g"],
    second: Float[np.ndarray, "t g"],
    step_s: float,
    shifts_s: Float[np.ndarray, " s"],
) -> Curve | None:
    """(1 - correlation) / 2 of two signals on one grid, by blocks, over the second's offset."""
    a, b = _standardised(first), _standardised(second)
    times_s = np.arange(len(a)) * step_s
    block = blocks_of(times_s)
    total = np.zeros((int(block.max(initial=0)) + 1, len(shifts_s)))
    count = np.zeros_like(total)
    for index, shift_s in enumerate(shifts_s):
        shift = round(shift_s / step_s)
        here = slice(max(0, shift), min(len(a), len(b) + shift))
        if here.stop - here.start < 10:
            continue
        there = slice(here.start - shift, here.stop - shift)
        cost = (a[here] - b[there]) ** 2 / 4
        real = np.isfinite(cost)
        sums = np.minimum(np.where(real, cost, 0.0), 2.0).sum(1)
        total[:, index] = np.bincount(block[here], sums, len(total))
        count[:, index] = np.bincount(block[here], real.sum(1), len(total))
    return Curve(shifts_s=shifts_s, total=total, count=count) if count.any() else None


def _standardised(signal: Float[np.ndarray, "t g"]) -> Float[np.ndarray, "t g"]:
    known = np.isfinite(signal).sum(0) > 10
    result = np.full_like(signal, np.nan)
    if known.any():
        middle = np.nanmedian(signal[:, known], axis=0)
        spread = np.nanstd(signal[:, known], axis=0)
        result[:, known] = (signal[:, known] - middle) / np.maximum(spread, 1e-6)
    return np.clip(result, -3, 3)


def _by_speed(
    views: Sequence[View], names: Sequence[str], shifts: Float[np.ndarray, " s"]
) -> Callable[[Pair], Curve | None]:
    step_s = float(shifts[1] - shifts[0])
    start_s = min(float(view.times_s[0]) for view in views)
    at_s = np.arange(start_s, max(float(view.times_s[-1]) for view in views), step_s)
    speeds = [limb_speeds(view, names, at_s) for view in views]
    return lambda pair: speed_curve(speeds[pair[0]], speeds[pair[1]], step_s, shifts)


def _by_lines(
    rig: Rig,
    views: Sequence[View],
    picked: Int[np.ndarray, " k"],
    shifts: Float[np.ndarray, " s"],
    pair: Pair,
) -> Curve | None:
    return epipolar_curve(rig, views, pair, shifts, picked)


def synchronise_cameras(
    rig: Rig | None,
    views: Sequence[View],
    landmark_names: Sequence[str],
    *,
    max_offset_s: float,
    progress: Progress | None = None,
) -> CameraClocks:
    """Offsets of all cameras; without a rig from how fast people move alone."""
    shifts = shifts_s(views, max_offset_s)
    count = len(views)
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    curves: dict[Pair, Curve] = {}
    if rig is None:
        compare = _by_speed(views, landmark_names, shifts)
    else:
        compare = partial(_by_lines, rig, views, coarse_landmarks(landmark_names), shifts)
    for done, pair in enumerate(pairs):
        if progress:
            progress("comparing cameras", done, len(pairs))
        curve = compare(pair)
        if curve is not None:
            curves[pair] = curve
    if progress:
        progress("comparing cameras", len(pairs), len(pairs))
    reference, offset_s, own = joint_offsets(curves, count)
    peaks = tuple(peak_of(curve, _SEPARATION_S) if curve else None for curve in own)
    middle_s = np.array([(v.times_s[0] + v.times_s[-1]) / 2 for v in views])
    nothing = np.full(count, np.nan)
    if rig is None:
        error_s = nothing.copy()
        error_s[reference] = 0.0
        return CameraClocks(
            reference=reference,
            offset_s=offset_s,
            drift_ppm=nothing,
            error_s=error_s,
            drift_error_ppm=nothing,
            middle_s=middle_s,
            peaks=peaks,
            curves=tuple(own),
            refined=False,
            residual_px=(nothing, nothing),
        )
    fine = refine(rig, views, offset_s, reference, progress=progress)
    return CameraClocks(
        reference=reference,
        offset_s=fine.offset_s,
        drift_ppm=fine.drift * 1e6,
        error_s=fine.error_s,
        drift_error_ppm=fine.drift_error * 1e6,
        middle_s=fine.middle_s,
        peaks=peaks,
        curves=tuple(own),
        refined=True,
        residual_px=fine.residual_px,
    )
