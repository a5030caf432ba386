"""When each sensor measured, from how fast the bones under it turn in the video.

The people are solved from the cameras alone. A sensor that is fixed to a bone turns as the bone
does, but for one unknown rotation R between their axes:

    w_bone(t) = R w_sensor(t - offset)

For every offset the best R follows from the 3 x 3 covariance C of the two angular velocities
(Kabsch); what they then share, the sum of C's singular values, is a correlation that needs to know
nothing about how the sensor was put on. Sensors on one clock share one offset. Gauss-Newton on
all of them then finds it to a fraction of a sample, with R renewed in every step.

A worked number: a forearm that swings at 3 rad/s and 1 Hz changes its angular velocity by 19 rad/s
per second; solves that err by 0.5 rad/s place one instant to 26 ms, a thousand instants of which a
tenth are independent to 2.6 ms, thirteen sensors to 0.7 ms.

What this cannot see: flesh follows the bone late, in the simulation by some 7 ms, and takes its
sensor along. The offset found is that of the sensors' orientations against the bones in the
video, which is what a solve needs; `LATE_S` is in the standard error for whoever wants
the clock itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.calibrate.sync.curves import (
    Curve,
    Peak,
    blocks_of,
    clustered_covariance,
    peak_of,
)
from fusecap.calibrate.sync.signals import turning_rad_s

SMOOTH_S = 0.05
LATE_S = 0.008
"""Standard deviation of a constant delay between flesh and bone that no motion shows."""
STEP_S = 1 / 60
MIN_DRIFT_S = 60.0
MOVES_RAD_S = 0.3
"""Root mean square of a bone's angular velocity below which its sensor tells nothing."""

_SEPARATION_S = 0.25
_STEPS = 12
_COARSE = 3


@dataclass(frozen=True, kw_only=True)
class Worn:
    """The samples of one sensor on its own clock."""

    bone: str
    times_s: Float[np.ndarray, " n"]
    rotation: Float[np.ndarray, "n 3 3"]
    """imu_world_from_imu."""


@dataclass(frozen=True, kw_only=True)
class Filmed:
    """The bones of one person as solved from the cameras alone."""

    name: str
    times_s: Float[np.ndarray, " t"]
    bone_names: tuple[str, ...]
    rotation: Float[np.ndarray, "t b 3 3"]
    """world_from_bone; NaN where not tracked."""


@dataclass(frozen=True, kw_only=True)
class ImuClock:
    """The clock of sensors that were recorded together."""

    bones: tuple[str, ...]
    person: str
    """Whom of the video they fit."""
    offset_s: float
    """Added to their times at `middle_s`; NaN where the data cannot tell."""
    drift_ppm: float
    error_s: float
    drift_error_ppm: float
    middle_s: float
    peak: Peak | None
    curve: Curve | None
    correlation: float
    """Of all angular velocities at the offset, 0-1."""


@dataclass(frozen=True, kw_only=True)
class _Signals:
    """Angular velocities of S sensors and their bones on one grid each."""

    at_s: Float[np.ndarray, " t"]
    """Session time."""
    bone: Float[np.ndarray, "s t 3"]
    own_s: Float[np.ndarray, " n"]
    """Sensor time."""
    sensor: Float[np.ndarray, "s n 3"]
    rate: Float[np.ndarray, "s n 3"]
    """Derivative of `sensor`."""


def signals_of(sensors: Sequence[Worn], filmed: Filmed) -> _Signals | None:
    """Of the sensors whose bones move; None where none does."""
    at_s = np.arange(filmed.times_s[0], filmed.times_s[-1], STEP_S)
    start_s = min(float(worn.times_s[0]) for worn in sensors)
    end_s = max(float(worn.times_s[-1]) for worn in sensors)
    own_s = np.arange(start_s, end_s, STEP_S / 2)
    if len(at_s) < 20 or len(own_s) < 40:
        return None
    bones, turning = [], []
    for worn in sensors:
        index = filmed.bone_names.index(worn.bone)
        bone = turning_rad_s(filmed.times_s, filmed.rotation[:, index], at_s, SMOOTH_S)
        sensor = turning_rad_s(worn.times_s, worn.rotation, own_s, SMOOTH_S)
        if min(_rms(bone), _rms(sensor)) < MOVES_RAD_S:
            continue
        bones.append(bone)
        turning.append(sensor)
    if not bones:
        return None
    sensor = np.stack(turning)
    return _Signals(
        at_s=at_s,
        bone=np.stack(bones),
        own_s=own_s,
        sensor=sensor,
        rate=np.gradient(sensor, own_s, axis=1),
    )


def _rms(signal: Float[np.ndarray, "t 3"]) -> float:
    squared = np.sum(signal**2, axis=1)
    squared = squared[np.isfinite(squared)]
    return float(np.sqrt(np.mean(squared))) if len(squared) > 20 else 0.0


def _read(signal: np.ndarray, own_s: np.ndarray, times_s: np.ndarray) -> np.ndarray:
    """(S, T, 3) linear between the points of a dense grid; NaN outside."""
    place = (times_s - own_s[0]) / (own_s[1] - own_s[0])
    inside = (place >= 0) & (place <= len(own_s) - 1)
    low = np.clip(np.floor(place).astype(int), 0, len(own_s) - 2)
    share = (place - low)[None, :, None]
    value = (1 - share) * signal[:, low] + share * signal[:, low + 1]
    return np.where(inside[None, :, None], value, np.nan)


def _kabsch(bone: np.ndarray, sensor: np.ndarray) -> Float[np.ndarray, "s 3 3"]:
    """Per sensor the rotation that brings its angular velocity closest to the bone's."""
    both = np.isfinite(bone + sensor)
    covariance = np.einsum("sti,stj->sij", np.where(both, bone, 0.0), np.where(both, sensor, 0.0))
    u, _, vt = np.linalg.svd(covariance)
    sign = np.linalg.det(u @ vt)
    u[:, :, 2] *= sign[:, None]
    return u @ vt


def turning_curve(signals: _Signals, max_offset_s: float) -> Curve:
    """Share of the angular velocities' energy that is not common, by blocks, over the offset."""
    step_s = _COARSE * STEP_S
    count = int(np.ceil(max_offset_s / step_s))
    shifts = np.arange(-count, count + 1) * step_s
    at_s, bones = signals.at_s[::_COARSE], signals.bone[:, ::_COARSE]
    block = blocks_of(at_s)
    total = np.zeros((int(block.max()) + 1, len(shifts)))
    number = np.zeros_like(total)
    both = zip(signals.bone, signals.sensor, strict=True)
    scale = np.array([_rms(bone) * _rms(sensor) for bone, sensor in both])
    for index, shift_s in enumerate(shifts):
        sensor = _read(signals.sensor, signals.own_s, at_s - shift_s)
        turned = np.einsum("sij,stj->sti", _kabsch(bones, sensor), sensor)
        product = np.sum(bones * turned, axis=2) / scale[:, None]
        real = np.isfinite(product)
        cost = 0.5 * (1.0 - np.clip(product, -4.0, 4.0))
        total[:, index] = np.bincount(block, np.where(real, cost, 0.0).sum(0), len(total))
        number[:, index] = np.bincount(block, real.sum(0), len(total))
    return Curve(shifts_s=shifts, total=total, count=number)


def imu_clock(
    sensors: Sequence[Worn],
    filmed: Filmed,
    *,
    max_offset_s: float,
    near_s: float | None = None,
) -> ImuClock:
    """One offset for sensors on one clock against one person; `near_s` picks among rival peaks."""
    bones = tuple(worn.bone for worn in sensors)
    middle_s = float(np.mean([(w.times_s[0] + w.times_s[-1]) / 2 for w in sensors]))
    nothing = ImuClock(
        bones=bones,
        person=filmed.name,
        offset_s=float("nan"),
        drift_ppm=float("nan"),
        error_s=float("nan"),
        drift_error_ppm=float("nan"),
        middle_s=middle_s,
        peak=None,
        curve=None,
        correlation=0.0,
    )
    signals = signals_of(sensors, filmed)
    if signals is None:
        return nothing
    curve = turning_curve(signals, max_offset_s)
    peak = peak_of(curve, _SEPARATION_S)
    if peak is None:
        return nothing
    start_s = peak.shift_s
    if near_s is not None and peak.rivals_s:
        start_s = min((peak.shift_s, *peak.rivals_s), key=lambda shift: abs(shift - near_s))
    return _refined(nothing, signals, curve, peak, start_s)


def _refined(
    clock: ImuClock, signals: _Signals, curve: Curve, peak: Peak, offset_s: float
) -> ImuClock:
    at_s, middle_s = signals.at_s, clock.middle_s
    drift = 0.0
    shared = _overlap_s(signals, offset_s)
    columns = 2 if shared >= MIN_DRIFT_S else 1
    covariance = np.full((columns, columns), np.nan)
    correlation = 0.0
    for _ in range(_STEPS):
        own_s = middle_s + (at_s - offset_s - middle_s) / (1 + drift)
        sensor = _read(signals.sensor, signals.own_s, own_s)
        rotation = _kabsch(signals.bone, sensor)
        turned = np.einsum("sij,stj->sti", rotation, sensor)
        changing = np.einsum("sij,stj->sti", rotation, _read(signals.rate, signals.own_s, own_s))
        r = signals.bone - turned
        known = np.isfinite(r + changing)
        size = np.sqrt(np.sum(np.where(known, r, 0.0) ** 2, axis=2))
        spread = np.array(
            [np.median(s[k.all(1)]) if k.any() else 1.0 for s, k in zip(size, known, strict=True)]
        )
        spread = np.maximum(spread, 0.05)[:, None]
        weight = 1.0 / (spread**2 * (1.0 + (size / (2.5 * spread)) ** 2))
        by = [changing]
        if columns == 2:
            by.append(changing * (own_s - middle_s)[None, :, None])
        j = np.stack([np.where(known, each, 0.0) for each in by], axis=-1)  # s t 3 p
        g = np.einsum("st,sti,stip->stp", weight, np.where(known, r, 0.0), j)
        h = np.einsum("st,stip,stiq->pq", weight, j, j)
        if not np.isfinite(h).all() or h[0, 0] <= 0:
            break
        change = -np.linalg.solve(h, g.sum((0, 1)))
        offset_s += float(np.clip(change[0], -0.05, 0.05))
        drift += float(change[1]) if columns == 2 else 0.0
        block = np.broadcast_to(blocks_of(at_s)[None], g.shape[:2]).ravel()
        which = np.repeat(np.arange(g.shape[0]), g.shape[1])
        ways = (block, which) if g.shape[0] > 2 else (block,)
        covariance = clustered_covariance(g.reshape(-1, columns), h, *ways)
        both = known.all(2)
        product = np.sum(np.where(known, signals.bone * turned, 0.0), axis=(1, 2))
        energy = [
            np.sum(np.where(both[:, :, None], x, 0.0) ** 2, axis=(1, 2))
            for x in (signals.bone, turned)
        ]
        correlation = float(product.sum() / max(np.sqrt(energy[0] * energy[1]).sum(), 1e-9))
        if abs(change[0]) < 1e-5:
            break
    error_s = float(np.sqrt(max(covariance[0, 0], 0.0) + LATE_S**2))
    return ImuClock(
        bones=clock.bones,
        person=clock.person,
        offset_s=offset_s,
        drift_ppm=1e6 * drift if columns == 2 else float("nan"),
        error_s=error_s,
        drift_error_ppm=1e6 * float(np.sqrt(max(covariance[-1, -1], 0.0)))
        if columns == 2
        else float("nan"),
        middle_s=middle_s,
        peak=peak,
        curve=curve,
        correlation=correlation,
    )


def _overlap_s(signals: _Signals, offset_s: float) -> float:
    start = max(signals.at_s[0], signals.own_s[0] + offset_s)
    return float(min(signals.at_s[-1], signals.own_s[-1] + offset_s) - start)
