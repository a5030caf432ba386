"""When each sensor measured, from how fast the bones under it turn in the video.

The people are solved from the cameras alone. A sensor that is fixed to a bone turns as the bone
does, but for one unknown rotation R between their axes:

    w_bone(t) = R w_sensor(t - offset)

For every offset the best R follows from the 3 x 3 covariance C of the two angular velocities
(Kabsch); what they then share, the sum of C's singular values, is a correlation that needs to know
nothing about how the sensor was put on. Sensors on one clock share one offset. Gauss-Newton on
all of them then finds it to a fraction of a sample, with R renewed in every step.

Two points show where a limb points but not how it is turned about itself: that part of a solve is
its prior's guess, and is left out. Of what remains each sensor is weighted by the inverse of its
own 3 x 3 residual covariance.

A worked number: a forearm that swings at 3 rad/s and 1 Hz changes its angular velocity by 19 rad/s
per second; solves that err by 0.5 rad/s place one instant to 26 ms, a thousand instants of which a
tenth are independent to 2.6 ms, thirteen sensors to 0.7 ms.

The offset is that of orientations against the bones in the video, which is what a solve needs. It
is not that of the recorder's clock: flesh follows the bone late, in the simulation by 6 to 8 ms,
and takes its sensor along.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from fusecap.calibrate.sync.curves import (
    Curve,
    Peak,
    blocks_of,
    clustered_covariance,
    peak_of,
)
from fusecap.calibrate.sync.signals import turning_rad_s

SMOOTH_S = 0.05
SOLVE_S = 0.0025
"""Standard deviation of what solves' errors that go with the pose shift an offset by: the root mean
square over the twin's training sequences (`benchmarks/sync.py imus --training`)."""
STEP_S = 1 / 60
MIN_DRIFT_S = 60.0
MOVES_RAD_S = 0.3
"""Root mean square of a bone's angular velocity below which its sensor tells nothing."""

_SEPARATION_S = 0.25
_STEPS = 15
_COARSE = 3
_TURNS_ABOUT = {
    "upper_arm": 0,
    "forearm": 0,
    "hand": 0,
    "thigh": 1,
    "shank": 1,
    "foot": 2,
    "toes": 2,
}
"""Axis along a limb, in its bone's frame."""
_TRIMMED = 0.8
"""Share of the smaller residuals that weights are taken from."""
_LEAST_RAD_S = 0.05


@dataclass(frozen=True, kw_only=True)
class TimedSensor:
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
    aligned: Float[np.ndarray, "3 t"] | None = None
    """For pictures: session times [s], angular speed of bones and of sensors [rad/s], each the mean
    over the sensors."""


@dataclass(frozen=True, kw_only=True)
class _Signals:
    """Angular velocities of S sensors and their bones on one grid each."""

    names: tuple[str, ...]
    """Of the bones."""
    at_s: Float[np.ndarray, " t"]
    """Session time."""
    bone: Float[np.ndarray, "s t 3"]
    own_s: Float[np.ndarray, " n"]
    """Sensor time."""
    sensor: Float[np.ndarray, "s n 3"]
    rate: Float[np.ndarray, "s n 3"]
    """Derivative of `sensor`."""

    def only(self, kept: Sequence[int]) -> _Signals:
        """Of some of the sensors."""
        some = list(kept)
        return replace(
            self,
            names=tuple(self.names[index] for index in some),
            bone=self.bone[some],
            sensor=self.sensor[some],
            rate=self.rate[some],
        )


def signals_of(sensors: Sequence[TimedSensor], filmed: Filmed) -> _Signals | None:
    """Of the sensors whose bones move; None where none does."""
    at_s = np.arange(filmed.times_s[0], filmed.times_s[-1], STEP_S)
    start_s = min(float(worn.times_s[0]) for worn in sensors)
    end_s = max(float(worn.times_s[-1]) for worn in sensors)
    own_s = np.arange(start_s, end_s, STEP_S / 2)
    if len(at_s) < 20 or len(own_s) < 40:
        return None
    names, bones, turning = [], [], []
    for worn in sensors:
        index = filmed.bone_names.index(worn.bone)
        bone = turning_rad_s(filmed.times_s, filmed.rotation[:, index], at_s, SMOOTH_S)
        sensor = turning_rad_s(worn.times_s, worn.rotation, own_s, SMOOTH_S)
        if min(_rms(bone), _rms(sensor)) < MOVES_RAD_S:
            continue
        names.append(worn.bone)
        bones.append(bone)
        turning.append(sensor)
    if not bones:
        return None
    sensor = np.stack(turning)
    return _Signals(
        names=tuple(names),
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


def turning_curves(signals: _Signals, max_offset_s: float) -> list[Curve]:
    """Share of a sensor's and its bone's turning that is not common, by blocks, over the offset."""
    step_s = _COARSE * STEP_S
    count = int(np.ceil(max_offset_s / step_s))
    shifts = np.arange(-count, count + 1) * step_s
    at_s, bones = signals.at_s[::_COARSE], signals.bone[:, ::_COARSE]
    block = blocks_of(at_s)
    sensors, blocks = len(signals.names), int(block.max()) + 1
    cell = (np.arange(sensors)[:, None] * blocks + block[None]).ravel()
    total = np.zeros((sensors * blocks, len(shifts)))
    number = np.zeros_like(total)
    both = zip(signals.bone, signals.sensor, strict=True)
    scale = np.array([_rms(bone) * _rms(sensor) for bone, sensor in both])
    for index, shift_s in enumerate(shifts):
        sensor = _read(signals.sensor, signals.own_s, at_s - shift_s)
        turned = np.einsum("sij,stj->sti", _kabsch(bones, sensor), sensor)
        product = np.sum(bones * turned, axis=2) / scale[:, None]
        real = np.isfinite(product)
        cost = 0.5 * (1.0 - np.clip(product, -4.0, 4.0))
        total[:, index] = np.bincount(cell, np.where(real, cost, 0.0).ravel(), len(total))
        number[:, index] = np.bincount(cell, real.ravel(), len(total))
    shape = (sensors, blocks, len(shifts))
    return [
        Curve(shifts_s=shifts, total=t, count=n)
        for t, n in zip(total.reshape(shape), number.reshape(shape), strict=True)
    ]


def unknown_clock(sensors: Sequence[TimedSensor], person: str) -> ImuClock:
    """Of sensors whose offset nothing tells."""
    return ImuClock(
        bones=tuple(worn.bone for worn in sensors),
        person=person,
        offset_s=float("nan"),
        drift_ppm=float("nan"),
        error_s=float("nan"),
        drift_error_ppm=float("nan"),
        middle_s=float(np.mean([(w.times_s[0] + w.times_s[-1]) / 2 for w in sensors])),
        peak=None,
        curve=None,
        correlation=0.0,
    )


class Comparison:
    """Sensors against one person, for all offsets up to `max_offset_s`."""

    def __init__(
        self, sensors: Sequence[TimedSensor], filmed: Filmed, *, max_offset_s: float
    ) -> None:
        self.sensors, self.filmed = sensors, filmed
        self._signals = signals_of(sensors, filmed)
        self._curves: list[Curve] = []
        if self._signals is not None:
            self._curves = turning_curves(self._signals, max_offset_s)

    def clock(self, some: Sequence[int], *, near_s: float | None = None) -> ImuClock:
        """One offset for some of the sensors; `near_s` picks among rival peaks."""
        sensors = [self.sensors[index] for index in some]
        nothing = unknown_clock(sensors, self.filmed.name)
        if self._signals is None:
            return nothing
        bones = [worn.bone for worn in sensors]
        kept = [n for n, name in enumerate(self._signals.names) if name in bones]
        if not kept:
            return nothing
        curve = Curve(
            shifts_s=self._curves[0].shifts_s,
            total=sum((self._curves[n].total for n in kept), np.zeros(1)),
            count=sum((self._curves[n].count for n in kept), np.zeros(1)),
        )
        peak = peak_of(curve, _SEPARATION_S)
        if peak is None:
            return nothing
        start_s = peak.shift_s
        if near_s is not None and peak.rivals_s:
            start_s = min((peak.shift_s, *peak.rivals_s), key=lambda shift: abs(shift - near_s))
        return _refined(nothing, self._signals.only(kept), curve, peak, start_s)


def imu_clock(
    sensors: Sequence[TimedSensor],
    filmed: Filmed,
    *,
    max_offset_s: float,
    near_s: float | None = None,
) -> ImuClock:
    """One offset for sensors on one clock against one person; one sensor per bone."""
    compared = Comparison(sensors, filmed, max_offset_s=max_offset_s)
    return compared.clock(range(len(sensors)), near_s=near_s)


def _refined(
    clock: ImuClock, signals: _Signals, curve: Curve, peak: Peak, offset_s: float
) -> ImuClock:
    at_s, middle_s = signals.at_s, clock.middle_s
    drift = 0.0
    columns = 2 if _overlap_s(signals, offset_s) >= MIN_DRIFT_S else 1
    covariance = np.full((columns, columns), np.nan)
    correlation = 0.0
    rotation = weight = None
    for _ in range(_STEPS):
        own_s = middle_s + (at_s - offset_s - middle_s) / (1 + drift)
        sensor = _read(signals.sensor, signals.own_s, own_s)
        changing = _read(signals.rate, signals.own_s, own_s)
        known = np.all(np.isfinite(signals.bone + sensor + changing), axis=2)
        bone, sensor, changing = (
            np.where(known[:, :, None], x, 0.0) for x in (signals.bone, sensor, changing)
        )
        if rotation is None or weight is None:
            rotation = _kabsch(bone, sensor)
        else:
            rotation = _turned(rotation, bone, sensor, *weight)
        turned = np.einsum("sij,stj->sti", rotation, sensor)
        changing = np.einsum("sij,stj->sti", rotation, changing)
        r = bone - turned
        weight = _weights(signals.names, r, known)
        precision, share = weight
        by = [changing]
        if columns == 2:
            by.append(changing * (own_s - middle_s)[None, :, None])
        j = np.stack(by, axis=-1)  # s t 3 p
        weighted = np.einsum("st,sij,stjp->stip", share, precision, j)
        g = np.einsum("stip,sti->stp", weighted, r)
        h = np.einsum("stip,stiq->pq", weighted, j)
        if not np.isfinite(h).all() or h[0, 0] <= 0:
            break
        change = -np.linalg.solve(h, g.sum((0, 1)))
        offset_s += float(np.clip(change[0], -0.05, 0.05))
        drift += float(change[1]) if columns == 2 else 0.0
        block = np.broadcast_to(blocks_of(at_s)[None], g.shape[:2]).ravel()
        which = np.repeat(np.arange(g.shape[0]), g.shape[1])
        ways = (block, which) if g.shape[0] > 2 else (block,)
        covariance = clustered_covariance(g.reshape(-1, columns), h, *ways)
        energy = [np.sum(x**2, axis=(1, 2)) for x in (bone, turned)]
        product = float(np.sum(bone * turned))
        correlation = product / max(float(np.sqrt(energy[0] * energy[1]).sum()), 1e-9)
        if abs(change[0]) < 1e-5:
            break
    error_s = float(np.sqrt(max(covariance[0, 0], 0.0) + SOLVE_S**2))
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
        aligned=_speeds(signals, offset_s),
    )


def _speeds(signals: _Signals, offset_s: float) -> Float[np.ndarray, "3 t"]:
    sensor = _read(signals.sensor, signals.own_s, signals.at_s - offset_s)
    speed = [np.linalg.norm(each, axis=2) for each in (signals.bone, sensor)]
    known = np.isfinite(speed[0] + speed[1])
    count = known.sum(0)
    mean = [np.where(known, each, 0.0).sum(0) / np.maximum(count, 1) for each in speed]
    return np.stack([signals.at_s, *(np.where(count > 0, each, np.nan) for each in mean)])


def _weights(
    names: Sequence[str], r: Float[np.ndarray, "s t 3"], known: np.ndarray
) -> tuple[Float[np.ndarray, "s 3 3"], Float[np.ndarray, "s t"]]:
    """Per sensor the inverse covariance of its residuals, without a limb's turn about itself.

    And per instant a factor that takes outliers out.
    """
    precision = np.empty((len(names), 3, 3))
    for index, name in enumerate(names):
        own = r[index, known[index]]
        size = np.linalg.norm(own, axis=1)
        own = own[size <= np.quantile(size, _TRIMMED)] if len(own) else own
        spread = own.T @ own / max(len(own), 1) + _LEAST_RAD_S**2 * np.eye(3)
        precision[index] = np.linalg.inv(spread)
        axis = _TURNS_ABOUT.get(name.removeprefix("left_").removeprefix("right_"))
        if axis is not None:
            precision[index, axis] = precision[index, :, axis] = 0.0
    squared = np.einsum("sti,sij,stj->st", r, precision, r) / 3
    return precision, known / (1.0 + squared / 2.5**2)


def _turned(
    rotation: Float[np.ndarray, "s 3 3"],
    bone: Float[np.ndarray, "s t 3"],
    sensor: Float[np.ndarray, "s t 3"],
    precision: Float[np.ndarray, "s 3 3"],
    share: Float[np.ndarray, "s t"],
) -> Float[np.ndarray, "s 3 3"]:
    """A Gauss-Newton step of each sensor's rotation towards its weighted least squares."""
    turned = np.einsum("sij,stj->sti", rotation, sensor)
    by = np.zeros((*turned.shape, 3))  # of e x turned, by e
    x, y, z = np.moveaxis(turned, 2, 0)
    by[:, :, 0, 1], by[:, :, 0, 2] = z, -y
    by[:, :, 1, 0], by[:, :, 1, 2] = -z, x
    by[:, :, 2, 0], by[:, :, 2, 1] = y, -x
    weighted = np.einsum("st,sij,stja->stia", share, precision, by)
    normal = np.einsum("stia,stib->sab", weighted, by) + 1e-9 * np.eye(3)
    right = np.einsum("stia,sti->sa", weighted, bone - turned)
    step = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    return Rotation.from_rotvec(step).as_matrix() @ rotation


def _overlap_s(signals: _Signals, offset_s: float) -> float:
    start = max(signals.at_s[0], signals.own_s[0] + offset_s)
    return float(min(signals.at_s[-1], signals.own_s[-1] + offset_s) - start)
