"""Whether the sensors of one person move as bones do that hang together at joints.

Two neighbouring bones have one point in common. With r from each sensor to it, R'' the second
derivative of a bone's rotation and a what its accelerometer reads without gravity, in the world,

    a_lower - a_upper = R''_upper r_upper - R''_lower r_lower

at every instant: two times three numbers for all of them. In a right session they leave a fifth
of the accelerations, about as much as sensors err by, and lead to a knee within one to three
centimetres, on three seconds of a simulated walk as on a recorded one. A sensor that is late by a
tenth of a second leaves several times as much. What makes it fall to less than `EXPLAINED` is
named: another time, another sensor, another heading. Then joints are compared with the body: two
of one bone lie along it, and as far apart as the person's stature says.

Nobody can say so of all of a person's sensors, late or turned alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from fusecap.body.prior import load_prior
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import FusecapError
from fusecap.findings import Findings
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_sensors import mount
from fusecap.sources.synchronizer import MountedImu, resample_imus

RATE_HZ = 50.0
SMOOTH_S = 0.06
"""Standard deviation of the Gaussian that smooths and derives."""
STRETCHES, STRETCH_S = 4, 5.0
"""Of a recording, spread evenly over it."""
LEAST_INSTANTS = 50
FLOOR_M_S2, SHARE = 0.35, 0.2
"""What joints leave in a right session: this, and so much of the accelerations."""
NOTABLE = 1.5
"""So many times the square of that; below it no cause is looked for."""
EXPLAINED = 0.5
EXPLAINED_BY_TIME = 0.7
"""Of 156 sensors of right sessions no other time left less than the own one."""
SHIFTS_S = np.arange(-36, 37) * 0.04
LEAST_SHIFT_S = 0.06
HEADINGS_RAD = np.radians(np.arange(-170, 181, 10))
LEAST_HEADING_RAD = np.radians(20.0)
MOVED_M_S2, MOVED_LITTLE_M_S2, LITTLE_S = 1.0, 0.6, 0.6
"""Who hardly moves tells neither heading nor time nor place; a little tells a little shift."""
MOST_CAUSES, MOST_SUSPECTS = 8, 10
"""With more, nobody exchanged two."""
FOREIGN, FOREIGN_M_S2 = 0.75, 1.5
"""Joints that leave this share of accelerations of this size are none."""
AWAY_RAD, AWAY_SIGMAS = np.radians(20.0), 2.0
"""A line from joint to joint points elsewhere that is so far off along some axis, and so many
standard deviations of that."""
LENGTHS, SURE = (0.75, 1.3), 0.12
"""Of lines over the body's; those are looked at that are known within this share."""
BENT, MOUNTED_RAD = 3.5, np.radians(10.0)
"""Standard deviations of ordinary poses and, per axis, of how sensors sit: at most 1.8 in the
median of right sessions; who squats deeply has 2.7."""
BENDS_STEP = 5
RIDGE, CORRELATED = 1e-3, 10.0
"""Instants so close together err alike: so many count as one."""
_JOINTS = (
    ("hips", "spine3"),
    ("spine3", "head"),
    *(
        (upper.format(side), lower.format(side))
        for side in ("left", "right")
        for upper, lower in (
            ("spine3", "{}_upper_arm"),
            ("{}_upper_arm", "{}_forearm"),
            ("hips", "{}_thigh"),
            ("{}_thigh", "{}_shank"),
            ("{}_shank", "{}_foot"),
        )
    ),
)


@dataclass(frozen=True, kw_only=True)
class _Moved:
    """How one sensor moved, smoothed, over S stretches of T instants."""

    turn: Float[np.ndarray, "s t 3 3"]
    """Second derivative of the bone's rotation in the world [1/s²]."""
    accel: Float[np.ndarray, "s t 3"]
    """Without gravity [m/s²]."""
    known: Bool[np.ndarray, "s t"]

    def later(self, steps: int) -> _Moved:
        """As if its clock were so many instants behind."""
        known = np.roll(self.known, steps, axis=1)
        if steps > 0:
            known[:, :steps] = False
        elif steps < 0:
            known[:, steps:] = False
        return _Moved(
            turn=np.roll(self.turn, steps, axis=1),
            accel=np.roll(self.accel, steps, axis=1),
            known=known,
        )

    def about_up(self, heading_rad: float) -> _Moved:
        """As if its reference world faced otherwise."""
        about_up = Rotation.from_euler("y", heading_rad).as_matrix()
        return _Moved(turn=about_up @ self.turn, accel=self.accel @ about_up.T, known=self.known)


@dataclass(frozen=True, kw_only=True)
class _Joint:
    """What two sensors say of the joint between their bones."""

    to_joint_m: Float[np.ndarray, "2 3"]
    """From the upper and from the lower sensor, each in its bone's frame."""
    sigma_m: Float[np.ndarray, "2 3"]
    left: float
    """Mean square of what is left [m²/s⁴]."""
    moved: float
    """The same of the difference of accelerations."""
    instants: int


def _joint(upper: _Moved, lower: _Moved) -> _Joint | None:
    """None of too few instants."""
    known = upper.known & lower.known
    count = int(known.sum())
    if count < LEAST_INSTANTS:
        return None
    matrix = np.concatenate([upper.turn[known], -lower.turn[known]], axis=2).reshape(-1, 6)
    vector = (lower.accel[known] - upper.accel[known]).ravel()
    inverse = np.linalg.inv(matrix.T @ matrix + RIDGE * count * np.eye(6))
    to_joint = inverse @ (matrix.T @ vector)
    left = float(((vector - matrix @ to_joint) ** 2).sum()) / count
    return _Joint(
        to_joint_m=to_joint.reshape(2, 3),
        sigma_m=np.sqrt(left / 3.0 * CORRELATED * np.diag(inverse)).reshape(2, 3),
        left=left,
        moved=float((vector**2).sum()) / count,
        instants=count,
    )


@dataclass(frozen=True, kw_only=True)
class _Line:
    """From one joint of a bone to another, in the bone's frame."""

    expected_m: Float[np.ndarray, " 3"]
    measured_m: Float[np.ndarray, " 3"]
    sigma_m: Float[np.ndarray, " 3"]

    @property
    def ratio(self) -> float:
        """Of the measured length to the expected one."""
        return _length(self.measured_m) / _length(self.expected_m)

    @property
    def length_is_sure(self) -> bool:
        """Whether the ratio means anything."""
        longer_m = max(_length(self.measured_m), _length(self.expected_m))
        return _length(self.sigma_m) < SURE * longer_m

    @property
    def away_rad(self) -> float:
        """The angle between them; 0 where it may be nothing along every axis."""
        length_m = _length(self.expected_m)
        direction = self.measured_m / _length(self.measured_m)
        apart_m = np.abs(direction * length_m - self.expected_m)
        if not (apart_m - AWAY_SIGMAS * self.sigma_m > length_m * np.sin(AWAY_RAD)).any():
            return 0.0
        cosine = direction @ self.expected_m / length_m
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _length(vector: Float[np.ndarray, " 3"]) -> float:
    return float(np.linalg.norm(vector))


class _Body:
    """One person's sensors, and the joints between them."""

    def __init__(
        self,
        name: str,
        shape: BodyShape,
        imus: Sequence[MountedImu],
        times_s: Float[np.ndarray, "s t"],
    ) -> None:
        """`times_s` are stretches at `RATE_HZ`."""
        self.name = name
        self.shape = shape
        self.imus = imus
        self.times_s = times_s
        self.moved = [self.as_moved(imu) for imu in imus]
        self.joints: dict[tuple[int, int], _Joint] = {}
        bones = [imu.bone for imu in imus]
        for upper, lower in _JOINTS:
            if upper in bones and lower in bones:
                self._measure((bones.index(upper), bones.index(lower)))

    def _measure(self, pair: tuple[int, int]) -> None:
        joint = _joint(self.moved[pair[0]], self.moved[pair[1]])
        if joint is not None:
            self.joints[pair] = joint

    def as_moved(self, imu: MountedImu) -> _Moved:
        """A sensor's motion in this person's stretches."""
        rotation, accel = resample_imus([imu], self.times_s.ravel())
        rotation = rotation.reshape(*self.times_s.shape, 3, 3)
        accel = accel.reshape(*self.times_s.shape, 3)
        missing = ~np.isfinite(rotation).all(axis=(2, 3)) | ~np.isfinite(accel).all(axis=2)
        sigma = SMOOTH_S * RATE_HZ
        reach = int(3 * sigma)
        padded = np.pad(missing, ((0, 0), (reach, reach)), constant_values=True)
        near = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
        turn = gaussian_filter1d(np.nan_to_num(rotation), sigma, axis=1, order=2)
        return _Moved(
            turn=RATE_HZ**2 * turn,
            accel=gaussian_filter1d(np.nan_to_num(accel), sigma, axis=1),
            known=np.logical_not(np.any(near, axis=2)),
        )

    def with_instead(self, instead: Mapping[int, _Moved]) -> None:
        """Believe that these sensors moved so."""
        for index, moved in instead.items():
            self.moved[index] = moved
        for pair in self._shared(instead):
            self._measure(pair)

    def _shared(self, indices: Mapping[int, _Moved]) -> list[tuple[int, int]]:
        return [pair for pair in self.joints if indices.keys() & set(pair)]

    def left(self, instead: Mapping[int, _Moved]) -> float:
        """What the joints of these sensors leave over what is usual, had they moved so.

        A sum of squares over instants; infinite where less than half of the instants remains.
        """
        total = 0.0
        for pair in self._shared(instead):
            joint = self.joints[pair]
            found = _joint(*(instead.get(index, self.moved[index]) for index in pair))
            if found is None or found.instants < joint.instants / 2:
                return np.inf
            usual = FLOOR_M_S2**2 + SHARE**2 * min(joint.moved, found.moved)
            total += joint.instants * found.left / usual
        return total

    def instants(self, index: int) -> int:
        """Of all joints of a sensor."""
        return sum(joint.instants for pair, joint in self.joints.items() if index in pair)

    def suspects(self) -> list[int]:
        """Sensors whose joints leave more than is usual."""
        return [
            index
            for index, moved in enumerate(self.moved)
            if self.left({index: moved}) > NOTABLE * self.instants(index)
        ]

    def left_and_moved(self, index: int) -> tuple[float, float]:
        """Root mean squares over the joints of a sensor [m/s²]."""
        own = [(j.left, j.moved) for pair, j in self.joints.items() if index in pair]
        left, moved = np.sqrt(np.mean(own, axis=0)) if own else (0.0, 0.0)
        return float(left), float(moved)

    def where(self, index: int) -> str:
        """What messages call a sensor."""
        return f"imu '{self.imus[index].bone}' of '{self.name}'"

    def lines(self, index: int) -> list[_Line]:
        """Where a bone points by its joints: from one to another, or from where its sensor is."""
        bone = PAPER21.bone(self.imus[index].bone)
        ends = []
        for pair, joint in self.joints.items():
            child = PAPER21.bone(self.imus[pair[1]].bone)
            above = PAPER21.bone_names[PAPER21.parents[child]]
            moves = joint.moved > MOVED_M_S2**2
            if moves and index in pair and self.imus[pair[0]].bone == above:
                side = pair.index(index)
                at = np.zeros(3) if child == bone else self.shape.offsets_m[child]
                ends.append((at, joint.to_joint_m[side], joint.sigma_m[side]))
        stated_m = self.imus[index].position_in_bone_m
        if len(ends) == 1 and stated_m.any():
            ends.append((stated_m, np.zeros(3), np.zeros(3)))
        return [
            _Line(
                expected_m=other_at - at,
                measured_m=other_found - found,
                sigma_m=np.hypot(sigma, other_sigma),
            )
            for (at, found, sigma), (other_at, other_found, other_sigma) in combinations(ends, 2)
        ]


@dataclass(frozen=True, kw_only=True)
class _Cause:
    """What would make one sensor, or two that are exchanged, agree with their neighbours."""

    instead: tuple[tuple[_Body, dict[int, _Moved]], ...]
    left: float
    before: float
    instants: int
    remedy: str
    told: bool = True
    """Not where a heading may be made up for by how the sensor is said to sit: a calibration from
    motion gives their product."""

    def times(self, left: float) -> float:
        """As a multiple of what is usual."""
        return float(np.sqrt(left / self.instants))


def check_joints(
    session: Session,
    imus: Mapping[str, Sequence[ImuTrack | None]],
    told: AbstractSet[str],
    findings: Findings,
) -> None:
    """Of sensors on neighbouring bones, but for those about which something is `told`."""
    bodies = [
        body
        for subject in session.subjects
        if (body := _body(subject, imus.get(subject.name, ()), told)) is not None
    ]
    named = _check_causes(session, bodies, findings)
    for body in bodies:
        foreign = _check_foreign(body, named, findings)
        away = _check_lines(body, named | foreign, findings)
        _check_bends(body, named | foreign | away, findings)


def _body(
    subject: SubjectSettings, tracks: Sequence[ImuTrack | None], told: AbstractSet[str]
) -> _Body | None:
    worn: dict[str, MountedImu] = {}
    for imu, track in zip(subject.imus, tracks, strict=True):
        known = f"imu '{imu.bone}' of '{subject.name}'" in told
        if known or track is None or imu.bone not in PAPER21.bone_names:
            continue
        if track.up_axis not in (None, imu.imu_up):
            continue
        try:
            (worn[imu.bone],) = mount(subject.model_copy(update={"imus": (imu,)}), [track])
        except FusecapError:  # told where sensors are checked
            continue
    if not worn:
        return None
    mounted = list(worn.values())
    start_s = float(np.median([imu.track.times_s[0] for imu in mounted]))
    length_s = float(np.median([imu.track.times_s[-1] for imu in mounted])) - start_s
    if length_s * RATE_HZ < LEAST_INSTANTS:
        return None
    count = min(STRETCHES, max(1, int(length_s // STRETCH_S)))
    stretch_s = min(length_s, STRETCH_S)
    starts_s = start_s + np.linspace(0.0, length_s - stretch_s, count)
    times_s = starts_s[:, None] + np.arange(int(stretch_s * RATE_HZ)) / RATE_HZ
    lengths_m = {
        bone: length_m
        for bone, length_m in subject.bone_lengths_m.items()
        if bone in PAPER21.bone_names
    }
    shape = BodyShape.from_height(PAPER21, subject.height_m or REFERENCE_HEIGHT_M)
    try:
        shape = shape.with_lengths(lengths_m)
    except FusecapError:  # refused where bodies are made
        return None
    body = _Body(subject.name, shape, mounted, times_s)
    return body if body.joints else None


def _check_causes(session: Session, bodies: Sequence[_Body], findings: Findings) -> set[str]:
    """One after the other, the cause that explains most first; where they are."""
    named: set[str] = set()
    for _ in range(MOST_CAUSES):
        suspects = [(body, index) for body in bodies for index in body.suspects()]
        causes = [
            cause
            for body, index in suspects
            for cause in (
                *_time(body, index),
                *_heading(body, index, told=session.settings.imu_calibration is None),
            )
        ]
        if len(suspects) <= MOST_SUSPECTS:
            for (body, index), (other, other_index) in combinations(suspects, 2):
                causes += _exchanged(body, index, other, other_index)
        if not causes:
            break
        best = max(causes, key=lambda cause: cause.before - cause.left)
        where = [body.where(index) for body, moved in best.instead for index in moved]
        told = best.told and named.isdisjoint(where)
        named.update(where)
        if told:
            findings.add(
                "warning",
                where[0],
                f"does not move as its neighbours do: at their joints {best.times(best.before):.1f}"
                " times the usual disagreement",
                f"{best.remedy}: then {best.times(best.left):.1f} times are left",
            )
        for body, moved in best.instead:
            body.with_instead(moved)
    return named


def _time(body: _Body, index: int) -> Iterator[_Cause]:
    """A shift must explain what joints leave at the instants that it keeps."""
    moved, size = body.moved[index], body.left_and_moved(index)[1]
    shifted = [moved.later(round(shift_s * RATE_HZ)) for shift_s in SHIFTS_S.tolist()]
    left = [body.left({index: later}) for later in shifted]
    best = int(np.argmin(left))
    kept = replace(moved, known=moved.known & shifted[best].known)
    if (
        0 < best < len(left) - 1
        and abs(SHIFTS_S[best]) > LEAST_SHIFT_S
        and size > (MOVED_LITTLE_M_S2 if abs(SHIFTS_S[best]) < LITTLE_S else MOVED_M_S2)
        and left[best] < EXPLAINED_BY_TIME * body.left({index: kept})
    ):
        yield _Cause(
            instead=((body, {index: shifted[best]}),),
            left=left[best],
            before=body.left({index: moved}),
            instants=body.instants(index),
            remedy=f"add about {SHIFTS_S[best]:+.2f} s to its offset_s",
        )


def _heading(body: _Body, index: int, *, told: bool) -> Iterator[_Cause]:
    moved, before = body.moved[index], body.left({index: body.moved[index]})
    turned = [moved.about_up(heading_rad) for heading_rad in HEADINGS_RAD.tolist()]
    left = [body.left({index: other}) for other in turned]
    best = int(np.argmin(left))
    if (
        abs(HEADINGS_RAD[best]) >= LEAST_HEADING_RAD
        and left[best] < EXPLAINED * before
        and body.left_and_moved(index)[1] > MOVED_M_S2
    ):
        yield _Cause(
            instead=((body, {index: turned[best]}),),
            left=left[best],
            before=before,
            instants=body.instants(index),
            remedy=f"add about {np.degrees(HEADINGS_RAD[best]):+.0f} to its heading_deg",
            told=told,
        )


def _exchanged(body: _Body, index: int, other: _Body, other_index: int) -> Iterator[_Cause]:
    mine = body.as_moved(replace(body.imus[index], track=other.imus[other_index].track))
    theirs = other.as_moved(replace(other.imus[other_index], track=body.imus[index].track))
    if other is body:
        instead = ((body, {index: mine, other_index: theirs}),)
    else:
        instead = ((body, {index: mine}), (other, {other_index: theirs}))
    left = sum(each.left(moved) for each, moved in instead)
    before = sum(each.left({i: each.moved[i] for i in moved}) for each, moved in instead)
    if left < EXPLAINED * before:
        yield _Cause(
            instead=instead,
            left=left,
            before=before,
            instants=body.instants(index) + other.instants(other_index),
            remedy=f"exchange its file with that of {other.where(other_index)}",
        )


def _check_foreign(body: _Body, named: AbstractSet[str], findings: Findings) -> set[str]:
    """Sensors whose joints are none, for no cause that was found; where they are."""
    foreign = []
    for index in range(len(body.imus)):
        left, moved = body.left_and_moved(index)
        if moved > FOREIGN_M_S2 and left > FOREIGN * moved and body.where(index) not in named:
            foreign.append(index)
    if foreign:
        left, moved = np.mean([body.left_and_moved(index) for index in foreign], axis=0)
        findings.add(
            "warning",
            f"sensors of '{body.name}'",
            "do not move as if their bones hung together at joints: "
            f"{', '.join(body.imus[index].bone for index in foreign)}",
            f"{left:.1f} of {moved:.1f} m/s2 are left; see that each lies on its bone and was not "
            "loose, that no rows are missing and times are right",
        )
    return {body.where(index) for index in foreign}


def _check_lines(body: _Body, told: AbstractSet[str], findings: Findings) -> set[str]:
    """Of joints that are: where they lie in their bones; sensors of which that is said."""
    lines = [
        (index, line)
        for index in range(len(body.imus))
        if body.where(index) not in told
        for line in body.lines(index)
    ]
    ratios = [line.ratio for _, line in lines if line.length_is_sure]
    if ratios and not LENGTHS[0] < (ratio := float(np.median(ratios))) < LENGTHS[1]:
        findings.add(
            "warning",
            f"sensors of '{body.name}'",
            f"joints lie {ratio:.2f} times as far apart as in a body of {body.shape.height_m:g} m",
            f"with times {1 / np.sqrt(ratio):.2f} times as long they fit: see what rate_hz the "
            "sensors recorded at, whether rows are missing, and height_m",
        )
        return set()
    away = set()
    for index, line in lines:
        if line.away_rad > 0.0 and body.where(index) not in away:
            away.add(body.where(index))
            findings.add(
                "warning",
                body.where(index),
                f"sits otherwise on its bone: that points {np.degrees(line.away_rad):.0f} deg away "
                "from the line between its joints",
                "see that it has not slipped; fusecap calibrate imu finds how it sits",
            )
    return away


def _check_bends(body: _Body, told: AbstractSet[str], findings: Findings) -> None:
    """What turns a sensor about its limb moves no joint, but bends it as nobody's is."""
    bent = []
    for pair in body.joints:
        if told.isdisjoint(map(body.where, pair)):
            upper, lower = (body.imus[index] for index in pair)
            rotation, _ = resample_imus([upper, lower], body.times_s[:, ::BENDS_STEP].ravel())
            rotation = rotation[np.isfinite(rotation).all(axis=(1, 2, 3))]
            between = Rotation.from_matrix(np.swapaxes(rotation[:, 0], 1, 2) @ rotation[:, 1])
            if len(rotation) and np.median(_unlikely(upper.bone, lower.bone, between)) > BENT:
                bent.append(f"{upper.bone} to {lower.bone}")
    if bent:
        findings.add(
            "warning",
            f"sensors of '{body.name}'",
            f"joints are bent as hardly anybody's are at the typical instant: {', '.join(bent)}",
            "see how these sensors sit, whether one is turned about its limb; fusecap calibrate "
            "imu finds it",
        )


def _unlikely(upper: str, lower: str, between: Rotation) -> Float[np.ndarray, " n"]:
    """Root mean squares over axes, in standard deviations of the pose prior.

    Of bones in between, means and variances are added.
    """
    prior = load_prior(PAPER21)
    bone, mean, covariance = PAPER21.bone(lower), np.zeros(3), MOUNTED_RAD**2 * np.eye(3)
    while bone != PAPER21.bone(upper):
        own = slice(3 * (bone - 1), 3 * bone)
        mean += prior.mean[own]
        covariance += (prior.basis[own] * prior.sigma**2) @ prior.basis[own].T
        bone = PAPER21.parents[bone]
    off = between.as_rotvec() - mean
    return np.sqrt(np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off) / 3.0)
