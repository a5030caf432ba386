"""The sensors of a session's subjects against the people of its video.

Who wears them is the subject's name where the session places it, otherwise whom they fit best. All
sensors of a subject have one clock, but for those that clearly have another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from fusecap.calibrate.sync.clock_rows import (
    SIGNIFICANT,
    ClockEstimate,
    ClockRow,
    Judgement,
    clock_row,
    judge,
)
from fusecap.calibrate.sync.curves import Curve
from fusecap.calibrate.sync.imus import Comparison, Filmed, ImuClock, TimedSensor, unknown_clock
from fusecap.calibrate.sync.signals import MAX_GAP_S
from fusecap.calibrate.sync.stamp import ERROR_S, Stamp, find_stamp
from fusecap.calibrate.verdict import Verdict
from fusecap.geometry.quaternions import from_wxyz
from fusecap.progress import Progress
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_sensors import open_imus
from fusecap.take import Take

SAME_CLOCK_S = 0.06
"""Sensors that lie within this of each other (or `SIGNIFICANT` standard errors) share a clock."""
NEAR_STAMP_S = 0.15
"""A foot stamp confirms an offset that lies within this of it."""


@dataclass(frozen=True, kw_only=True)
class ImuSync:
    """All clocks of a session's sensors."""

    clocks: tuple[tuple[ClockRow, ImuClock], ...] = ()
    stamps: Mapping[str, Stamp] = field(default_factory=dict)
    """By subject."""
    notes: tuple[str, ...] = ()


def compare_imus(
    session: Session, take: Take, *, max_offset_s: float, progress: Progress | None = None
) -> ImuSync:
    """The sensors of all subjects against the people of the take."""
    people = [_filmed(take, index) for index in range(len(take.subject_names))]
    worn = [subject for subject in session.subjects if subject.imus]
    tracks = [open_imus(subject) for subject in worn]
    sensors = [
        [_worn(imu.bone, track) for imu, track in zip(subject.imus, some, strict=True)]
        for subject, some in zip(worn, tracks, strict=True)
    ]
    wearing = wearers(session, worn, sensors, people, max_offset_s)
    clocks: list[tuple[ClockRow, ImuClock]] = []
    stamps: dict[str, Stamp] = {}
    for done, (subject, some) in enumerate(zip(worn, tracks, strict=True)):
        if progress:
            progress("comparing sensors", done, len(worn))
        person = wearing[done]
        if person is None:
            clocks.append((_unseen(subject), unknown_clock(sensors[done], "")))
            continue
        stamp = _stamp(take, subject, some, person.name)
        if stamp is not None:
            stamps[subject.name] = stamp
        near_s = stamp.offset_s if stamp else None
        clocks += [
            (_imu_row(subject, clock, stamp, max_offset_s), clock)
            for clock in subject_clocks(subject, some, sensors[done], person, max_offset_s, near_s)
        ]
    if progress:
        progress("comparing sensors", len(worn), len(worn))
    return ImuSync(
        clocks=tuple(clocks), stamps=stamps, notes=called_otherwise(worn, wearing, _starts_m(take))
    )


def _starts_m(take: Take) -> dict[str, tuple[float, float]]:
    """x, z where each person is first tracked."""
    starts = {}
    for index, name in enumerate(take.subject_names):
        first = int(np.argmax(take.tracked[index]))
        x, _, z = take.bone_position_in_world_m[index, first, 0]
        starts[name] = (float(x), float(z))
    return starts


def called_otherwise(
    worn: Sequence[SubjectSettings],
    wearing: Sequence[Filmed | None],
    starts_m: Mapping[str, tuple[float, float]],
) -> tuple[str, ...]:
    """A note on each subject that the video calls by another's name."""
    notes = []
    for subject, person in zip(worn, wearing, strict=True):
        if person is not None and person.name != subject.name:
            x, z = starts_m[person.name]
            notes.append(
                f"the sensors of '{subject.name}' fit the person whom the video calls "
                f"'{person.name}'; add start_m = [{x:.1f}, {z:.1f}] to '{subject.name}'"
            )
    return tuple(notes)


def wearers(
    session: Session,
    worn: Sequence[SubjectSettings],
    sensors: Sequence[Sequence[TimedSensor]],
    people: Sequence[Filmed],
    max_offset_s: float,
) -> list[Filmed | None]:
    """Whom of the video each subject is; nobody is two of them.

    A subject that `start_m` places, or the only one, has its name in the video. The others are
    assigned together, such that their sensors fit best.
    """
    by_name = {person.name: person for person in people}
    placed = [
        by_name.get(subject.name)
        if subject.start_m is not None or len(session.subjects) == 1
        else None
        for subject in worn
    ]
    taken = [person.name for person in placed if person is not None]
    free = [person for person in people if person.name not in taken]
    open_ = [index for index, person in enumerate(placed) if person is None]
    if not (free and open_):
        return placed
    fits = np.array(
        [
            [
                Comparison(sensors[i], person, max_offset_s=max_offset_s)
                .clock(range(len(sensors[i])))
                .correlation
                for person in free
            ]
            for i in open_
        ]
    )
    for row, column in zip(*linear_sum_assignment(-fits), strict=True):
        placed[open_[row]] = free[column]
    return placed


def _unseen(subject: SubjectSettings) -> ClockRow:
    judged = Judgement(
        state="not found",
        said="the video shows nobody who could wear these sensors; check start_m and max_subjects",
    )
    bones = tuple(imu.bone for imu in subject.imus)
    return clock_row("imu", subject.name, judged, ClockEstimate(), bones)


def _filmed(take: Take, index: int) -> Filmed:
    rotation = take.bone_rotation_in_world(index).copy()
    rotation[~take.tracked[index]] = np.nan
    return Filmed(
        name=take.subject_names[index],
        times_s=take.time_s,
        bone_names=take.bone_names,
        rotation=rotation,
    )


def _worn(bone: str, track: ImuTrack) -> TimedSensor:
    return TimedSensor(
        bone=bone,
        times_s=track.times_s,
        rotation=from_wxyz(track.orientation_wxyz).as_matrix(),
    )


def subject_clocks(
    subject: SubjectSettings,
    tracks: Sequence[ImuTrack],
    sensors: Sequence[TimedSensor],
    person: Filmed,
    max_offset_s: float,
    near_s: float | None,
) -> list[ImuClock]:
    """One clock for all sensors of a subject, but for those that clearly have another.

    Sensors of one recorder (packet counter, or one file) stay together.
    """
    compared = Comparison(sensors, person, max_offset_s=max_offset_s)
    together = compared.clock(range(len(sensors)), near_s=near_s)
    recorders: dict[str, list[int]] = {}
    for index, (imu, track) in enumerate(zip(subject.imus, tracks, strict=True)):
        key = f"clock {track.clock.period_s}" if track.clock else str(imu.file)
        recorders.setdefault(key, []).append(index)
    if len(recorders) < 2:
        return [together]
    alone = {key: compared.clock(group, near_s=near_s) for key, group in recorders.items()}
    sure = {k: c for k, c in alone.items() if c.peak is not None and c.peak.distinct}
    if len(sure) < 2:
        return [together]
    groups = _same_clocks(sure)
    if len(groups) < 2:
        return [together]
    for key, unsure in alone.items():
        if key not in sure:
            cost = [_cost_at(unsure.curve, sure[group[0]].offset_s) for group in groups]
            groups[int(np.argmin(cost))].append(key)
    members = [sorted(i for key in group for i in recorders[key]) for group in groups]
    return [compared.clock(group, near_s=near_s) for group in members]


def _cost_at(curve: Curve | None, offset_s: float) -> float:
    """Infinite where the curve does not reach."""
    if curve is None:
        return float("inf")
    cost = curve.mean[int(np.argmin(np.abs(curve.shifts_s - offset_s)))]
    return float(cost) if np.isfinite(cost) else float("inf")


def _same_clocks(sure: Mapping[str, ImuClock]) -> list[list[str]]:
    """Recorders by clock, the largest group first."""
    left = sorted(sure, key=lambda key: sure[key].offset_s)
    groups = []
    while left:
        middle_s = sure[left[len(left) // 2]].offset_s
        group = [
            key
            for key in left
            if abs(sure[key].offset_s - middle_s)
            <= max(SAME_CLOCK_S, SIGNIFICANT * sure[key].error_s)
        ]
        groups.append(group)
        left = [key for key in left if key not in group]
    return sorted(groups, key=len, reverse=True)


def _stamp(
    take: Take, subject: SubjectSettings, tracks: Sequence[ImuTrack], person: str
) -> Stamp | None:
    index = take.subject(person)
    feet = {}
    for side in ("left", "right"):
        ankle = take.bone_position_in_world_m[index, :, take.bone_names.index(f"{side}_foot")]
        feet[side] = (take.time_s, np.where(take.tracked[index][:, None], ankle, np.nan))
    forces = [
        (imu.bone, track.times_s, track.accel_m_s2.astype(np.float64))
        for imu, track in zip(subject.imus, tracks, strict=True)
        if imu.bone.endswith(("_foot", "_shank"))
    ]
    return find_stamp(feet, forces)


def _imu_row(
    subject: SubjectSettings, clock: ImuClock, stamp: Stamp | None, max_offset_s: float
) -> ClockRow:
    peak = clock.peak
    offset_s, error_s = clock.offset_s, clock.error_s
    rivals_s = peak.rivals_s if peak else ()
    judged = judge(
        peak,
        moving=peak is not None,
        seen=True,
        error_s=error_s,
        max_offset_s=max_offset_s,
        who="the video",
    )
    if stamp is not None:
        near = bool(abs(offset_s - stamp.offset_s) < NEAR_STAMP_S)
        if judged.state == "found":
            if not near:
                said = f"a foot stamp says {1e3 * stamp.offset_s:+.0f} ms; look at the picture"
                judged = replace(judged, said=said)
        elif near:
            judged = Judgement(state="found", verdict=Verdict.USABLE, said="the foot stamp decided")
            rivals_s = ()
        else:
            judged = Judgement(
                state="found", verdict=Verdict.POOR, said="from the foot stamp alone"
            )
            offset_s, error_s, rivals_s = stamp.offset_s, ERROR_S, ()
    estimate = ClockEstimate(
        offset_s=offset_s,
        error_s=error_s,
        drift_ppm=clock.drift_ppm,
        drift_error_ppm=clock.drift_error_ppm,
        rivals_s=tuple(r for r in rivals_s if abs(r - offset_s) > MAX_GAP_S),
        correlation=clock.correlation,
    )
    return clock_row("imu", subject.name, judged, estimate, clock.bones)
