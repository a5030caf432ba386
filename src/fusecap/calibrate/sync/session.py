"""`fusecap calibrate sync`: the clocks of a session's cameras and sensors, and how sure they are.

Cameras first (`cameras`), then the people as solved from cameras on these clocks, then the sensors
against the people (`imus`, `stamp`). The session's own `offset_s` count as given; its `sync` file
does not, so that a second run finds what the first one found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from fusecap.batch.solve import solve_session
from fusecap.calibrate.sync.cameras import CameraClocks, limb_speeds, synchronise_cameras
from fusecap.calibrate.sync.curves import Curve, Peak
from fusecap.calibrate.sync.imus import Comparison, Filmed, ImuClock, Worn, unknown_clock
from fusecap.calibrate.sync.signals import MAX_GAP_S, View, common_smooth_s, view_of
from fusecap.calibrate.sync.stamp import ERROR_S, Stamp, find_stamp
from fusecap.errors import CalibrationError, InputError
from fusecap.geometry.camera import Rig
from fusecap.sources.imu_files import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_data import (
    SessionData,
    common_landmarks,
    open_imus,
    open_keypoints,
    open_rig,
    solve_times_s,
    with_detections,
)
from fusecap.sources.sync_files import Clock, Clocks
from fusecap.take import Take

Progress = Callable[[str, int, int], None]

GOOD_S, FAIR_S = 0.005, 0.015
MIN_SPEED = 0.05
"""Of a view's people in body extents per second, below which nobody moves."""
SIGNIFICANT = 4.0
"""Standard errors that a drift must differ from zero by to be written."""
SAME_CLOCK_S = 0.06
"""Sensors that lie within this of each other (or `SIGNIFICANT` standard errors) share a clock."""

PICTURE_STEP_S = 1 / 30


@dataclass(frozen=True, kw_only=True)
class Row:
    """What is known about one clock; times in s, `offset_s` at the middle of its recording."""

    kind: str
    """camera or imu."""
    name: str
    """Of the camera or subject."""
    sensors: tuple[str, ...]
    """Bones of the sensors on this clock; empty for a camera."""
    offset_s: float | None
    """None: not determined."""
    error_s: float | None
    drift_ppm: float | None
    """None: too short to tell."""
    drift_error_ppm: float | None
    drift_used: bool
    correlation: float | None
    rivals_s: tuple[float, ...]
    """Other offsets that the data cannot tell from this one."""
    verdict: str
    """good, fair, poor, ambiguous, reference, or not found."""
    said: str
    """Why, and what to do; empty where all is well."""


@dataclass(frozen=True, kw_only=True)
class Synchronisation:
    """All rows, the clocks to write, and what the pictures show."""

    rows: tuple[Row, ...]
    clocks: Clocks
    """Of what was found well enough; the others keep their times."""
    reference: str | None
    cameras: CameraClocks | None
    imus: tuple[ImuClock, ...]
    stamps: dict[str, Stamp]
    """By subject."""
    notes: tuple[str, ...]
    speeds: dict[str, Float[np.ndarray, "2 t"]]
    """For pictures, of each camera on a clock that was found: session times [s], and how fast
    people move [body extents per second]."""

    @property
    def complete(self) -> bool:
        """Whether every clock was found."""
        return all(row.verdict not in ("ambiguous", "not found") for row in self.rows)


def synchronise(
    session: Session, *, max_offset_s: float = 10.0, progress: Progress | None = None
) -> Synchronisation:
    """Raises `InputError` where there is nothing that could be compared."""
    worn = [subject for subject in session.subjects if subject.imus]
    if not session.cameras:
        raise InputError(
            f"{session.path}: no cameras; sensors are compared with people in videos. Sensors of "
            "one recorder are already on one clock"
        )
    if len(session.cameras) < 2 and not worn:
        raise InputError(
            f"{session.path}: one camera and no sensors; there is nothing to synchronise"
        )
    _check_bones(session, worn)
    session = with_detections(session)
    tracks = open_keypoints(session, progress)
    if not any(len(people) for track in tracks for people in track.people):
        raise InputError(
            f"{session.path}: no camera saw anybody; check the keypoints with: fusecap doctor "
            f"{session.folder}"
        )
    notes: list[str] = []
    rig = _rig(session, notes)
    views = []
    smooth_s = common_smooth_s(tracks)
    for done, track in enumerate(tracks):
        if progress:
            progress("following people", done, len(tracks))
        views.append(view_of(track, rig[track.name] if rig else None, smooth_s))
    if progress:
        progress("following people", len(tracks), len(tracks))
    cameras, rows, clocks = None, [], {}
    names = tuple(tracks[0].landmarks.landmark_names)
    if len(tracks) > 1:
        cameras = synchronise_cameras(
            rig,
            views,
            names,
            max_offset_s=max_offset_s,
            progress=progress,
        )
        for index, view in enumerate(views):
            row = _camera_row(cameras, index, view, max_offset_s)
            rows.append(row)
            if (clock := _clock(row, float(cameras.middle_s[index]))) is not None:
                clocks[view.name] = clock
    imus: dict[str, dict[str, Clock]] = {}
    found: list[ImuClock] = []
    stamps: dict[str, Stamp] = {}
    if worn and rig is None:
        notes.append("sensors need a calibration of the cameras; only cameras were compared")
    elif worn:
        synced = [
            replace(track, times_s=clocks.get(track.name, Clock()).session_s(track.times_s))
            for track in tracks
            if len(tracks) == 1 or track.name in clocks
        ]
        take = _filmed_take(session, synced, progress)
        into = (rows, imus, found, stamps, notes)
        _add_imus(session, take, max_offset_s, into, progress)
    reference = views[cameras.reference].name if cameras else None
    return Synchronisation(
        rows=tuple(rows),
        clocks=Clocks(cameras=clocks, imus=imus),
        reference=reference,
        cameras=cameras,
        imus=tuple(found),
        stamps=stamps,
        notes=tuple(notes),
        speeds={
            view.name: _speeds(view, names, clocks[view.name])
            for view in views
            if view.name in clocks
        },
    )


def _speeds(view: View, names: Sequence[str], clock: Clock) -> Float[np.ndarray, "2 t"]:
    own_s = np.arange(view.times_s[0], view.times_s[-1], PICTURE_STEP_S)
    groups = limb_speeds(view, names, own_s)
    known = np.isfinite(groups)
    mean = np.where(known, groups, 0.0).sum(1) / np.maximum(known.sum(1), 1)
    return np.stack([clock.session_s(own_s), np.where(known.any(1), mean**2, np.nan)])


def _check_bones(session: Session, worn: Sequence[SubjectSettings]) -> None:
    """A sync file names a sensor by its bone."""
    for subject in worn:
        bones = [imu.bone for imu in subject.imus]
        for bone in dict.fromkeys(bones):
            if bones.count(bone) > 1:
                raise InputError(
                    f"{session.path}: '{subject.name}' has {bones.count(bone)} sensors on "
                    f"'{bone}', expected one per bone; the clocks of both could not be told apart "
                    "in sync.toml: leave one out, or state the bone it is really on"
                )


def _rig(session: Session, notes: list[str]) -> Rig | None:
    calibration = session.settings.calibration
    if calibration is None or not calibration.exists():
        notes.append(
            "no calibration: offsets come from how fast people move in the images, to about a "
            "frame; calibrate the cameras and run again for a fraction of one"
        )
        return None
    try:
        rig, _ = open_rig(session)
    except CalibrationError as error:
        raise CalibrationError(f"{error}; or take the calibration away to go without") from None
    return rig


def _camera_row(cameras: CameraClocks, index: int, view: View, max_offset_s: float) -> Row:
    peak = cameras.peaks[index]
    drift_ppm, drift_error = float(cameras.drift_ppm[index]), float(cameras.drift_error_ppm[index])
    if index == cameras.reference and peak is not None:
        return _row("camera", view.name, (), 0.0, 0.0, None, None, (), "reference", "")
    verdict, said = _judge(
        peak,
        moving=_speed(view) >= MIN_SPEED,
        seen=view.seen,
        error_s=float(cameras.error_s[index]) if cameras.refined else view.period_s,
        max_offset_s=max_offset_s,
        who="the other cameras",
    )
    offset_s = float(cameras.offset_s[index])
    error_s = float(cameras.error_s[index]) if cameras.refined else view.period_s
    rivals = tuple(r - peak.shift_s + offset_s for r in peak.rivals_s) if peak else ()
    return _row(
        "camera", view.name, (), offset_s, error_s, drift_ppm, drift_error, rivals, verdict, said
    )


def _judge(
    peak: Peak | None,
    *,
    moving: bool,
    seen: bool,
    error_s: float,
    max_offset_s: float,
    who: str,
) -> tuple[str, str]:
    if not seen:
        return "not found", "nobody is seen here; check the detector's output of this camera"
    if not moving:
        return "not found", "nobody moves; record people who walk about and wave their arms"
    if peak is None:
        return (
            "not found",
            f"too little in common with {who}; record longer, or give a rough offset_s and a "
            "larger --max-offset",
        )
    if peak.rivals_s:
        every = ", ".join(f"{1e3 * (r - peak.shift_s):+.0f}" for r in peak.rivals_s[:4])
        return (
            "ambiguous",
            f"offsets {every} ms away fit as well: the motion repeats itself; record something "
            "that does not, such as one stamp or jump, or narrow --max-offset",
        )
    if peak.at_edge:
        return (
            "not found",
            f"the best offset is the end of the range of {max_offset_s:g} s; raise --max-offset",
        )
    if not peak.distinct:
        return (
            "not found",
            f"no offset within {max_offset_s:g} s fits better than the rest; record longer and "
            "livelier motion, or raise --max-offset",
        )
    if not np.isfinite(error_s):
        return "not found", "too few keypoints in common to refine; record longer"
    if error_s <= GOOD_S:
        return "good", ""
    if error_s <= FAIR_S:
        return "fair", ""
    return "poor", "the standard error is large; record longer or livelier motion"


def _row(
    kind: str,
    name: str,
    sensors: tuple[str, ...],
    offset_s: float,
    error_s: float,
    drift_ppm: float | None,
    drift_error_ppm: float | None,
    rivals_s: tuple[float, ...],
    verdict: str,
    said: str,
    correlation: float | None = None,
) -> Row:
    known = verdict != "not found"
    drifts = (
        known
        and drift_ppm is not None
        and drift_error_ppm is not None
        and bool(np.isfinite(drift_ppm) and np.isfinite(drift_error_ppm))
    )
    return Row(
        kind=kind,
        name=name,
        sensors=sensors,
        offset_s=offset_s if known else None,
        error_s=error_s if known and np.isfinite(error_s) else None,
        drift_ppm=drift_ppm if drifts else None,
        drift_error_ppm=drift_error_ppm if drifts else None,
        drift_used=bool(
            drifts
            and drift_ppm is not None
            and drift_error_ppm is not None
            and abs(drift_ppm) > SIGNIFICANT * drift_error_ppm
        ),
        correlation=correlation,
        rivals_s=rivals_s,
        verdict=verdict,
        said=said,
    )


def _clock(row: Row, middle_s: float) -> Clock | None:
    """What to write; an offset at the middle becomes one at the clock's zero."""
    if row.offset_s is None or row.verdict == "ambiguous":
        return None
    drift_ppm = row.drift_ppm if row.drift_used and row.drift_ppm is not None else 0.0
    return Clock(
        offset_s=row.offset_s - 1e-6 * drift_ppm * middle_s,
        drift_ppm=drift_ppm,
        error_s=row.error_s,
    )


def _speed(view: View) -> float:
    """Upper quartile of keypoint speeds in extents per second; noise is smoothed away."""
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.linalg.norm(view.trend, axis=2) / view.extent[:, None]
    known = speed[np.isfinite(speed)]
    return float(np.percentile(known, 75)) if len(known) else 0.0


def _filmed_take(
    session: Session, tracks: Sequence[KeypointTrack], progress: Progress | None
) -> Take:
    """People as solved from these cameras alone."""
    names = [track.name for track in tracks]
    alone = session.model_copy(
        update={
            "subjects": tuple(s.model_copy(update={"imus": ()}) for s in session.subjects),
            "cameras": tuple(camera for camera in session.cameras if camera.name in names),
        }
    )
    rig, _ = open_rig(alone)
    data = SessionData(
        session=alone,
        rig=rig,
        landmarks=common_landmarks(alone),
        keypoints=tuple(tracks),
        imus=(),
        times_s=solve_times_s(alone, tuple(tracks), []),
        findings=(),
        content_hash="",
    )
    return solve_session(data, progress=progress).take


Found = tuple[list[Row], dict[str, dict[str, Clock]], list[ImuClock], dict[str, Stamp], list[str]]


def _add_imus(
    session: Session, take: Take, max_offset_s: float, into: Found, progress: Progress | None
) -> None:
    rows, clocks, found, stamps, notes = into
    people = [_filmed(take, index) for index in range(len(take.subject_names))]
    worn = [subject for subject in session.subjects if subject.imus]
    tracks = [open_imus(subject) for subject in worn]
    sensors = [
        [_worn(imu.bone, track) for imu, track in zip(subject.imus, some, strict=True)]
        for subject, some in zip(worn, tracks, strict=True)
    ]
    wearing = _wearers(session, worn, sensors, people, _starts_m(take), max_offset_s, notes)
    for done, (subject, some) in enumerate(zip(worn, tracks, strict=True)):
        if progress:
            progress("comparing sensors", done, len(worn))
        person = wearing[done]
        if person is None:
            rows.append(_unseen(subject))
            found.append(unknown_clock(sensors[done], ""))
            continue
        stamp = _stamp(take, subject, some, person.name)
        if stamp is not None:
            stamps[subject.name] = stamp
        near_s = stamp.offset_s if stamp else None
        for clock in _subject_clocks(subject, some, sensors[done], person, max_offset_s, near_s):
            row = _imu_row(subject, clock, stamp, max_offset_s)
            rows.append(row)
            found.append(clock)
            if (written := _clock(row, clock.middle_s)) is not None:
                for bone in clock.bones:
                    clocks.setdefault(subject.name, {})[bone] = written
    if progress:
        progress("comparing sensors", len(worn), len(worn))


def _starts_m(take: Take) -> dict[str, tuple[float, float]]:
    """x, z where each person is first tracked."""
    starts = {}
    for index, name in enumerate(take.subject_names):
        first = int(np.argmax(take.tracked[index]))
        x, _, z = take.bone_position_in_world_m[index, first, 0]
        starts[name] = (float(x), float(z))
    return starts


def _wearers(
    session: Session,
    worn: Sequence[SubjectSettings],
    sensors: Sequence[Sequence[Worn]],
    people: Sequence[Filmed],
    starts_m: Mapping[str, tuple[float, float]],
    max_offset_s: float,
    notes: list[str],
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
        subject, person = worn[open_[row]], free[column]
        placed[open_[row]] = person
        if person.name != subject.name:
            x, z = starts_m[person.name]
            notes.append(
                f"the sensors of '{subject.name}' fit the person whom the video calls "
                f"'{person.name}'; add start_m = [{x:.1f}, {z:.1f}] to '{subject.name}'"
            )
    return placed


def _unseen(subject: SubjectSettings) -> Row:
    return _row(
        "imu",
        subject.name,
        tuple(imu.bone for imu in subject.imus),
        float("nan"),
        float("nan"),
        None,
        None,
        (),
        "not found",
        "the video shows nobody who could wear these sensors; check start_m and max_subjects",
    )


def _filmed(take: Take, index: int) -> Filmed:
    rotation = take.bone_rotation_in_world(index).copy()
    rotation[~take.tracked[index]] = np.nan
    return Filmed(
        name=take.subject_names[index],
        times_s=take.time_s,
        bone_names=take.bone_names,
        rotation=rotation,
    )


def _worn(bone: str, track: ImuTrack) -> Worn:
    return Worn(
        bone=bone,
        times_s=track.times_s,
        rotation=Rotation.from_quat(track.orientation_wxyz[:, [1, 2, 3, 0]]).as_matrix(),
    )


def _subject_clocks(
    subject: SubjectSettings,
    tracks: Sequence[ImuTrack],
    sensors: Sequence[Worn],
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
        (imu.bone, track.times_s, track.accel_m_s2)
        for imu, track in zip(subject.imus, tracks, strict=True)
        if imu.bone.endswith(("_foot", "_shank"))
    ]
    return find_stamp(feet, forces)


def _imu_row(
    subject: SubjectSettings, clock: ImuClock, stamp: Stamp | None, max_offset_s: float
) -> Row:
    peak = clock.peak
    offset_s, error_s = clock.offset_s, clock.error_s
    verdict, said = _judge(
        peak,
        moving=peak is not None,
        seen=True,
        error_s=error_s,
        max_offset_s=max_offset_s,
        who="the video",
    )
    rivals = peak.rivals_s if peak else ()
    if stamp is not None and verdict in ("ambiguous", "not found"):
        near = np.isfinite(offset_s) and abs(offset_s - stamp.offset_s) < 0.15
        verdict, said = ("fair", "") if near else ("poor", "")
        said = "the foot stamp decided" if near else "from the foot stamp alone"
        if not near:
            offset_s, error_s = stamp.offset_s, ERROR_S
        rivals = ()
    elif stamp is not None and abs(offset_s - stamp.offset_s) > 0.15:
        said = f"a foot stamp says {1e3 * stamp.offset_s:+.0f} ms; look at the picture"
    rivals = tuple(r for r in rivals if abs(r - offset_s) > MAX_GAP_S)
    return _row(
        "imu",
        subject.name,
        clock.bones,
        offset_s,
        error_s,
        clock.drift_ppm,
        clock.drift_error_ppm,
        rivals,
        verdict,
        said,
        clock.correlation,
    )
