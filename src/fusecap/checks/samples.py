"""The checks of opened files, of samples that a live run took."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fusecap.checks.measurements import check_motion
from fusecap.findings import Findings
from fusecap.setup import SessionSetup
from fusecap.sources.imu_files.track import ImuTrack
from fusecap.sources.keypoint_files import KeypointTrack
from fusecap.sources.session import Session
from fusecap.types import CameraSample, ImuSample

LEAST_SAMPLES = 3


def check_samples(setup: SessionSetup, samples: Iterable[CameraSample | ImuSample]) -> Findings:
    """What they say against themselves.

    Nothing of sources that were hardly heard, nor of sensors whose mounting is not known yet.
    """
    seen: dict[int, dict[int, np.ndarray]] = {}
    worn: dict[tuple[str, str], dict[int, ImuSample]] = {}
    for sample in samples:
        if isinstance(sample, CameraSample):
            seen.setdefault(sample.camera, {})[sample.timestamp_ns] = sample.people
        else:
            worn.setdefault((sample.subject, sample.bone), {})[sample.timestamp_ns] = sample
    session = _with_mounted(setup.session)
    keypoints = [
        _keypoints(setup, camera, people)
        for camera, people in sorted(seen.items())
        if len(people) >= LEAST_SAMPLES
    ]
    imus = {
        subject.name: [_imu(worn.get((subject.name, imu.bone), {})) for imu in subject.imus]
        for subject in session.subjects
    }
    findings = Findings()
    check_motion(session, setup.rig if len(setup.rig) else None, keypoints, imus, findings)
    return findings


def _with_mounted(session: Session) -> Session:
    subjects = tuple(
        subject.model_copy(
            update={"imus": tuple(i for i in subject.imus if i.bone_from_imu_wxyz is not None)}
        )
        for subject in session.subjects
    )
    return session.model_copy(update={"subjects": subjects})


def _keypoints(setup: SessionSetup, camera: int, people: dict[int, np.ndarray]) -> KeypointTrack:
    times_s = 1e-9 * np.array(sorted(people))
    step_s = np.diff(times_s)
    typical_s = float(np.median(step_s))
    steps = np.maximum(np.round(step_s / typical_s).astype(np.int64), 1)
    return KeypointTrack(
        name=setup.rig.names[camera],
        landmarks=setup.landmarks,
        rate_hz=1.0 / typical_s,
        frames=np.concatenate([[0], np.cumsum(steps)]),
        times_s=times_s,
        people=tuple(people[ns] for ns in sorted(people)),
        broken=(),
    )


def _imu(samples: dict[int, ImuSample]) -> ImuTrack | None:
    if len(samples) < LEAST_SAMPLES:
        return None
    in_order = [samples[ns] for ns in sorted(samples)]
    return ImuTrack(
        times_s=1e-9 * np.array(sorted(samples)),
        orientation_wxyz=np.array([sample.orientation_wxyz for sample in in_order]),
        accel_m_s2=np.array([sample.accel_m_s2 for sample in in_order]),
    )
