"""The checks of opened files, of samples that a live run took."""

from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np

from fusecap.checks.measurements import check_motion
from fusecap.files import Spool
from fusecap.findings import Findings
from fusecap.setup import SessionSetup
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.people_store import PeopleStore, chosen
from fusecap.sources.session import Session
from fusecap.types import CameraSample, ImuSample

LEAST_SAMPLES = 3


def check_samples(setup: SessionSetup, samples: Iterable[CameraSample | ImuSample]) -> Findings:
    """What they say against themselves, in whichever order they come; none of them is kept.

    Those of no camera or sensor, or of other keypoints, are left out. Nothing is said of sources
    that were hardly heard, nor of sensors whose mounting is not known yet.
    """
    keypoints = len(setup.landmarks.landmark_names), 3
    seen = [_Seen(keypoints) for _ in setup.rig.names]
    worn = {(s.name, imu.bone): _Worn() for s in setup.session.subjects for imu in s.imus}
    for sample in samples:
        if isinstance(sample, ImuSample):
            if (sample.subject, sample.bone) in worn:
                worn[sample.subject, sample.bone].add(sample)
        elif 0 <= sample.camera < len(seen) and sample.people.shape[1:] == keypoints:
            seen[sample.camera].add(sample)
    session = _with_mounted(setup.session)
    tracks = [camera.track(setup, name) for name, camera in zip(setup.rig.names, seen, strict=True)]
    imus = {
        subject.name: [worn.pop((subject.name, imu.bone)).track() for imu in subject.imus]
        for subject in session.subjects
    }
    findings = Findings()
    check_motion(
        session,
        setup.rig if len(setup.rig) else None,
        [track for track in tracks if track is not None],
        imus,
        findings,
    )
    return findings


def _with_mounted(session: Session) -> Session:
    subjects = tuple(
        subject.model_copy(
            update={"imus": tuple(i for i in subject.imus if i.bone_from_imu_wxyz is not None)}
        )
        for subject in session.subjects
    )
    return session.model_copy(update={"subjects": subjects})


class _Seen:
    """What one camera saw."""

    def __init__(self, keypoints: tuple[int, int]) -> None:
        self._times_ns = array("q")
        self._people = PeopleStore(*keypoints)

    def add(self, sample: CameraSample) -> None:
        self._times_ns.append(sample.timestamp_ns)
        self._people.append(sample.people)

    def track(self, setup: SessionSetup, name: str) -> KeypointTrack | None:
        times_ns, rows = np.unique(self._times_ns, return_index=True)
        if len(rows) < LEAST_SAMPLES:
            return None
        step_s = 1e-9 * np.diff(times_ns)
        typical_s = float(np.median(step_s))
        steps = np.maximum(np.round(step_s / typical_s).astype(np.int64), 1)
        return KeypointTrack(
            name=name,
            landmarks=setup.landmarks,
            rate_hz=1.0 / typical_s,
            frames=np.concatenate([[0], np.cumsum(steps)]),
            times_s=1e-9 * times_ns,
            people=chosen(self._people, rows),
            broken=(),
        )


class _Worn:
    """What one sensor measured."""

    _SAMPLE = np.dtype([("ns", np.int64), ("wxyz", np.float32, 4), ("accel", np.float32, 3)])

    def __init__(self) -> None:
        self._samples = Spool()
        self._one = np.empty(1, self._SAMPLE)

    def add(self, sample: ImuSample) -> None:
        if 0.1 < np.linalg.norm(sample.orientation_wxyz) < 10.0:
            self._one["ns"] = sample.timestamp_ns
            with np.errstate(over="ignore"):  # of numbers beyond every scale
                self._one["wxyz"], self._one["accel"] = sample.orientation_wxyz, sample.accel_m_s2
            self._samples.append(self._one.tobytes())

    def track(self) -> ImuTrack | None:
        samples = np.frombuffer(self._samples.read(0, len(self._samples)), self._SAMPLE)
        times_ns, rows = np.unique(samples["ns"], return_index=True)
        if len(rows) < LEAST_SAMPLES:
            return None
        return ImuTrack(
            times_s=1e-9 * times_ns,
            orientation_wxyz=samples["wxyz"][rows],
            accel_m_s2=samples["accel"][rows],
        )
