"""`fusecap calibrate sync`: the clocks of a session's cameras and sensors, and how sure they are.

Cameras first (`cameras`), then the people as solved from cameras on these clocks, then the sensors
against the people (`imus`, `stamp`). The session's own `offset_s` count as given; its `sync` file
does not, so that a second run finds what the first one found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fusecap.batch.solve import solve_session
from fusecap.calibrate.sync.cameras import CameraClocks, limb_speeds, synchronise_cameras
from fusecap.calibrate.sync.clock_rows import (
    ClockEstimate,
    ClockRow,
    Judgement,
    clock_row,
    judge,
)
from fusecap.calibrate.sync.imus import ImuClock
from fusecap.calibrate.sync.session_imus import ImuSync, compare_imus
from fusecap.calibrate.sync.signals import View, common_smooth_s, view_of
from fusecap.calibrate.sync.stamp import Stamp
from fusecap.errors import CalibrationError, InputError
from fusecap.geometry.camera import Rig
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import Session, SubjectSettings
from fusecap.sources.session_cameras import (
    common_landmarks,
    open_keypoints,
    open_rig,
    with_detections,
)
from fusecap.sources.session_data import SessionData, solve_times_s
from fusecap.sources.sync_files import Clock, Clocks
from fusecap.take import Take

MIN_SPEED = 0.05
"""Of a view's people in body extents per second, below which nobody moves."""
PICTURE_STEP_S = 1 / 30


@dataclass(frozen=True, kw_only=True)
class Synchronisation:
    """All rows, the clocks to write, and what the pictures show."""

    rows: tuple[ClockRow, ...]
    clocks: Clocks
    """Of what was found well enough; the others keep their times."""
    reference: str | None
    cameras: CameraClocks | None
    imus: tuple[ImuClock, ...]
    stamps: Mapping[str, Stamp]
    """By subject."""
    notes: tuple[str, ...]
    speeds: dict[str, Float[np.ndarray, "2 t"]]
    """For pictures, of each camera on a clock that was found: session times [s], and how fast
    people move [body extents per second]."""

    @property
    def complete(self) -> bool:
        """Whether every clock was found."""
        return all(row.state in ("found", "reference") for row in self.rows)


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
            if (clock := row.clock(float(cameras.middle_s[index]))) is not None:
                clocks[view.name] = clock
    sensors = ImuSync()
    if worn and rig is None:
        notes.append("sensors need a calibration of the cameras; only cameras were compared")
    elif worn:
        synced = [
            replace(track, times_s=clocks.get(track.name, Clock()).session_s(track.times_s))
            for track in tracks
            if len(tracks) == 1 or track.name in clocks
        ]
        take = _filmed_take(session, synced, progress)
        sensors = compare_imus(session, take, max_offset_s=max_offset_s, progress=progress)
    imus: dict[str, dict[str, Clock]] = {}
    for row, found in sensors.clocks:
        if (clock := row.clock(found.middle_s)) is not None:
            imus.setdefault(row.name, {}).update(dict.fromkeys(row.sensors, clock))
    reference = views[cameras.reference].name if cameras else None
    return Synchronisation(
        rows=(*rows, *(row for row, _ in sensors.clocks)),
        clocks=Clocks(cameras=clocks, imus=imus),
        reference=reference,
        cameras=cameras,
        imus=tuple(found for _, found in sensors.clocks),
        stamps=sensors.stamps,
        notes=(*notes, *sensors.notes),
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


def _camera_row(cameras: CameraClocks, index: int, view: View, max_offset_s: float) -> ClockRow:
    peak = cameras.peaks[index]
    if index == cameras.reference and peak is not None:
        still = ClockEstimate(offset_s=0.0, error_s=0.0)
        return clock_row("camera", view.name, Judgement(state="reference"), still)
    offset_s = float(cameras.offset_s[index])
    error_s = float(cameras.error_s[index]) if cameras.refined else view.period_s
    judged = judge(
        peak,
        moving=_speed(view) >= MIN_SPEED,
        seen=view.seen,
        error_s=error_s,
        max_offset_s=max_offset_s,
        who="the other cameras",
    )
    estimate = ClockEstimate(
        offset_s=offset_s,
        error_s=error_s,
        drift_ppm=float(cameras.drift_ppm[index]),
        drift_error_ppm=float(cameras.drift_error_ppm[index]),
        rivals_s=tuple(r - peak.shift_s + offset_s for r in peak.rivals_s) if peak else (),
    )
    return clock_row("camera", view.name, judged, estimate)


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
        samples={},
        times_s=solve_times_s(alone, tuple(tracks), []),
        findings=(),
        content_hash="",
    )
    return solve_session(data, progress=progress, anyway=True).whole_take
